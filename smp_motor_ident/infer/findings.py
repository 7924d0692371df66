# SPDX-License-Identifier: Apache-2.0
"""Collect findings on an estimate, with advice on further recordings or measurements."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from smp_motor_control.motor.parameters import PHYSICAL
from smp_motor_ident import limits
from smp_motor_ident.chain.component import Component, Parameter
from smp_motor_ident.chain.quantities import REPORTED
from smp_motor_ident.errors import CurrentError, InsufficientExcitationError, SignalError
from smp_motor_ident.finding import Finding, format_figure
from smp_motor_ident.fit.adequacy import MAX_ADEQUATE_SCATTER, Scatter, leaves_only_rounding
from smp_motor_ident.fit.data import Data, prepare
from smp_motor_ident.fit.descend import Fit, approach, fit
from smp_motor_ident.fit.start import guess_motors
from smp_motor_ident.infer.answer import SCALE_POWERS, Answer
from smp_motor_ident.infer.uncertainty import Contribution, Levels
from smp_motor_ident.infer.validation import compute_explained_percent, estimate_white_share
from smp_motor_ident.limits import MAX_STATIC_VOLTAGE_SHARE
from smp_motor_ident.quality.screen import name_records
from smp_motor_ident.quality.units import check_plausibility
from smp_motor_ident.record import Record
from smp_motor_ident.result import UNITS, FitPercent, Quantity, ResidualTests

UNREPORTED_COMPONENTS = (
    "first_order",
    "second_order",
    "electromechanical",
    "friction",
    "speed",
    "differenced_speed",
    "angle",
    "current",
)
"""Components without a finding."""
MIN_REST_NOISE_SHARE = 0.9  # of white noise in the motion of a motor at rest
MIN_SIGNIFICANT_SIZE = 3.0  # standard deviations from which an effect is a warning
UNREPORTED_PARAMETERS = ("current_offset", "vc", "eccentric_phase")
"""Parameters omitted from messages about their component."""
MAX_NOTE_STD = 0.02  # relative, of a quantity up to which such a scatter is a note
MAX_WARNING_STD = 0.2  # the same for a warning; above it a quantity is unreliable


@dataclass(frozen=True, eq=False)
class EstimateContext:
    """Data, fit and quantities of an estimate, which its findings assess."""

    group: Sequence[Record]
    data: Data
    found: Fit
    parts: Sequence[Contribution]
    scatters: Sequence[Scatter]
    levels: Levels
    answer: Answer
    percent: FitPercent
    tests: ResidualTests
    known: Mapping[str, float]

    def quantity(self, name: str) -> Quantity | None:
        """Return a quantity that has a value."""
        found = self.answer.combinations.get(name) or self.answer.parameters.get(name)
        return found if found is not None and found.value is not None else None

    def std(self, name: str) -> float:
        """Return the standard deviation of a fitted parameter of the chain."""
        k = self.found.names.index(name)
        return math.sqrt(max(sum(float(part.covariance[k, k]) for part in self.parts), 0.0))

    @property
    def within_resolution(self) -> bool:
        """Whether the residual is no more than the resolution of the sensor."""
        own = self.data.quantum / math.sqrt(12)
        left = self.data.motion - self.found.motion
        return own > 0 and float(np.nanstd(left)) < math.sqrt(limits.MAX_RESOLUTION_VARIANCE) * own


def refuse_unexplained(context: EstimateContext) -> None:
    """Refuse an estimate that does not explain the recording."""
    fitted = max(
        context.percent.estimation or 0.0,
        compute_explained_percent(context.data, context.found.motion),
    )
    where = name_records(context.group)
    enough = fitted >= limits.MIN_FIT or context.within_resolution
    if not enough and not _is_nearly_constant(context):
        if estimate_white_share(context.data) > MIN_REST_NOISE_SHARE:
            raise InsufficientExcitationError(
                f"{where}: the motor is at rest, its sensor shows only noise; raise the voltage"
            )
        _refuse_angle(where, context.group)
        raise SignalError(
            f"{where}: the voltage does not explain the motion (fit {fitted:.0f} %); check "
            "that voltage and encoder belong to the same motor, that the driver applies the "
            "command, and that nothing else drives the motor"
        )
    offset = abs(context.found.chain.values.get("current_offset", 0.0))
    if offset and context.data.current is not None:
        largest = float(np.nanmax(np.abs(context.data.current)))
        if offset > limits.MAX_CURRENT_OFFSET * max(largest - offset, 1e-12):
            raise CurrentError(
                f"{where}: current has an offset of {format_figure(offset)} A where it reaches "
                f"{format_figure(largest)} A; zero the current sensor at rest and record again"
            )
    if context.quantity("dc_gain") is None and context.quantity("steady_speed") is None:
        _refuse_angle(where, context.group)
        raise InsufficientExcitationError(
            f"{where}: the data do not determine the DC gain; record a longer excitation with "
            "several frequencies, in both directions and well above the friction"
        )


def _refuse_angle(where: str, group: Sequence[Record]) -> None:
    """Refuse records with a mapped speed that a motor's angle explains."""
    if any(r.velocity is None or r.count is not None or r.position is not None for r in group):
        return
    angles = [replace(r, velocity=None, position=r.velocity) for r in group]
    data = prepare(angles, use_current=False)
    for chain in guess_motors(data, 1):
        found = fit(data, approach(data, chain, data.scales(1.0), data.initial), rounds=1)
        if compute_explained_percent(data, found.motion) > limits.MIN_RELIABLE_FIT:
            raise SignalError(
                f"{where}: the speed follows the voltage as an angle does; map it as position"
            )


