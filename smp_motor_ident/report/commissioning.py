"""The page of a commissioning: the verdict first, what was checked, predicted and measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from smp_motor_ident.report import words
from smp_motor_ident.report.chart import Chart, Curve
from smp_motor_ident.report.templates import page

if TYPE_CHECKING:
    from smp_motor_ident.tune.verification import Change

COLUMNS = (
    ("breakaway", "starts to turn at [V]"),
    ("friction", "keeps turning at [V]"),
    ("gain", "speed per volt [rad/s/V, motor]"),
    ("coast", "comes to rest within [s]"),
    ("applied", "reported over commanded voltage"),
    ("velocity_ratio", "reported over counted speed"),
    ("rate", "samples per second"),
)
"""What the page shows of the test of the wheels."""


def charts(changes: Sequence[Change]) -> list[Chart]:
    """Return one chart for each change of each wheel: measured, predicted and its band."""
    return [
        Chart(
            name=f"{one.name}-{one.wheel}",
            title=f"{words.label(one.wheel)}, {one.name}: closed loop predicted and measured",
            x_label="time since the change of set-point [ms]",
            y_label="wheel speed [rad/s]",
            x=1e3 * one.time,
            curves=(
                Curve("predicted, all motors that may be", one.nominal, "simulated", "line",
                      one.low, one.high),
                Curve("measured", one.speed, "measured"),
            ),
            lines=(one.setpoint,),
            group=one.name,
            summary=f"Settles after {1e3 * one.reading.settling:.0f} ms, overshoots by "
            f"{one.reading.overshoot:.2f} %.",
        )
        for one in changes
    ]  # fmt: skip


def render(document: Mapping[str, Any], changes: Sequence[Change]) -> str:
    """Return the page of what ``commissioning.json`` holds and of the drive's curves."""
    return page(
        "commissioning.html.jinja",
        charts(changes),
        document=document,
        findings=document.get("findings", []),
        checks=document.get("checks", {}),
        identified=any(f["step"] == "validation" for f in document.get("findings", [])),
        changes=document.get("changes", []),
        columns=COLUMNS,
    )
