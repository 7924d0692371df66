#!/usr/bin/env bash
# Plays the stranger: the repository under src/ of an empty workspace, rosdep's keys, plain colcon build (which must
# refuse in one line), colcon build of both packages, --help of every executable, colcon test of a short set.
# Works in the shell of setup.bash and where ROS is sourced. WORKSPACE names the folder; default: a temporary one.
set -eu
root=$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd -P)
workspace=${WORKSPACE:-$(mktemp -d)}
say() { echo "stranger: $*"; }
fail() { echo "stranger: FAILED: $*" >&2; exit 1; }

mkdir -p "$workspace/src"
git -C "$root" archive HEAD --prefix=smp/ | tar -x -C "$workspace/src"
cd "$workspace"
# Nothing of this repository's own build is seen; its Python environment, where there is one, stands in for apt and pip.
clean() { tr ':' '\n' <<<"$1" | grep -vE "^($root/(install|build)|\$)" | paste -sd: || true; }
for variable in AMENT_PREFIX_PATH PYTHONPATH; do export "$variable=$(clean "${!variable:-}")"; done
export CMAKE_PREFIX_PATH=$AMENT_PREFIX_PATH
unset COLCON_PREFIX_PATH
options=(--cmake-args "-DPython3_EXECUTABLE=$(command -v python3)")

if command -v rosdep >/dev/null; then
  rosdep check --from-paths src --ignore-src || fail "rosdep"
else
  python3 - "$root/scripts/rosdep_keys.txt" src/smp/package.xml src/smp/smp_interfaces/package.xml <<'PY' || fail "rosdep keys"
import sys
from xml.etree import ElementTree
known = {line.split()[0] for line in open(sys.argv[1]) if line.strip() and line[0] != "#"}
found = {e.text for p in sys.argv[2:] for e in ElementTree.parse(p).getroot() if e.tag.endswith("depend")}
print("stranger: rosdep keys:", "unknown: " + ", ".join(sorted(found - known)) if found - known else f"{len(found)} known")
sys.exit(bool(found - known))
PY
fi

if colcon build "${options[@]}" >plain.log 2>&1; then
  [ -d install/smp_interfaces ] || fail "plain colcon build made a silent half"
else
  grep -rhoE "type: colcon build --base-paths [^ ]+ [^ '\\]+" plain.log log/latest_build | head -1 | grep . || fail "plain colcon build does not say what to type"
fi
say "plain colcon build: whole, or one line"

colcon build --base-paths src/smp src/smp/smp_interfaces "${options[@]}" >build.log 2>&1 || { tail -30 build.log; fail "colcon build"; }
say "colcon build: both packages"
set +u; . install/setup.bash; set -u
bin=install/smp_motor_control/lib/smp_motor_control
for executable in "$bin"/*; do
  timeout 60 "$executable" --help >help.log 2>&1 || { cat help.log; fail "$executable --help"; }
  [ -s help.log ] || fail "$executable --help says nothing"
done
say "--help: $(find "$bin" -type f | wc -l) executables"

colcon test --base-paths src/smp src/smp/smp_interfaces --packages-select smp_motor_control \
  --pytest-args test/control/test_pid.py test/control/test_skid_steer.py test/system/test_robots.py >test.log 2>&1 || { tail -30 test.log; fail "colcon test"; }
colcon test-result --verbose | tail -3
colcon test-result | grep -qE "[1-9][0-9]* tests?, 0 errors, 0 failures" || fail "colcon test-result counts no tests"
say "all well in $workspace"