def _is_nearly_constant(context: EstimateContext) -> bool:
    """Tell whether the speed hardly changes, so that its scatter is the sensor's."""
    speed = context.data.speed[np.isfinite(context.data.speed)]
    size = float(np.sqrt(np.mean(np.square(speed)))) if speed.size else 0.0
    return size > 0 and float(np.std(speed)) < 0.1 * size


def collect_findings(context: EstimateContext) -> list[Finding]:
    """Collect the findings on an estimate, the most severe kinds first."""
    return [
        *_check_fit(context),
        *_check_disagreement(context),
        *_check_time_constant(context),
        *_check_friction(context),
        *_check_plausibility(context),
        *_report_components(context),
        *_report_levels(context),
        *_report_driving_load(context),
        *_report_current_offset(context),
        *_report_current_scale(context),
        *_report_torque_noise(context),
        *_report_unidentified(context),
    ]


def _check_fit(context: EstimateContext) -> Iterator[Finding]:
    estimation, validation = context.percent.estimation or 0.0, context.percent.validation
    estimation = max(estimation, compute_explained_percent(context.data, context.found.motion))
    if estimation < limits.MIN_RELIABLE_FIT and not context.within_resolution:
        yield Finding(
            "poor_fit", "unreliable",
            f"the model explains {estimation:.0f} % of the speed; at least "
            f"{limits.MIN_RELIABLE_FIT:.0f} % are expected",
            {"fit_percent": estimation, "limit": limits.MIN_RELIABLE_FIT},
            "look for a second cause of the motion, such as a load, and record the driver's output "
            "voltage",
        )  # fmt: skip
    fitted = context.percent.estimation or 0.0
    falls = validation is not None and validation < fitted - limits.MAX_VALIDATION_LOSS
    if falls and not context.within_resolution:
        yield Finding(
            "validation", "unreliable",
            f"the model explains {validation:.0f} % of the held-out speed and {fitted:.0f} % "
            "of the fitted one: the motor or its load changed, or the excitation was too poor",
            {"estimation": fitted, "validation": validation},
            "record 20 s or more of one excitation under one load",
        )  # fmt: skip


