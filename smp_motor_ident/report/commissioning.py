"""The page of a commissioning: the verdict first, what was checked, predicted and measured."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from smp_motor_ident.report import words
from smp_motor_ident.report.chart import Chart, Curve
from smp_motor_ident.report.drawing import svg
from smp_motor_ident.report.templates import template

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
            height=220,
            summary=f"Settles after {1e3 * one.reading.settling:.0f} ms, overshoots by "
            f"{one.reading.overshoot:.2f} %.",
        )
        for one in changes
    ]  # fmt: skip


def render(document: Mapping[str, Any], changes: Sequence[Change]) -> str:
    """Return the page of what ``commissioning.json`` holds and of the drive's curves."""
    drawn = charts(changes)
    data = json.dumps([chart.to_document() for chart in drawn], separators=(",", ":"))
    return template("commissioning.html.jinja").render(
        document=document,
        findings=document.get("findings", []),
        checks=document.get("checks", {}),
        identified=any(f["step"] == "validation" for f in document.get("findings", [])),
        changes=document.get("changes", []),
        columns=COLUMNS,
        charts=drawn,
        draw=lambda chart: Markup(svg(chart)),
        data=Markup(data.replace("<", "\\u003c")),
        style=Markup(_text("uplot/uPlot.min.css") + _text("colors.css") + _text("report.css")),
        library=Markup(_text("uplot/uPlot.iife.min.js")),
        script=Markup(_text("plots.js")),
    )


def _text(name: str) -> str:
    return resources.files("smp_motor_ident.report").joinpath(name).read_text("utf-8")
