# SPDX-License-Identifier: Apache-2.0
"""Make ``report.html``: one self-contained page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from smp_motor_ident.chain.catalogue import rebuild_chain
from smp_motor_ident.report import figures, summary, templates, words
from smp_motor_ident.report.drawing import Chart, ticks
from smp_motor_ident.report.figures import Comparison
from smp_motor_ident.result import QUANTITIES, Estimate, Quantity

COMPARED = (
    "dc_gain", "time_constant", "time_constant_product", "static_voltage", "delay", "resistance",
    "motor_constant",
)  # fmt: skip
"""Quantities compared between wheels, where known."""

MARGIN = 0.06  # share of the axis beyond the intervals


@dataclass(frozen=True)
class Interval:
    """One wheel's number on the axis; places are in percent of its length."""

    wheel: str
    text: str
    value: float | None = None
    # random, total: ends of the 95 % intervals without and with systematic uncertainty
    random: tuple[float, float] | None = None
    total: tuple[float, float] | None = None


@dataclass(frozen=True)
class Compared:
    """One quantity of all wheels."""

    name: str
    rows: Sequence[Interval]
    ticks: Sequence[tuple[float, str]]  # places and labels
    unit: str


def compare(estimates: Mapping[str, Estimate]) -> list[Compared]:
    """Return the quantities known for at least one wheel, side by side."""
    made = []
    for name in COMPARED:
        quantities = {
            wheel: words.scaled(quantity)
            for wheel, one in estimates.items()
            if (quantity := {**one.parameters, **one.combinations}.get(name)) is not None
        }
        if any(quantity.value is not None for quantity in quantities.values()):
            made.append(_place_on_axis(name, list(estimates), quantities))
    return made


def _place_on_axis(
    name: str, wheels: Sequence[str], quantities: Mapping[str, Quantity]
) -> Compared:
    """Return the intervals of all wheels on an axis that holds them with a margin."""
    known = [q for q in quantities.values() if q.value is not None]
    ends = [x for q in known for x in (q.value, *(q.total_ci95 or ())) if x is not None]
    finite = list(filter(math.isfinite, ends))
    low, high = min(finite), max(finite)
    margin = MARGIN * (high - low) or 1.0
    low, high = low - margin, high + margin

    def place(value: float) -> float:
        """Return the place of a value in percent of the axis; infinite ends leave it."""
        share = (min(max(value, low - margin), high + margin) - low) / (high - low)
        return round(100 * float(share), 2)

    def interval(wheel: str) -> Interval:
        quantity = quantities.get(wheel, Quantity(None))
        value, random, total = quantity.value, quantity.ci95, quantity.total_ci95
        return Interval(
            wheel,
            words.state(quantity),
            None if value is None else place(value),
            random and (place(random[0]), place(random[1])),
            total and (place(total[0]), place(total[1])),
        )

    marks = [(place(tick), f"{tick:g}") for tick in ticks(low, high, about=4)]
    unit = words.format_unit(next(iter(known)).unit)
    return Compared(words.label(name), [interval(wheel) for wheel in wheels], marks, unit)


if TYPE_CHECKING:
    from smp_motor_ident.report.tuning_page import Tuning


@dataclass(frozen=True)
class Report:
    """Content of the page."""

    estimates: Mapping[str, Estimate]  # by wheel
    # Measured and simulated speed by wheel
    comparisons: Mapping[str, Sequence[Comparison]] = field(default_factory=dict)
    # Wheels that could not be identified, each with the reason
    failures: Mapping[str, str] = field(default_factory=dict)
    # Command, sources, date and versions behind the page
    provenance: Mapping[str, str] = field(default_factory=dict)
    # Tuning page by wheel; empty for a report without one
    tunings: Mapping[str, Tuning] = field(default_factory=dict)
    # Charts of later estimates by `identifier`, by wheel
    history: Mapping[str, Sequence[Chart]] = field(default_factory=dict)
    folder: str = "."  # that the results are written to


def render(report: Report) -> str:
    """Return the page."""
    motors = {wheel: _describe(estimate, report) for wheel, estimate in report.estimates.items()}
    tuning_charts, tuning_data = list[Chart](), dict[str, Any]()
    if report.tunings:
        from smp_motor_ident.report import tuning_page  # loads all of tune, which few reports need

        tuning_charts = tuning_page.page_charts(report.tunings)
        tuning_data = tuning_page.page_data(report.tunings)
    charts = [*tuning_charts, *(c for motor in motors.values() for c in motor["charts"])]
    return templates.page(
        "report.html.jinja",
        charts,
        report=report,
        words=words,
        quantities=QUANTITIES,
        licence=templates.text("uplot/LICENSE"),
        tuning_charts=tuning_charts,
        tuning_data=tuning_data,
        tuning_json=templates.script_data(tuning_data),
        comparisons=compare(report.estimates) if len(report.estimates) > 1 else (),
        motors=motors,
    )


def _describe(estimate: Estimate, report: Report) -> dict[str, Any]:
    """Return the template's data for one motor, in the order of a reader's questions."""
    wheel = estimate.wheel
    parts, since = report.comparisons.get(wheel, ()), report.history.get(wheel, ())
    shown, other = summary.select_messages(estimate)
    fit = figures.fit_charts(wheel, parts, estimate.value("time_constant")) if parts else []
    residuals = figures.residual_charts(wheel, estimate.residuals)
    frequency = figures.frequency_charts(wheel, parts) if parts else []
    held = {**estimate.combinations, **estimate.parameters}
    grade, verdict = summary.judge(estimate)
    return {
        "estimate": estimate,
        "grade": grade,
        "verdict": verdict,
        "fit_percent": summary.describe_fit(estimate),
        "stated": {n: q for n, q in held.items() if words.is_stated(q)},
        "doubted": summary.find_doubted(estimate),
        "hidden": [words.label_in_sentence(n) for n, q in held.items() if not words.is_stated(q)],
        "messages": shown,
        "other": other,
        "gains": _describe_gains(estimate, report),
        "chain": rebuild_chain(estimate.chain).components,
        "charts": [*fit, *residuals, *frequency, *since],
        "history": since,
        "fit": fit,
        "residuals": residuals,
        "frequency": frequency,
    }


def _describe_gains(estimate: Estimate, report: Report) -> tuple[str, str]:
    """Return the gains of a tuning in words, or advice and the command that designs them."""
    tuning = report.tunings.get(estimate.wheel)
    if tuning is None:
        return summary.advise_tuning(estimate, report.folder)
    found = tuning.choices[tuning.chosen].design if tuning.choices else None
    if found is None:
        return f"No gains: {tuning.reason}", ""
    gains = f"p {found.gains.p:.4g}, i {found.gains.i:.4g}, d {found.gains.d:.4g}"
    return f"Gains of wheel_pid, in volts and rad/s of the wheel: {gains}; parameter file:", ""