def _check_disagreement(context: EstimateContext) -> Iterator[Finding]:
    """Report significantly different parameters in parts of a record."""
    worst = max(context.scatters, key=lambda s: s.ratio, default=None)
    if worst is None or worst.ratio <= MAX_ADEQUATE_SCATTER:
        return
    spread = max(
        (q.std or 0.0) / abs(q.value or 1.0)
        for n in ("steady_speed" if context.levels.steady else "dc_gain", "time_constant")
        if (q := context.quantity(n)) is not None
    ) if context.quantity("dc_gain") else 1.0  # fmt: skip
    if spread <= MAX_NOTE_STD and leaves_only_rounding(context.data, context.found.motion):
        return  # a periodic motion repeats its rounding
    parts = {"autocorrelation": "stretches of the record", "speed": "slow and fast motion",
             "acceleration": "steady and changing motion"}  # fmt: skip
    yield Finding(
        "misfit", "unreliable" if spread > MAX_WARNING_STD
        else "warning" if spread > MAX_NOTE_STD else "note",
        f"{parts[worst.name]} disagree {math.sqrt(worst.ratio):.1f} times more than noise explains:"
        f" the model lacks an effect, and the intervals are widened to {100 * spread:.2g} %",
        {"ratio": worst.ratio, "partition": worst.name, "spread": spread},
        "record the driver's output voltage, the current, and one excitation under one load",
    )  # fmt: skip


def _check_time_constant(context: EstimateContext) -> Iterator[Finding]:
    lag = context.answer.combinations.get("time_constant")
    if lag is None or lag.value is not None or lag.ci95 is None:
        return
    low, high = lag.ci95
    quick = high < context.data.rows.step
    yield Finding(
        "lag_unknown", "warning" if quick else "unreliable",
        f"the time constant is only known to lie between {format_figure(low)} and "
        f"{format_figure(high)} s",
        {"low": low, "high": high, "sample_time": context.data.rows.step},
        "sample faster" if quick else
        "record longer, with several frequencies, in both directions and well above friction",
        ("time_constant", "time_constant_product"),
    )  # fmt: skip


def _check_friction(context: EstimateContext) -> Iterator[Finding]:
    static, most = context.quantity("static_voltage"), context.data.volts
    if static is None or (static.value or 0.0) <= MAX_STATIC_VOLTAGE_SHARE * most:
        return
    yield Finding(
        "friction_dominates", "unreliable",
        f"friction takes {static.value:.3g} V of at most {most:.3g} V; a driver that coasts "
        "between its pulses, a dead zone or a jammed gear has the same effect",
        {"static_voltage": static.value, "largest": most},
        "drive with more voltage, let the driver brake between its pulses (slow decay), or record "
        "the voltage at the terminals",
    )  # fmt: skip


def _check_plausibility(context: EstimateContext) -> Iterator[Finding]:
    gain, lag = context.quantity("dc_gain"), context.quantity("time_constant")
    static = context.quantity("static_voltage")
    if gain is None or lag is None:
        return
    friction = 0.0 if static is None else float(static.value or 0.0)
    yield from check_plausibility(
        context.group, float(gain.value or 0.0), float(lag.value or 0.0), friction
    )


def _report_components(context: EstimateContext) -> Iterator[Finding]:
    """Name every component beyond the plain motor, with its size."""
    for one in context.found.chain.components:
        if one.code in UNREPORTED_COMPONENTS:
            continue
        sizes = [text for p in one.parameters if (text := _describe_size(context, p))]
        article = "an" if one.title[0] in "aeiou" else "a"
        text = f"the recording shows {article} {one.title}" + (
            f": {', '.join(sizes)}" if sizes else ""
        )
        evidence: dict[str, float | str | None] = {
            REPORTED.get(p.name, p.name): context.found.chain.values[p.name] for p in one.parameters
        }
        severity = one.severity if _is_significant(context, one) else "note"
        yield Finding(one.code, severity, text, evidence, one.advice)


def _is_significant(context: EstimateContext, one: Component) -> bool:
    """Tell whether some parameter of a component differs from that without effect."""
    for p in one.parameters:
        if p.name in context.found.names:
            off = context.found.chain.values[p.name] - p.neutral * context.found.scales.of(p.unit)
            if abs(off) > MIN_SIGNIFICANT_SIZE * context.std(p.name):
                return True
    return not any(p.name in context.found.names for p in one.parameters)


