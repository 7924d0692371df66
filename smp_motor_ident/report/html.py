"""The page ``report.html``: one file that needs nothing else, for a reader who was not there."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources

import jinja2
from markupsafe import Markup

from smp_motor_ident.report import figures, words
from smp_motor_ident.report.alike import same_response
from smp_motor_ident.report.series import Comparison
from smp_motor_ident.result import Candidate, Estimate, Quantity

POOR_FIT = 80.0
"""Below, a fifth of the motion is unexplained [%]: a loop designed on it meets another motor."""


@dataclass(frozen=True)
class Report:
    """All that the page tells.

    Attributes
    ----------
    estimates : mapping of str to Estimate
        By wheel.
    comparisons : mapping of str to sequence of Comparison
        Measured and simulated speed by wheel.
    failures : mapping of str to str
        Wheels that could not be identified, each with the reason.
    notes : mapping of str to sequence of str
        What was repaired or assumed while reading, by wheel.
    provenance : mapping of str to str
        How the page came about: command, sources, date, versions.
    """

    estimates: Mapping[str, Estimate]
    comparisons: Mapping[str, Sequence[Comparison]] = field(default_factory=dict)
    failures: Mapping[str, str] = field(default_factory=dict)
    notes: Mapping[str, Sequence[str]] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Row:
    """One line of a table of quantities, in words."""

    symbol: str
    name: str
    meaning: str
    value: str
    std: str
    interval: str
    unit: str
    status: str
    kind: str


def render(report: Report) -> str:
    """Return the page.

    Parameters
    ----------
    report : Report
        What it tells.

    Returns
    -------
    str
        HTML, complete in itself: no script, and no resource from elsewhere.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("smp_motor_ident.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"label": words.label, "number": words.number}
    style = resources.files("smp_motor_ident.report").joinpath("report.css").read_text("utf-8")
    return environment.get_template("report.html.jinja").render(
        report=report,
        style=Markup(style),
        side_by_side=Markup(figures.side_by_side(report.estimates))
        if len(report.estimates) > 1
        else "",
        motors={
            wheel: _motor(
                _without(estimate, report.notes.get(wheel, ())), report.comparisons.get(wheel, ())
            )
            for wheel, estimate in report.estimates.items()
        },
    )


def _without(estimate: Estimate, notes: Sequence[str]) -> Estimate:
    """Leave out the warnings that are told as notes on the reading."""
    return replace(estimate, findings=tuple(f for f in estimate.findings if f.message not in notes))


def _motor(estimate: Estimate, parts: Sequence[Comparison]) -> dict[str, object]:
    """Return what the template shows of one motor."""
    wheel = estimate.wheel
    drawn = {}
    if parts:
        drawn = {
            "speed": figures.speed(wheel, parts),
            "detail": figures.detail(wheel, parts),
            "residuals": figures.residuals(wheel, estimate.residuals),
        }
    drawn["certainty"] = figures.certainty(estimate)
    drawn["matrix"] = figures.correlation_matrix(estimate)
    return {
        "estimate": estimate,
        "findings": words.findings(estimate),
        "verdict": _verdict(estimate),
        "headline": [
            _headline(name, words.scaled(estimate.combinations[name]))
            for name in ("dc_gain", "time_constant", "static_voltage", "delay")
            if name in estimate.combinations
        ],
        "combinations": [_row(name, q) for name, q in estimate.combinations.items()],
        "parameters": [
            _row(name, quantity)
            for name, quantity in estimate.parameters.items()
            if name not in estimate.combinations
        ],
        "alike": _alike(estimate),
        "candidates": _ranked(estimate.candidates),
        "figures": {name: Markup(svg) for name, svg in drawn.items()},
    }


def _row(name: str, quantity: Quantity) -> Row:
    symbol, title, meaning = words.EXPLAINED.get(name, ("", words.label(name), ""))
    std = quantity.std
    interval = "—"
    if quantity.ci95 is not None:
        low, high = (words.number(bound, std) for bound in quantity.ci95)
        interval = f"{low} … {high}"
    return Row(
        symbol=symbol,
        name=title,
        meaning=meaning,
        value=words.number(quantity.value, std),
        std=words.spread(std),
        interval=interval,
        unit=words.typeset(quantity.unit),
        status=words.status(quantity),
        kind=quantity.status,
    )


def _headline(name: str, quantity: Quantity) -> tuple[str, str, str, str]:
    """Return name, value, unit and relative deviation, short enough for a card."""
    share = ""
    if quantity.value and quantity.std:
        share = f"± {100 * quantity.std / abs(quantity.value):.2g} %"
    return words.label(name), words.number(quantity.value), quantity.unit, share


def _alike(estimate: Estimate) -> list[tuple[str, str, str]]:
    """Return symbol, name and range of what other motors of the same response may have."""
    rows = []
    for name, (low, high) in same_response(estimate).items():
        symbol, title, _ = words.EXPLAINED[name]
        end = f"… {high:.3g}" if math.isfinite(high) else "or more"
        rows.append(
            (symbol, title, f"{low:.3g} {end} {words.typeset(estimate.parameters[name].unit)}")
        )
    return rows


def _ranked(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Order the rungs by their information criterion, those without one last."""
    return sorted(candidates, key=lambda c: (c.bic is None, c.bic or 0.0))


def _verdict(estimate: Estimate) -> tuple[str, str]:
    """Return a class (good, fair, poor) and one sentence about how far to trust the model."""
    fit = estimate.fit_percent.validation
    if fit is None:
        text = "No data was held out, so nothing shows yet how the model does elsewhere"
    else:
        text = f"It explains {fit:.1f} % of the speed in data that it was not fitted to"
    if estimate.unreliable:
        return "poor", f"Unreliable: numbers may be off by more than their intervals. {text}."
    if fit is not None and fit < POOR_FIT:
        return "poor", f"{text}: too little to build a controller on."
    if fit is None or any(f.severity == "warning" for f in words.findings(estimate)):
        return "fair", f"{text}; read the warnings before you rely on it."
    return "good", f"{text}."
