"""Print every limit as a page: ``python scripts/limits.py > docs/limits.md``."""

from __future__ import annotations

import sys

from smp_motor_ident.bag import limits as recordings
from smp_motor_ident.diagnosis import limits as estimates
from smp_motor_ident.diagnosis import response_limits as responses
from smp_motor_ident.diagnosis import sample_limits as samples
from smp_motor_ident.diagnosis import wheel_limits as wheels
from smp_motor_ident.report import limits as fleets
from smp_motor_ident.tune import limits as gains

TABLES = {
    "Recordings": recordings,
    "Samples": samples,
    "Estimates": estimates,
    "Response over frequency": responses,
    "Wheels on blocks": wheels,
    "Gains and loops": gains,
    "Many robots": fleets,
}


def page() -> str:
    """Return all limits as a page of Markdown."""
    lines = [
        "# Limits",
        "",
        "Every threshold of a decision; printed by `python scripts/limits.py`.",
    ]
    for title, table in TABLES.items():
        lines += ["", f"## {title}", "", "| limit | value | unit | reason | shown by |"]
        lines += ["| --- | --- | --- | --- | --- |"]
        for name, one in vars(table).items():
            if isinstance(one, estimates.Limit):
                cells = (f"`{name}`", f"{one.value:g}", one.unit, one.reason, f"`{one.test}`")
                lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(page())
