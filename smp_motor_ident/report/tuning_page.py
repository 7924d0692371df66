# SPDX-License-Identifier: Apache-2.0
"""Make the tuning page: designs over bandwidth and phase margin, and their charts.

The page computes nothing; its sliders choose among these designs.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from smp_motor_ident.errors import SmpError
from smp_motor_ident.finding import format_figure
from smp_motor_ident.report import drawing, words
from smp_motor_ident.report.drawing import Chart, Curve, resample
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune import (
    METHODS,
    Design,
    Loop,
    design,
    design_wheels,
    specification,
    writing,
)
from smp_motor_ident.tune.case import Case, Robustness, assess, prepare, solve
from smp_motor_ident.tune.curves import Curves, curves
from smp_motor_ident.tune.designer import finish
from smp_motor_ident.tune.feedback import Feedback

BANDWIDTH_SHARES = (0.3, 0.45, 0.65, 0.85, 1.0)
"""Offered bandwidths, as shares of the one with the largest integral gain."""

PHASE_MARGINS = (45.0, 60.0, 70.0)  # offered phase margins [deg]: lively, usual, calm
DEFAULT_PHASE_MARGIN = 60.0  # that of `tune` [deg]
MAX_SENSITIVITY = METHODS["margin"].required.sensitivity

BAND_DRAWS = 100  # motors behind the bands of a choice, whose ends are their extremes


@dataclass(frozen=True, eq=False)
class Choice:
    """One design of the page, or the reason why these slider positions have none."""

    bandwidth: float  # asked for [rad/s]
    phase_margin: float  # asked for [deg]
    design: Design | None = None
    curves: Curves | None = None
    reason: str = ""  # why there is no design


@dataclass(frozen=True, eq=False)
class Tuning:
    """The designs that the page offers for one wheel."""

    wheel: str  # name of the wheel
    # Margin after margin, the bandwidths of each in rising order; empty without a design
    choices: Sequence[Choice] = ()
    chosen: int = -1  # index of the default choice of `tune`, -1 without a design
    reason: str = ""  # why there is no design at all


def design_all_wheels(
    estimates: Mapping[str, Estimate], loops: Mapping[str, Loop]
) -> tuple[Mapping[str, Design], dict[str, Tuning]]:
    """Return the designs of all wheels together, and the wheels without a design."""
    refused: dict[str, Tuning] = {}
    while left := {w: one for w, one in estimates.items() if w not in refused}:
        try:
            return design_wheels(left, loops).designs, refused
        except SmpError as error:
            refused |= _refuse(left, loops) or {w: Tuning(w, reason=str(error)) for w in left}
    return {}, refused


def _refuse(estimates: Mapping[str, Estimate], loops: Mapping[str, Loop]) -> dict[str, Tuning]:
    """Return the wheels for which there is no design at all, with the reason."""
    found = {}
    for wheel, estimate in estimates.items():
        try:
            design(estimate, loops[wheel])
        except SmpError as error:
            found[wheel] = Tuning(wheel, reason=str(error))
    return found


def design_tuning(estimate: Estimate, loop: Loop, own: Design) -> Tuning:
    """Design the controller of one wheel for all positions of the sliders."""
    choices = [
        Choice(share * own.margins.crossover, margin, own, curves(estimate, own))
        if share == BANDWIDTH_SHARES[-1] and margin == DEFAULT_PHASE_MARGIN
        else choose(estimate, loop, share * own.margins.crossover, margin, own)
        for margin in PHASE_MARGINS
        for share in BANDWIDTH_SHARES
    ]
    chosen = next(k for k, one in enumerate(choices) if one.design is own)
    return Tuning(estimate.wheel, choices, chosen)


def choose(estimate: Estimate, loop: Loop, bandwidth: float, margin: float, own: Design) -> Choice:
    """Design for a bandwidth [rad/s] and a phase margin [deg], with the reference of ``own``."""
    asked = dict(bandwidth=bandwidth, phase_margin=margin)
    return _finish_choice(estimate, loop, Choice(bandwidth, margin), own, asked, solve)


def judge(estimate: Estimate, own: Design, feedback: Feedback) -> Choice:
    """Return the figures of gains set by hand, with the reference of ``own``."""
    given = partial(assess, feedback=feedback)
    return _finish_choice(estimate, own.loop, Choice(math.nan, math.nan), own, {}, given)


def _finish_choice(
    estimate: Estimate, loop: Loop, asked: Choice, own: Design, targets: Mapping[str, Any],
    solve_case: Callable[[Case], tuple[Feedback, float, Robustness]],
) -> Choice:  # fmt: skip
    targets = {**targets, "samples": BAND_DRAWS, "together": own.together}
    lead = own.reference if own.together else None
    try:
        case = prepare(estimate, loop, "margin", targets)
        found = finish(case, *solve_case(case), lead)
    except SmpError as error:
        return replace(asked, reason=str(error))
    return replace(asked, design=found, curves=curves(estimate, found))


def page_charts(tunings: Mapping[str, Tuning]) -> list[Chart]:
    """Return the charts of the first wheel, which the page shows at first."""
    for tuning in tunings.values():
        if tuning.choices:
            one = tuning.choices[tuning.chosen]
            assert one.curves is not None and one.design is not None
            return tuning_charts({tuning.wheel: one.curves}, MAX_SENSITIVITY, "tuning-")
    return []


def page_data(tunings: Mapping[str, Tuning]) -> dict[str, Any]:
    """Return the data of the page's script: the designs of each wheel."""
    return {
        "shares": BANDWIDTH_SHARES,
        "margins": PHASE_MARGINS,
        "wheels": {
            wheel: dict(chosen=t.chosen, reason=t.reason, choices=[*map(describe, t.choices)])
            for wheel, t in tunings.items()
        },
    }


