#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Every guard, each to its end, then one line per guard: `make check`. Names as arguments run those only.
set -u
cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." || exit

format() { ruff format --quiet --check . || { ruff format --check .; echo "run: make format"; return 1; }; }
lint() { ruff check --quiet .; }
types() { mypy --no-error-summary; }
imports() { lint-imports --no-logo; }
docstrings() {
  find smp_motor_control smp_motor_ident -name '*.py' -not -path '*/nodes/*' -print0 |
    xargs -0 python scripts/docstrings.py
}
prose() { python scripts/prose.py; }
docs() { sphinx-build -q -W --keep-going docs docs/_build/html; }
licence() { scripts/licence.sh; }
# What tools leave behind is not tracked.
leftovers() {
  ! git ls-files |
    grep -E '(^|/)(\.cache|\.rustup|\.cargo|\.npm|node_modules|\.venv|\.[a-z_]+_cache|\.hypothesis|__pycache__|[^/]+\.egg-info|\.DS_Store|\.idea|\.vscode)(/|$)|\.(pyc|nbi|nbc|orig|rej|swp)$'
}

guards=("$@")
[ $# -gt 0 ] || guards=(format lint types imports docstrings prose docs licence leftovers)
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