def _describe_size(context: EstimateContext, parameter: Parameter) -> str:
    """Describe a parameter of a component with its deviation and unit."""
    name = parameter.name
    if name in UNREPORTED_PARAMETERS or name not in context.found.names:
        return ""
    reported = context.quantity(REPORTED.get(name, ""))
    if reported is not None:
        name, unit = REPORTED[name], UNITS[REPORTED[name]]
        value, std = reported.value or 0.0, reported.std or 0.0
    else:
        unit, value = parameter.unit, context.found.chain.values[name]
        std = context.std(name)
    shown = "" if unit == "1" else f" {unit}"
    return f"{name.replace('_', ' ')} {format_figure(value)} ± {format_figure(std, 2)}{shown}"


def _report_levels(context: EstimateContext) -> Iterator[Finding]:
    levels = context.levels
    if levels.steady:
        speed = context.quantity("steady_speed")
        if speed is not None:
            yield Finding(
                "one_level", "warning",
                f"one level of voltage, {levels.steady:.3g} V, determines the steady speed "
                f"({speed.value:.4g} ± {speed.std or 0.0:.2g} rad/s), but not gain and friction "
                "separately",
                {"voltage": levels.steady, "steady_speed": speed.value},
                "record two levels of voltage, or a reversal",
            )  # fmt: skip
    elif levels.one_size:
        gain = context.answer.combinations.get("dc_gain")
        shares = [s.share for s in gain.systematic if s.share] if gain is not None else []
        share = max(shares, default=0.0)
        yield Finding(
            "one_size_of_voltage", "warning",
            f"all swings of the voltage have the size {levels.one_size:.3g} V: gain and time "
            f"constant are valid there, and the gain may differ by {100 * share:.2g} % at others",
            {"voltage": levels.one_size, "share": share},
            "add levels of other sizes, or record the voltage at the terminals and state its "
            "accuracy",
        )  # fmt: skip
    elif levels.one_step:
        yield Finding(
            "one_size_of_step", "note",
            f"all steps have the size {levels.one_step:.3g} V, so a driver's ramp looks like a "
            "delay",
            {"voltage": levels.one_step}, "add steps of other sizes",
        )  # fmt: skip
    if levels.one_way and not levels.steady:
        yield Finding(
            "one_direction", "warning",
            "the motor was driven in one direction: the static voltage includes a constant load",
            {"voltage": levels.one_size or context.data.volts}, "drive both directions",
        )  # fmt: skip


def _report_driving_load(context: EstimateContext) -> Iterator[Finding]:
    """Report a load that drives the motor, found with one direction of motion."""
    load, command = context.quantity("load_voltage"), context.data.rows.command
    if not context.levels.one_way or load is None or load.value is None:
        return
    way = math.copysign(1.0, command[int(np.argmax(np.abs(command)))])
    if way * load.value < -2 * (load.std or 0.0):
        yield Finding(
            "driving_load", "unreliable",
            "the steady speed is higher than the response to changes of the voltage explains: "
            f"a load of {format_figure(abs(load.value))} V seems to drive the motor",
            {"load_voltage": load.value},
            "drive both directions, or record the voltage at the terminals",
        )  # fmt: skip


def _report_current_offset(context: EstimateContext) -> Iterator[Finding]:
    """Report the offset of the current sensor that was subtracted."""
    current = context.data.current
    if current is None or "current_offset" not in context.found.names:
        return
    offset, std = context.found.chain.values["current_offset"], context.std("current_offset")
    if abs(offset) > max(4 * std, 0.01 * float(np.nanmax(np.abs(current)))):
        yield Finding(
            "current_offset", "note",
            f"the current has an offset of {format_figure(offset)} ± {format_figure(std, 1)} A, "
            "which was subtracted",
            {"offset": offset}, "zero the current sensor at rest",
        )  # fmt: skip


