# SPDX-License-Identifier: Apache-2.0
"""Print every limit as a page: ``python scripts/limits.py > docs/limits.md``."""

from __future__ import annotations

import sys

from smp_motor_ident.bag import limits as recordings
from smp_motor_ident.commission import wheel_limits
from smp_motor_ident.infer import instrument_limits, response_limits
from smp_motor_ident.limits import Limit
from smp_motor_ident.quality import limits as estimates
from smp_motor_ident.quality import sample_limits
from smp_motor_ident.report import limits as fleets
from smp_motor_ident.tune import limits as gains

TABLES = {
    "Recordings": recordings,
    "Samples": sample_limits,
    "Estimates": estimates,
    "Response over frequency": response_limits,
    "Instruments": instrument_limits,
    "Wheels on blocks": wheel_limits,
    "Gains and loops": gains,
    "Many robots": fleets,
}


def page() -> str:
    """Return all limits as a page of Markdown."""
    lines = [
        "# Decision thresholds",
        "",
        "Every threshold of a decision; printed by `python scripts/limits.py`.",
    ]
    for title, table in TABLES.items():
        lines += ["", f"## {title}", "", "| limit | value | unit | reason | shown by |"]
        lines += ["| --- | --- | --- | --- | --- |"]
        for name, one in vars(table).items():
            if isinstance(one, Limit):
                cells = (f"`{name}`", f"{one.value:g}", one.unit, one.reason, f"`{one.test}`")
                lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(page())
