"""The page ``report.html``: one file that needs nothing else, for a reader who was not there."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from smp_motor_ident.finding import Finding
from smp_motor_ident.report import figures, templates, words
from smp_motor_ident.report.chart import Chart
from smp_motor_ident.report.figures import Comparison
from smp_motor_ident.result import Estimate, Quantity

if TYPE_CHECKING:
    from smp_motor_ident.report.tuning_page import Tuning

POOR_FIT = 80.0
"""Below, a fifth of the motion is unexplained [%]: a loop designed on it meets another motor."""


@dataclass(frozen=True)
class Report:
    """All that the page tells."""

    estimates: Mapping[str, Estimate]  # by wheel
    # Measured and simulated speed by wheel
    comparisons: Mapping[str, Sequence[Comparison]] = field(default_factory=dict)
    # Wheels that could not be identified, each with the reason
    failures: Mapping[str, str] = field(default_factory=dict)
    # How the page came about: command, sources, date, versions
    provenance: Mapping[str, str] = field(default_factory=dict)
    # By wheel what the tuning page offers; empty for a report without one
    tunings: Mapping[str, Tuning] = field(default_factory=dict)
    # By wheel what `identifier` has seen since
    history: Mapping[str, Sequence[Chart]] = field(default_factory=dict)


def render(report: Report) -> str:
    """Return the page."""
    motors = {
        wheel: _motor(estimate, report.comparisons.get(wheel, ()), report.history.get(wheel, ()))
        for wheel, estimate in report.estimates.items()
    }
    tuning_charts, tuning_data = _tuning_page(report.tunings)
    charts = [*tuning_charts, *(c for motor in motors.values() for c in motor["charts"])]
    return templates.page(
        "report.html.jinja",
        charts,
        report=report,
        licence=templates.text("uplot/LICENSE"),
        tuning_charts=tuning_charts,
        tuning_data=tuning_data,
        tuning_json=templates.script_data(tuning_data),
        wheels=_side_by_side(report.estimates) if len(report.estimates) > 1 else (),
        motors=motors,
    )


def _tuning_page(tunings: Mapping[str, Tuning]) -> tuple[list[Chart], dict[str, Any]]:
    if not tunings:
        return [], {}
    from smp_motor_ident.report import tuning_page  # loads all of tune, which few reports need

    return tuning_page.page_charts(tunings), tuning_page.page_data(tunings)


def _motor(
    estimate: Estimate, parts: Sequence[Comparison], since: Sequence[Chart]
) -> dict[str, Any]:
    """Return what the template shows of one motor."""
    wheel, found = estimate.wheel, words.findings(estimate)
    fit = figures.fit_charts(wheel, parts) if parts else []
    residuals = figures.residual_charts(wheel, estimate.residuals)
    frequency = figures.frequency_charts(wheel, parts) if parts else []
    return {
        "estimate": estimate,
        "findings": found,
        "verdict": _verdict(estimate, found),
        "headline": [
            (words.label(name), words.number(q.value), q.unit, _share(q))
            for name in ("dc_gain", "time_constant", "static_voltage", "delay")
            if (one := estimate.combinations.get(name)) and (q := words.scaled(one))
        ],
        "combinations": [_row(name, q) for name, q in estimate.combinations.items()],
        "parameters": [
            _row(n, q) for n, q in estimate.parameters.items() if n not in estimate.combinations
        ],
        "alike": _alike(estimate),
        # By their information criterion, those without one last
        "candidates": sorted(
            estimate.candidates, key=lambda c: (not c.chosen, c.bic is None, c.bic or 0.0)
        ),
        "correlations": _correlations(estimate),
        "charts": [*fit, *residuals, *frequency, *since],
        "history": since,
        "fit": fit,
        "residuals": residuals,
        "frequency": frequency,
    }


def _correlations(estimate: Estimate) -> list[tuple[str, list[float]]]:
    """Return the correlations between the errors of the estimates, a row a quantity."""
    std = np.sqrt(np.diag(estimate.covariance))
    known = np.flatnonzero(std > 0)
    if known.size < 2:
        return []
    matrix = estimate.covariance[np.ix_(known, known)] / np.outer(std[known], std[known])
    return [(words.label(estimate.names[k]), list(row)) for k, row in zip(known, matrix)]


def _side_by_side(
    estimates: Mapping[str, Estimate],
) -> list[tuple[str, str, list[tuple[str, tuple[float, float, float]] | None]]]:
    """Return name, unit and, by wheel, value and interval as shares of the common range."""
    rows = []
    for name in ("dc_gain", "time_constant", "time_constant_product", "static_voltage", "delay"):
        held = [estimate.combinations.get(name) for estimate in estimates.values()]
        known = [words.scaled(q) if q and q.value is not None else None for q in held]
        ends = [q.ci95 or (q.value, q.value) for q in known if q is not None]
        if not ends:
            continue
        low, high = min(e[0] for e in ends), max(e[1] for e in ends)  # type: ignore[type-var]
        cells = [_cell(q, low or 0.0, high or 0.0) if q is not None else None for q in known]
        unit = next(q.unit for q in known if q is not None)
        rows.append((words.label(name), words.typeset(unit), cells))
    return rows


def _cell(q: Quantity, low: float, high: float) -> tuple[str, tuple[float, float, float]]:
    value = q.value or 0.0
    first, last = q.ci95 or (value, value)
    begin, middle, end = ((x - low) / ((high - low) or 1.0) for x in (first, value, last))
    return words.number(q.value, q.std), (begin, middle, end)


def _row(name: str, quantity: Quantity) -> dict[str, str]:
    """Return one line of a table of quantities, in words."""
    symbol, title, meaning = words.EXPLAINED.get(name, ("", words.label(name), ""))
    return dict(
        symbol=symbol,
        name=title,
        meaning=meaning,
        value=words.number(quantity.value, quantity.std),
        std=words.spread(quantity.std),
        interval=words.interval(quantity),
        unit=words.typeset(quantity.unit),
        status=words.status(quantity),
        kind=quantity.status,
        share=_share(quantity),
    )


def _share(quantity: Quantity) -> str:
    """Return half the 95 % interval as a percentage of the value."""
    if not quantity.value or not quantity.std:
        return "—"
    return f"± {196 * quantity.std / abs(quantity.value):.2g} %"


def _alike(estimate: Estimate) -> list[tuple[str, str, str]]:
    """Return symbol, name and range of what other motors of the same response may have."""
    rows = []
    for name, (low, high) in _same_response(estimate).items():
        symbol, title, _ = words.EXPLAINED[name]
        end = f"… {high:.3g}" if math.isfinite(high) else "or more"
        unit = words.typeset(estimate.parameters[name].unit)
        rows.append((symbol, title, f"{low:.3g} {end} {unit}"))
    return rows


def _same_response(estimate: Estimate) -> dict[str, tuple[float, float]]:
    """Return the ranges of L, K, J and b over all motors of the identified response.

    They are why some parameters are not printed: each would have given the same recording.

    With ``a0 = (R b + K^2)/K``, ``a1 = (R J + L b)/K``, ``a2 = L J/K`` and R known, each K gives
    ``b = K (a0 - K)/R`` and J as a root of ``R J^2 - a1 K J + a2 K b = 0``, then L.  Both are
    real and not negative for ``max(0, a0 - a1^2/(4 a2)) <= K <= a0``.  At ``K = a0`` (b = 0) the
    larger root is ``a1 a0/R``, the smaller one vanishes and takes L to infinity.

    References
    ----------
    docs/derivations.md, what voltage and speed can tell.
    """
    gain, lag = estimate.value("dc_gain"), estimate.value("time_constant")
    product, resistance = estimate.value("time_constant_product"), estimate.value("resistance")
    if "motor_constant" not in estimate.unidentifiable or min(gain, lag, product, resistance) <= 0:
        return {}
    a0, a1, a2 = 1 / gain, lag / gain, product / gain
    lowest = max(a0 - a1**2 / (4 * a2), 0.0)
    steepest = max(lowest, a0 / 2)  # where K (a0 - K) is largest
    return {
        "inductance": (a2 * resistance / a1, math.inf),
        "motor_constant": (lowest, a0),
        "inertia": (0.0, a1 * a0 / resistance),
        "viscous_friction": (0.0, steepest * (a0 - steepest) / resistance),
    }


def _verdict(estimate: Estimate, findings: Sequence[Finding]) -> tuple[str, str, str]:
    """Return a class, two words and a sentence about how far to trust the model."""
    fit = estimate.fit_percent.validation
    if fit is None:
        text = "No data was held out, so nothing shows yet how the model does elsewhere"
    else:
        text = f"It explains {fit:.1f} % of the speed in data that it was not fitted to"
    if estimate.unreliable:
        return "poor", "Unreliable", f"Numbers may be off by more than their intervals. {text}."
    if fit is not None and fit < POOR_FIT:
        return "poor", "Poor fit", f"{text}: too little to build a controller on."
    if fit is None or any(f.severity == "warning" for f in findings):
        return "fair", "Read the warnings", f"{text}; read the warnings before you rely on it."
    return "good", "Reliable", f"{text}."