def describe(one: Choice) -> dict[str, Any]:
    """Return a choice as data for the page's script."""
    asked = {"bandwidth": f"{one.bandwidth:.4g}", "margin": f"{one.phase_margin:g}"}
    if one.design is None or one.curves is None:
        return {**asked, "reason": one.reason}
    found = one.design
    charts = tuning_charts({found.wheel: one.curves}, MAX_SENSITIVITY, "tuning-")
    head = [
        f"margin, bandwidth {found.margins.crossover:.4g} rad/s, phase margin "
        f"{found.margins.phase:.3g} deg; chosen on the tuning page of the report"
    ]
    return {
        **asked,
        "rows": _list_figures(found),
        "yaml": writing.gains_yaml({found.wheel: found}, head),
        "charts": {
            chart.name: [
                chart.x,
                *(y for c in chart.curves for y in (c.y, c.low, c.high) if y is not None),
            ]
            for chart in charts
        },
    }


def _list_figures(found: Design) -> list[tuple[str, str, str]]:
    """Return name, value and band of the design's figures."""
    bands, gains, settling = found.specification, found.gains, found.settling
    abrupt, noise = (
        format_figure(1e3 * x) for x in (settling.abrupt, found.performance.control_noise)
    )
    return [
        ("Crossover", f"{found.margins.crossover:.4g} rad/s", ""),
        ("Phase margin", *_format_band(bands.phase_margin, 1.0, "°")),
        ("Gain margin", *_format_band(bands.gain_margin, 1.0, "")),
        ("Largest sensitivity Ms", *_format_band(bands.sensitivity, 1.0, "")),
        ("Overshoot", *_format_band(bands.overshoot, 1.0, " %")),
        ("Settling within 2 % of a planned change", *_format_band(bands.settling, 1e3, " ms")),
        (
            f"Duration of a planned change by {settling.change:.3g} rad/s"
            f"{', the same for all wheels' if settling.common else ''}",
            f"{format_figure(1e3 * settling.transition)} ms",
            "",
        ),
        ("Settling of an abrupt change, feedback alone", f"{abrupt} ms", ""),
        ("Control noise", f"{noise} mV", ""),
        ("p", f"{gains.p:.4g} V s/rad", ""),
        ("i", f"{gains.i:.4g} V/rad", ""),
        ("d", f"{gains.d:.4g} V s²/rad", ""),
    ]


def _format_band(band: specification.Band, scale: float, unit: str) -> tuple[str, str]:
    value, low, high = (
        format_figure(round(scale * v, 3)) for v in (band.value, band.low, band.high)
    )
    return f"{value}{unit}", f"{low} … {high}{unit}"


def tuning_charts(wheels: Mapping[str, Curves], limit: float, prefix: str = "") -> list[Chart]:
    """Return the charts of the designs of all wheels, each name with a prefix."""
    # Wheels with different time constants have different time and frequency axes.
    longest = max(wheels.values(), key=lambda c: float(c.time[-1]))
    time = longest.time
    omega = np.unique(np.concatenate([c.omega for c in wheels.values()]))

    def chart(
        kind: str, title: str, y_label: str, log: str = "", lines: tuple[float, ...] = ()
    ) -> Chart:
        timed = kind in ("step", "load")
        x = time if timed else omega
        bands = {
            wheel: resample(x, c.time if timed else c.omega, getattr(c, kind))
            for wheel, c in wheels.items()
        }
        curves = tuple(
            Curve(words.label(wheel), rows[1], f"wheel-{k % 4 + 1}", "line", rows[0], rows[2])
            for k, (wheel, rows) in enumerate(bands.items())
        )
        if kind == "step":
            curves += (Curve("reference", resample(x, longest.time, longest.reference), "muted"),)
        return Chart(
            name=prefix + kind, title=title, y_label=y_label, log=log, lines=lines, curves=curves,
            x_label="time [ms]" if timed else "frequency [rad/s]",
            x=1e3 * x if timed else x, height=260,
            summary=f"{title}, of {', '.join(map(words.label, wheels))}",
        )  # fmt: skip

    return [
        chart("step", "Response to a change of set-point", "wheel speed [rad/s]"),
        chart("load", "Response to a load of 1 V", "wheel speed [rad/s]"),
        chart("gain", "Loop gain: magnitude", "magnitude", "xy", (1.0,)),
        chart("phase", "Loop gain: phase", "phase [deg]", "x", (-180.0,)),
        chart("sensitivity", f"Sensitivity (line: Ms {limit:g})", "|S|", "x", (limit,)),
        chart("noise", "Control noise", "density [V]", "xy"),
    ]


def tuning_svg(wheels: Mapping[str, Curves], limit: float) -> str:
    """Return the charts one below the other, as an SVG document."""
    return drawing.document(tuning_charts(wheels, limit), list(wheels))
