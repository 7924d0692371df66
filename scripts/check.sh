#!/usr/bin/env bash
# Every guard, each to its end, then one line per guard: `make check`. Names as arguments run those only.
set -u
cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." || exit

python_files() { git ls-files --cached --others --exclude-standard -- "$@" | while read -r file; do [ ! -f "$file" ] || echo "$file"; done; }
format() { ruff format --quiet --check . || { ruff format --check .; echo "run: make format"; return 1; }; }
lint() { ruff check --quiet .; }
types() { mypy --no-error-summary; }
imports() { lint-imports --no-logo; }
docstrings() { python_files 'smp_motor_control/*.py' 'smp_motor_ident/*.py' | grep -v '^smp_motor_control/nodes/' | xargs python scripts/docstrings.py; }

guards=("$@")
[ $# -gt 0 ] || guards=(format lint types imports docstrings)
failed=()
for guard in "${guards[@]}"; do
  if output=$("$guard" 2>&1); then
    echo "check: $guard holds"
  else
    printf '%s\n' "$output"
    echo "check: $guard FAILS"
    failed+=("$guard")
  fi
done
[ ${#failed[@]} -eq 0 ] || { echo "check: failed: ${failed[*]}"; exit 1; }