def _report_current_scale(context: EstimateContext) -> Iterator[Finding]:
    """Report the effect of the current's scale, compared with an ohmmeter if given."""
    known = [
        n
        for n in SCALE_POWERS
        if (q := context.quantity(n)) is not None and q.status == "estimated"
    ]
    if "resistance" not in known:
        return
    ohmmeter = context.group[0].hardware.resistance
    found = context.quantity("resistance")
    evidence: dict[str, float | str | None] = {"of_the_scale": ", ".join(known)}
    names = ", ".join(n.replace("_", " ") for n in known)
    text = f"{names} depend on the scale of the current sensor"
    if not ohmmeter or found is None or found.value is None:
        share = max((s.share or 0.0 for s in found.systematic if s.cause == "current_scale"),
                    default=0.0) if found else 0.0  # fmt: skip
        one_size = context.levels.one_size > 0
        if one_size:
            text += ", or with the duty cycle if it measures the supply"
        yield Finding(
            "current_scale", "warning" if one_size else "note",
            f"{text}, assumed accurate to {100 * share:.2g} %", evidence,
            "state the sensor's accuracy (`current_accuracy`), or measure the resistance by "
            "ohmmeter (`resistance`)",
        )  # fmt: skip
        return
    scale = ohmmeter / found.value
    far = limits.RESISTANCE_BAND + limits.CI95_HALF_WIDTH * (found.std or 0.0) / found.value
    off = abs(scale - 1) > far
    yield Finding(
        "current_scale", "unreliable" if off else "note",
        f"{text}: by the ohmmeter's {ohmmeter:.4g} ohm its scale is {scale:.3g}",
        {**evidence, "scale": scale, "ohmmeter": ohmmeter},
        "calibrate the current sensor, or measure the resistance warm" if off else "",
        tuple(known),
    )  # fmt: skip


def _report_torque_noise(context: EstimateContext) -> Iterator[Finding]:
    """Report a fluctuating load: coloured noise of the speed beyond the sensor's."""
    acceleration = estimate_acceleration_noise(context.data, context.found)
    if acceleration <= 0:
        return
    yield Finding(
        "torque_noise", "note",
        f"the load fluctuates: the acceleration scatters by {format_figure(acceleration)} rad/s^2 "
        "over a second, which limits the accuracy",
        {"acceleration": acceleration},
        "hold the load constant, or record longer",
    )  # fmt: skip


def estimate_acceleration_noise(data: Data, found: Fit) -> float:
    """Return the density of a fluctuating acceleration [rad/s^2 s^0.5], 0 where none shows.

    A speed that forgets within tau has the variance ``a^2 tau / 2`` of white acceleration a.
    """
    if found.noise[0].order == 0:
        return 0.0
    step, at = data.rows.step, data.known[0]
    width = max(int(found.scales.lag / step / 4), 1)
    if at.size < 4 * width:
        return 0.0
    filled = np.interp(np.arange(len(data)), at, (data.motion - found.motion)[at])
    if data.is_angle:
        filled = np.diff(filled) / step
    smooth = np.convolve(filled, np.ones(width) / width, mode="valid")
    white = float(np.var(np.diff(filled))) / 2 / width
    variance = float(np.var(smooth)) - (white / width if data.is_angle else white)
    if variance <= 0.5 * float(np.var(smooth)):
        return 0.0
    return math.sqrt(2 * variance / found.scales.lag)


def _report_unidentified(context: EstimateContext) -> Iterator[Finding]:
    missing = [n for n in PHYSICAL if context.answer.parameters[n].status == "unidentifiable"]
    if not missing:
        return
    names = ", ".join(n.replace("_", " ") for n in missing)
    if context.data.current is None:
        yield Finding(
            "not_separable", "note",
            f"voltage and speed alone cannot separate {names}: many motors respond alike",
            {}, "record the motor current too, or use the combinations, which are known",
        )  # fmt: skip
    else:
        yield Finding(
            "weak_excitation", "note", f"these data do not identify {names}", {},
            "sample faster, and excite harder, over more frequencies and in both directions",
        )  # fmt: skip
