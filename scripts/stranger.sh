#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Installs the last commit as strangers do and runs it to the end: `scripts/stranger.sh [pip] [colcon]`, default both.
#   pip     `pip install .` in an empty environment: a CSV file to its report and gains.
#   colcon  plain `colcon build` beside two other packages: a simulated robot is recorded, identified, tuned and driven.
# pip works in any shell (PYTHON chooses the Python), colcon in that of setup.bash and where ROS is sourced.
# WORKSPACE names the folder; default: a temporary one.
set -eu
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
root=$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd -P)
workspace=${WORKSPACE:-$(mktemp -d)}
say() { echo "stranger: $*"; }
fail() { echo "stranger: FAILED: $*" >&2; exit 1; }
# Runs a command with its output in a log, which is shown when the command fails.
run() {
  local log=$1; shift
  "$@" >"$log.log" 2>&1 || { tail -40 "$log.log"; fail "$*"; }
}
outputs() { for file in "$@"; do [ -s "$file" ] || fail "$file was not written"; done; }

by_pip() {
  local folder=$workspace/pip began=$SECONDS
  mkdir -p "$folder/source" && cd "$folder"
  git -C "$root" archive HEAD | tar -x -C source
  # Nothing of ROS or of this repository's own environment is seen.
  local clean=(env -u PYTHONPATH -u LD_LIBRARY_PATH -u AMENT_PREFIX_PATH -u VIRTUAL_ENV -u _ROS_WHEELS_BOOTSTRAP_COMPLETE)
  run venv "${clean[@]}" "$("${PYTHON:-python3}" -c 'import sys; print(sys._base_executable)')" -m venv venv
  local size; size=$(du -sm venv | cut -f1)  # pip of the environment itself
  run install "${clean[@]}" venv/bin/pip install --disable-pip-version-check ./source
  size=$(($(du -sm venv | cut -f1) - size))
  say "pip install .: $((SECONDS - began)) s, $size MB"
  [ "$size" -lt 450 ] || fail "the package and its requirements take $size MB; at most 450"
  "${clean[@]}" venv/bin/python - <<'PY'
import numpy as np
rng = np.random.default_rng(0)
time = np.arange(0, 20, 0.005)
voltage = np.repeat(rng.uniform(-8, 8, time.size // 40), 40)
speed = np.zeros_like(time)
for k in range(1, time.size):
    speed[k] = speed[k - 1] + (25 * voltage[k - 1] - speed[k - 1]) * (1 - np.exp(-0.1))
table = np.c_[time, voltage, speed + 0.3 * rng.standard_normal(time.size)]
np.savetxt("log.csv", table, delimiter=",", header="t,u,w", comments="")
PY
  run identify "${clean[@]}" venv/bin/identify log.csv --output result --map time=t voltage=u velocity=w
  run tune "${clean[@]}" venv/bin/tune result --supply 12 --output gains.yaml
  outputs result/{identification.json,motors.yaml,report.html} gains.yaml
  say "pip: a CSV file became $(wc -c <result/report.html) bytes of report, and gains ($((SECONDS - began)) s)"
}

by_colcon() {
  local folder=$workspace/colcon began=$SECONDS
  mkdir -p "$folder/src" && cd "$folder"
  git -C "$root" archive HEAD --prefix=smp/ | tar -x -C src
  for other in first second; do
    mkdir -p "src/$other/$other" && touch "src/$other/$other/__init__.py"
    cat >"src/$other/setup.py" <<PY
from setuptools import setup
setup(name="$other", version="1.0.0", packages=["$other"])
PY
  done
  # Nothing of this repository's own build is seen; its Python environment, where there is one, stands in for apt and pip.
  clean() { tr ':' '\n' <<<"$1" | grep -vE "^($root/(install|build)|\$)" | paste -sd: || true; }
  for variable in AMENT_PREFIX_PATH PYTHONPATH; do export "$variable=$(clean "${!variable:-}")"; done
  export PATH=$(clean "$PATH") CMAKE_PREFIX_PATH=$AMENT_PREFIX_PATH
  unset COLCON_PREFIX_PATH
  if command -v rosdep >/dev/null; then
    rosdep check --from-paths src --ignore-src || fail "rosdep"
  else
    python3 - "$root/scripts/rosdep_keys.txt" src/smp/package.xml <<'PY' || fail "rosdep keys"
import sys
from xml.etree import ElementTree
known = {line.split()[0] for line in open(sys.argv[1]) if line.strip() and line[0] != "#"}
found = {e.text for p in sys.argv[2:] for e in ElementTree.parse(p).getroot() if e.tag.endswith("depend")}
print("stranger: rosdep keys:", "unknown: " + ", ".join(sorted(found - known)) if found - known else f"{len(found)} known")
sys.exit(bool(found - known))
PY
  fi
  run build colcon build
  for package in first second smp_motor_control; do [ -d "install/$package" ] || fail "$package was not built"; done
  say "colcon build: $((SECONDS - began)) s, with two other packages"
  set +u; . install/setup.bash; set -u
  command -v ros2 >/dev/null && run interface ros2 interface show smp_interfaces/msg/MotorState
  local bin=install/smp_motor_control/lib/smp_motor_control
  for executable in "$bin"/*; do run help timeout 60 "$executable" --help; done
  say "--help: $(find "$bin" -type f | wc -l) executables"
  run demo "$bin/demo" --output demo
  run identify "$bin/identify" demo/excitation --output result
  run tune "$bin/tune" result --output gains.yaml
  outputs result/{identification.json,motors.yaml,report.html} gains.yaml
  say "colcon: a recorded bag became $(wc -c <result/report.html) bytes of report, gains and a drive ($((SECONDS - began)) s)"
  "$bin/motor_plant" >plant.log 2>&1 & local plant=$!
  run commission "$bin/commission" --output trial --amplitude 6 --dry-run || { kill "$plant"; exit 1; }
  kill -INT "$plant"; wait "$plant" || fail "motor_plant ended with $?"
  run test colcon test --packages-select smp_motor_control \
    --pytest-args test/control/test_pid_law.py test/control/test_skid_steer.py test/system/test_robots.py
  colcon test-result --verbose | tail -3
  colcon test-result | grep -qE "[1-9][0-9]* tests?, 0 errors, 0 failures" || fail "colcon test-result counts no tests"
}

for way in "${@:-pip colcon}"; do
  for one in $way; do ( "by_$one" ); done
done
say "all well in $workspace"
