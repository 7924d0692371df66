"""Print every limit of the diagnosis as a page: ``python scripts/limits.py > docs/limits.md``."""

from __future__ import annotations

import sys

from smp_motor_ident.diagnosis import limits


def table() -> str:
    """Return all limits as a page of Markdown."""
    lines = [
        "# Limits",
        "",
        "Every threshold of a decision; printed by `python scripts/limits.py`.",
        "",
        "| limit | value | unit | reason | shown by |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, limit in vars(limits).items():
        if isinstance(limit, limits.Limit):
            cells = (f"`{name}`", f"{limit.value:g}", limit.unit, limit.reason, f"`{limit.test}`")
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(table())
