#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Names the tracked programs without an SPDX header; `scripts/licence.sh insert` inserts it, behind a `#!` line.
set -eu
cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.."
header='# SPDX-License-Identifier: Apache-2.0'
mapfile -t without < <(git ls-files -z '*.py' '*.sh' '*.bash' .ci/run Dockerfile '*CMakeLists.txt' | xargs -0 -r grep -LxF "$header" | xargs -r -I{} find {} -size +0)
[ ${#without[@]} -gt 0 ] || exit 0
if [ "${1:-}" = insert ]; then
  sed -i -s "1{/^#!/!i $header
/^#!/a $header
}" "${without[@]}"
else
  printf '%s\n' "${without[@]}" "insert the header: scripts/licence.sh insert"
  exit 1
fi
