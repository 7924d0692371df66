#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Resolve the ranges of setup.py and requirements/*.in into lock files that hold for Python 3.10 to 3.13: `make lock`.
# Needs uv (pip install uv).
# Pins that are already in a lock file stay, unless `make lock ARGS=--upgrade`.
set -eu
cd -- "$(dirname -- "$0")/../requirements"
command -v uv >/dev/null || { echo "lock: uv not found: pip install uv" >&2; exit 1; }
lock() {
  output=$1 python=$2
  shift 2
  uv pip compile --quiet --universal --generate-hashes --no-annotate --no-header --python-version "$python" "$@" \
    --output-file "$output"
  without "$output" "sys_platform == 'win32'"
  sed -i -E "s/ ; sys_platform (!= 'win32'|== 'linux')( \\\\)?\$/\2/" "$output"
}
# A pin is a line and the lines of its hashes, which are indented.
without() {
  awk -v pattern="$2" '/^[^ ]/ { kept = $0 !~ pattern } kept' "$1" >"$1.partial"
  mv "$1.partial" "$1"
}
lock wheels.txt 3.10 ../setup.py --extra ros --extra lab --extra xlsx --extra matlab ros.in dev.in "$@"
# With ROS 2 Jazzy the rest comes from apt, at apt's versions, and must not be hidden by others.
lock jazzy.txt 3.12 ../setup.py --extra lab --extra xlsx --extra matlab colcon.in dev.in "$@" --override jazzy-apt.in
packaged=$(sed -n 's/^\([a-z0-9-]*\)==.*/\1/p' jazzy-apt.in | paste -sd '|')
without jazzy.txt "^($packaged)=="
sed -i "1i # What Ubuntu 24.04 with ROS 2 Jazzy lacks; made by \`make lock\` from setup.py, colcon.in, dev.in less jazzy-apt.in." jazzy.txt
sed -i "1i # All that is needed without ROS, Python 3.10 to 3.13; made by \`make lock\` from setup.py, ros.in, dev.in." wheels.txt
