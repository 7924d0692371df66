# SPDX-License-Identifier: Apache-2.0
"""Make the page of a commissioning: verdict, motors, gains, verification drive, checks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING, Any

from smp_motor_ident.finding import SEVERITIES, format_figure
from smp_motor_ident.report import words
from smp_motor_ident.report.drawing import Chart, Curve, resample
from smp_motor_ident.report.templates import page
from smp_motor_ident.result import Estimate, Quantity

if TYPE_CHECKING:
    from smp_motor_ident.tune.verification import Change

COLUMNS = (
    ("breakaway", "starts to turn at [V]"),
    ("friction", "keeps turning down to [V]"),
    ("gain", "speed per volt [rad/s/V, motor]"),
    ("coast", "comes to rest within [s]"),
    ("applied", "reported over commanded voltage"),
    ("velocity_ratio", "reported over counted speed"),
    ("rate", "samples per second"),
)
"""Columns of the table of checks."""

GAINS = (
    ("p", "V s/rad"),
    ("i", "V/rad"),
    ("d", "V s²/rad"),
    ("feedforward_static", "V"),
    ("feedforward_velocity", "V s/rad"),
    ("feedforward_acceleration", "V s²/rad"),
)
"""Parameters of a controller that the page shows, per wheel rad/s."""


@dataclass(frozen=True)
class Row:
    """One quantity of all wheels, in words."""

    name: str
    unit: str
    cells: tuple[str, ...]  # by wheel, in the order of the wheels
    systematic: tuple[str, ...] = ()  # uncertainty of each cell, or none at all

    def tell(self, k: int) -> str:
        """Return the quantity of wheel ``k`` in one line."""
        shares = self.systematic[k] if self.systematic else ""
        text = f"{self.name} {self.cells[k]} {self.unit}"
        return f"{text}, systematic {shares}" if shares else text


Results = Mapping[str, Sequence[Row]]
"""Results of a commissioning in groups: drive, gains and motor."""


def results(
    estimates: Mapping[str, Estimate],
    gains: Mapping[str, Mapping[str, Any]],
    changes: Sequence[Mapping[str, Any]],
) -> Results:
    """Return the drive, the gains as ``gains.json`` holds them, and the motors."""
    groups = {"Motor": list(_list_motor_rows(estimates))}
    if gains:
        entries = [gains[wheel] for wheel in estimates]
        driven = [[c for c in changes if c["wheel"] == wheel] for wheel in estimates]
        held = [
            Row(name, unit, tuple(f"{one['gains'][name]:.4g}" for one in entries))
            for name, unit in GAINS
        ]
        drive = list(_list_drive_rows(entries, driven))
        groups = {"Drive": drive, "Gains of wheel_pid": held, **groups}
    return groups


def _list_motor_rows(estimates: Mapping[str, Estimate]) -> Iterator[Row]:
    """Yield every known quantity, with random and systematic uncertainty."""
    held = [{**one.combinations, **one.parameters} for one in estimates.values()]
    for name in dict.fromkeys(name for one in held for name in one):
        found = [one.get(name, Quantity(None)) for one in held]
        known = [one for one in found if one.value is not None]
        if known:
            unit = words.format_unit(words.scaled(known[0]).unit)
            values = tuple(words.state(one, with_unit=False) for one in found)
            yield Row(words.label(name), unit, values, tuple(map(words.systematic, found)))


def _list_drive_rows(
    entries: Sequence[Mapping[str, Any]], driven: Sequence[Sequence[Mapping[str, Any]]]
) -> Iterator[Row]:
    """Yield settling and overshoot: designed, and the largest measured ones."""
    for name, title, scale, unit in (
        ("settling", "Settles", 1e3, "ms"),
        ("overshoot", "Overshoots", 1.0, "%"),
    ):
        bands = [e["specification"][name] for e in entries]
        designed = (
            f"{_format_figure(scale, b['value'])}, at most {_format_figure(scale, b['high'])}"
            for b in bands
        )
        yield Row(f"{title}, designed", unit, tuple(designed))
        if name == "settling":
            planned = (_format_figure(scale, e["settling"]["transition"]) for e in entries)
            yield Row("Duration of the planned change", unit, tuple(planned))
        if all(driven):
            for key, of in (("allowed", "allowed in the drive"), ("reading", "measured")):
                most = ([one[key][name] for one in changes] for changes in driven)
                cells = (_format_figure(scale, None if None in m else max(m)) for m in most)
                yield Row(f"{title}, {of}", unit, tuple(cells))


def _format_figure(scale: float, value: float | None) -> str:
    return "—" if value is None else format_figure(round(scale * value, 2))


def charts(changes: Sequence[Change]) -> list[Chart]:
    """Return one chart for each wheel: measured and predicted changes of set-point, with band."""
    made = []
    for wheel, group in groupby(changes, lambda one: one.wheel):
        mine = list(group)
        time = max((one.time for one in mine), key=len)
        curves = []
        for one in mine:
            on = partial(resample, time, one.time)
            curves += [
                Curve(f"{one.name}, predicted", on(one.nominal), "simulated", "line",
                      on(one.low), on(one.high)),
                Curve("measured", on(one.speed), "measured"),
            ]  # fmt: skip
        told = (
            f"{one.name}: settles after {1e3 * one.reading.settling:.0f} ms, predicted "
            f"{1e3 * one.expected.settling:.0f} ms; overshoots by {one.reading.overshoot:.2f} %."
            for one in mine
        )
        made.append(Chart(
            name=f"drive-{wheel}", title=f"{words.label(wheel)}: predicted and measured",
            x_label="time since the change of set-point [ms]", y_label="wheel speed [rad/s]",
            x=1e3 * time, curves=tuple(curves), lines=tuple(one.setpoint for one in mine),
            group="drive", summary=" ".join(told),
        ))  # fmt: skip
    return made


def render(
    document: Mapping[str, Any], changes: Sequence[Change], known: Results, parameters: str
) -> str:
    """Return the page of ``commissioning.json``, with motors, gains and drive."""
    findings = sorted(
        document.get("findings", []), key=lambda one: -SEVERITIES.index(one["severity"])
    )
    return page(
        "commissioning.html.jinja",
        charts(changes),
        document=document,
        verdict=_verdict(document),
        findings=findings,
        results=known,
        # Without the comments on their origin, which are in the file
        parameters="\n".join(x for x in parameters.splitlines() if not x.startswith("#")),
        checks=document.get("checks", {}),
        changes=document.get("changes", []),
        columns=COLUMNS,
    )


def _verdict(document: Mapping[str, Any]) -> tuple[str, str]:
    """Return the CSS class and the words of the verdict."""
    if document["passed"] is None:
        return "fair", "Not finished."
    if not document["passed"]:
        return "poor", "Not passed."
    borne = [f for f in document.get("findings", []) if f["severity"] == "refused"]
    return ("fair", "Passed with accepted findings.") if borne else ("good", "Passed.")
