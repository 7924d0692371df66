#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Prepare everything that `make demo`, `make test` and setup.bash need: find a Python, let environment.py do the work.
# PYTHON=/path/to/python3 chooses the Python; without it the one that made .venv, python3, then the newest in range.
set -eu
scripts=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd -P)

fail() {
  echo "setup: $1" >&2
  exit 1
}

in_range() {
  "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null
}

[ "$(uname -s)" = Linux ] && [ "$(uname -m)" = x86_64 ] || [ -n "${ROS_DISTRO:-}" ] ||
  fail "$(uname -s) on $(uname -m) is not supported: the ROS wheels exist for Linux on x86_64 only; install ROS 2 Jazzy and source it"

run() {
  [ "${2:-}" != --find-python ] || { command -v "$1" && exit 0; }
  exec "$1" "$scripts/environment.py"
}

if [ -n "${PYTHON:-}" ]; then
  command -v "$PYTHON" >/dev/null || fail "PYTHON=$PYTHON does not exist or cannot be executed"
  in_range "$PYTHON" || fail "PYTHON=$PYTHON is not a Python 3.10 to 3.13"
  run "$PYTHON" "$@"
fi
# With ROS sourced the Python must be the one that ROS was built for; without it, a shell's choice must not redo the work.
[ -n "${ROS_DISTRO:-}" ] && own= || own=$scripts/../.venv/bin/python
for python in $own python3 python3.12 python3.13 python3.11 python3.10; do
  if command -v "$python" >/dev/null && in_range "$python"; then
    run "$python" "$@"
  fi
done
fail "no Python 3.10 to 3.13 found: install one (Debian, Ubuntu: apt install python3 python3-venv python3-dev) or name it: make setup PYTHON=/path/to/python3"
