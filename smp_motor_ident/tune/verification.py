# SPDX-License-Identifier: Apache-2.0
"""Compare a drive on new gains with the bands of the design, change by change.

The prediction is the running loop on simulated motors, the nominal one and uncertain ones, with
the same encoder and the same evaluation.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import savgol_filter
from scipy.special import stdtrit

from smp_motor_control.arrays import Array
from smp_motor_control.encoder import Encoder
from smp_motor_control.fields import build_settings, parameters_in
from smp_motor_control.motor.file import MotorEntry
from smp_motor_control.motor.hardware import DrivenMotor, DriveSettings
from smp_motor_control.motor.parameters import Gearbox, MotorParameters
from smp_motor_control.parameter_file import flatten
from smp_motor_control.wheel.loop import LoopSettings, WheelLoop
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import (
    DRIVE_LEVEL,
    MAX_COMMAND_ERROR,
    MAX_PLANNED_OVERSHOOT,
    MAX_SILENCE,
    MAX_STEADY_ERROR,
    SETTLING_BAND,
)
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune.motors import draw_motors, make_motors
from smp_motor_ident.tune.simulation import settling_time

SMOOTHING_S = 0.05  # length [s] of the fitted parabola whose slope is the speed

STEADY_TIME_S = 0.3  # steady end of a change [s]

DRAWS = 12  # motors in addition to the nominal one

MAX_UNKNOWN_SHARE = 0.1  # largest share of samples whose voltage matches no command

_TIMING = "raise the scheduling_priority of the wheels' nodes, and reduce the load of the network"

_WHEEL_ADVICE = (
    "look at the curves in the report: a wheel that touches something, a battery that sags or a "
    "motor that changed since; then commission again"
)

RESOLUTION_SIGMAS = 3.0  # allowed error of a reading, in standard deviations of the resolution


@dataclass(frozen=True)
class Reading:
    """Figures of one change of set-point: measured, or the largest allowed by the design."""

    settling: float  # until it stays within a tolerance [s]; infinite where it does not
    overshoot: float  # beyond the set-point [% of the change]
    error: float  # mean distance from the set-point at the end [% of the change]


@dataclass(frozen=True, eq=False)
class Change:
    """One change of set-point of one wheel: its predicted and its recorded response."""

    wheel: str
    name: str  # of the change in the drive
    setpoint: float  # [rad/s, wheel]
    time: Array  # since the change [s]
    speed: Array  # as measured [rad/s, wheel]
    low: Array  # least of the predictions [rad/s]
    nominal: Array  # as predicted for the motor as identified [rad/s]
    high: Array  # largest of the predictions [rad/s]
    reading: Reading  # of the measured speed
    expected: Reading  # of the motor as identified, with this drive's own samples
    bands: Reading  # largest values allowed, with the record's resolution added
    tolerance: float  # within which both count as settled [share of the change]
    excess: float  # overshoot of the nominal motor beyond the design's [% of the change]


def smooth_speed(time: Array, angle: Array, step: float) -> tuple[Array, Array]:
    """Return instants at an even distance and the speed there, from angles at any."""
    even = np.arange(time[0], time[-1], step)
    window = max(2 * round(SMOOTHING_S / step / 2) + 1, 5)
    held = np.interp(even, time, angle)
    speed = savgol_filter(held, window, 2, deriv=1, delta=step)
    return even, np.asarray(speed, dtype=np.float64)


def resolution(quantum: float, step: float) -> float:
    """Return the standard deviation of a smoothed speed by its encoder's steps [rad/s].

    The slope of a parabola over n samples: ``sqrt(12 / n^3) / step`` of the deviation of one,
    which is ``quantum / sqrt(12)``.
    """
    n = max(2 * round(SMOOTHING_S / step / 2) + 1, 5)
    return float(quantum / (step * n**1.5))


def read(time: Array, speed: Array, setpoint: float, tolerance: float) -> Reading:
    """Read a change from zero at time zero; ``tolerance`` is a share of the set-point."""
    relative = speed / setpoint
    settling = settling_time(time, relative, tolerance)
    late = time > time[-1] - STEADY_TIME_S
    return Reading(
        settling=math.inf if math.isnan(settling) else settling,
        overshoot=float(max(100 * (relative.max() - 1.0), 0.0)),
        error=float(100 * abs(relative[late].mean() - 1.0)),
    )


def measure_arrival_delays(
    answers: tuple[Array, Array, Array], applied: tuple[Array, Array], loop: Mapping[str, Any]
) -> Array:
    """Return the time from each sample until the motor received the answer.

    Commands that wait in the queues of a busy computer act late, which only the voltages that the
    driver reports show.  ``answers`` are times of the answered samples [s], how old these
    were when answered [s] and commands [V], each of shape (m,); ``applied`` times of the samples
    [s] and mean voltages over the intervals that end there [V], each of shape (n,).  Where the
    voltages are not the commands' (measured ones, say, or none inside a driver's dead zone) it is
    the ages, and the loop's usual delay at least.
    """
    (asked, ages, commands), (time, voltage) = answers, applied
    sent = asked + ages
    usual = np.maximum(ages, float(loop.get("usual_delay") or loop["delay"]))
    step = MAX_COMMAND_ERROR * float(loop["supply_voltage"])
    effective = np.zeros(time.size, dtype=np.intp)
    strange, unknown = 0, np.zeros(time.size, dtype=np.bool_)
    for k in range(1, time.size):
        last = int(np.searchsorted(sent, time[k - 1], side="right"))
        alike = np.flatnonzero(np.abs(commands[effective[k - 1] : last] - voltage[k]) <= step)
        newest = abs(commands[max(last - 1, 0)] - voltage[k]) <= step
        strange += last > 0 and not alike.size
        # No voltage may be an old command's, or a new one's in a dead zone.
        unknown[k] = last > 0 and not newest and (not alike.size or abs(voltage[k]) <= step)
        effective[k] = effective[k - 1] + (alike[-1] if alike.size else 0)
    if strange > MAX_UNKNOWN_SHARE * time.size:
        return usual
    first = np.searchsorted(effective, np.arange(asked.size), side="left")
    begun = time[np.clip(first - 1, 0, time.size - 1)]
    so_far = np.concatenate(([0], np.cumsum(unknown)))
    matched = so_far[first] == so_far[np.minimum(np.searchsorted(time, sent, side="right"), first)]
    return np.where((first < time.size) & matched, np.maximum(ages, begun - asked), usual)


def predict_speed(
    estimate: Estimate,
    parameters: Mapping[str, Any],
    loop: Mapping[str, Any],
    setpoints: Array,
    answers: tuple[Array, Array],
    time: Array,
) -> Array:
    """Return the wheel's speed [rad/s] in a drive from rest, shape (1 + DRAWS, k), nominal first.

    ``parameters`` and ``loop`` are the wheel's in ``gains.yaml`` and ``gains.json``; ``answers``
    are the recorded drive's sampling times and the delays until each command acted, NaN for lost
    ones.  The loop starts during the rest before the first change.
    """
    instants, delays = answers
    step = float(loop["sample_time"])
    settings = loop_settings(parameters)
    rows = []
    for k, entry in enumerate(_draw_entries(estimate, float(loop["supply_voltage"]))):
        phase = k / (1 + DRAWS)  # unknown fraction of a count at the start
        angle = _simulate_loop(entry, settings, setpoints, instants, delays, phase)
        even, speed = smooth_speed(instants, angle, step)
        rows.append(np.interp(time, even, speed))
    return np.array(rows)


def _simulate_loop(
    entry: MotorEntry, settings: LoopSettings, setpoints: Array, instants: Array, delays: Array,
    phase: float,
) -> Array:  # fmt: skip
    """Return the wheel's angle as its encoder shows it, from rest within a count."""
    begin = float(instants[0])
    plant = DrivenMotor(entry, DriveSettings(command_timeout=math.inf), start=begin)
    plant.motor.angle = phase * entry.encoder.angle_per_count
    limit = entry.supply_voltage
    loop = WheelLoop(settings.clamp_to_supply(limit), entry.gearbox, entry.encoder, 1.5 * limit)
    turn = entry.gearbox.to_wheel(entry.encoder.angle_per_count)
    angle, before, arrival = np.empty(instants.size), begin, begin
    samples = zip(instants.tolist(), delays.tolist(), setpoints.tolist(), strict=True)
    for k, (time, delay, setpoint) in enumerate(samples):
        sample = plant.sample(time)
        angle[k] = turn * sample.encoder_count
        if time == begin or math.isnan(delay):
            continue
        dt, before = time - before, time
        speed = loop.speed(dt, sample.velocity, sample.encoder_count, sample.voltage)
        if not math.isnan(speed):
            arrival = max(arrival, time + delay)
            plant.command(arrival, loop.step(setpoint, speed, dt).output)
    return angle


def compute_bands(
    rows: Array, time: Array, setpoint: float, specification: Mapping[str, Any], unsure: float
) -> Reading:
    """Return the largest readings within the design and the uncertainty of the motor.

    Simulations, as :func:`predict_speed` returns them, give prediction limits; the effects of
    sampling and of the resolution of the speed, ``unsure`` [rad/s], are added.
    """
    margin = RESOLUTION_SIGMAS * unsure / abs(setpoint)
    simulated = [read(time, row, setpoint, SETTLING_BAND + margin) for row in rows]
    settling = [one.settling for one in simulated] + [_read_limit(specification, "settling")]
    overshoot = [one.overshoot for one in simulated] + [_read_limit(specification, "overshoot")]
    step = float(np.median(np.diff(time)))
    return Reading(
        settling=max(*settling, _limit(settling[:-1])) + 2 * step,
        overshoot=max(*overshoot, _limit(overshoot[:-1])) + 100 * (MAX_PLANNED_OVERSHOOT + margin),
        error=_limit([one.error for one in simulated]) + 100 * (MAX_STEADY_ERROR + margin),
    )


def _limit(readings: Sequence[float]) -> float:
    """Return the upper prediction limit of one more reading (Hahn, Meeker 1991, section 4.8)."""
    n = len(readings)
    if not math.isfinite(sum(readings)):
        return math.inf
    quantile = float(stdtrit(n - 1, 1 - DRIVE_LEVEL))
    return float(np.mean(readings) + quantile * np.std(readings, ddof=1) * math.sqrt(1 + 1 / n))


def read_change(
    wheel: str, name: str, setpoint: float, time: Array, speed: Array, rows: Array,
    specification: Mapping[str, Any], unsure: float,
) -> Change:  # fmt: skip
    """Return a change from rest, with its reading and its bands."""
    # The planned overshoot does not count as unsettled.
    tolerance = SETTLING_BAND + MAX_PLANNED_OVERSHOOT + RESOLUTION_SIGMAS * unsure / abs(setpoint)
    expected = read(time, rows[0], setpoint, tolerance)
    return Change(
        wheel, name, setpoint, time, speed, rows.min(axis=0), rows[0], rows.max(axis=0),
        read(time, speed, setpoint, tolerance),
        expected,
        compute_bands(rows, time, setpoint, specification, unsure),
        tolerance,
        expected.overshoot
        - _read_limit(specification, "overshoot")
        - 100 * (tolerance - SETTLING_BAND),
    )  # fmt: skip


def _read_limit(specification: Mapping[str, Any], name: str) -> float:
    value = specification[name]["high"]
    return 0.0 if value is None else float(value)


def judge(changes: Sequence[Change]) -> list[Finding]:
    """Return findings on readings beyond their bands."""
    found = []
    for one in changes:
        for name, unit, words in (
            ("settling", "s", "settles after"),
            ("overshoot", "%", "overshoots by"),
            ("error", "%", "stays off its set-point by"),
        ):
            value, most = getattr(one.reading, name), getattr(one.bands, name)
            if not value <= most:
                text = f"{value:.3g} {unit}" if math.isfinite(value) else "more than was recorded"
                found.append(Finding(
                    "verification", "refused",
                    f"{one.wheel}: {one.name} to {one.setpoint:.3g} rad/s {words} {text}; the "
                    f"design allows {most:.3g} {unit}",
                    {"wheel": one.wheel, "value": value if math.isfinite(value) else None,
                     "limit": most},
                    _TIMING if one.excess > 0.0 else _WHEEL_ADVICE,
                ))  # fmt: skip
    return found


def report_loop_delay(changes: Sequence[Change]) -> list[Finding]:
    """Report overshoot caused by the drive's own timing, for which the bands allow."""
    worst = max(changes, key=lambda one: one.excess)
    if worst.excess <= 0.0:
        return []
    text = (
        f"{worst.wheel}: {worst.name}: the delays of samples and commands alone cause an overshoot "
        f"{worst.excess:.3g} % above the specification"
    )
    return [Finding("loop_delay", "warning", text, {"excess": worst.excess}, _TIMING)]


def report_silence(silence: float) -> list[Finding]:
    """Return the finding where a wheel was without control for a while [s]."""
    if silence <= MAX_SILENCE:
        return []
    evidence = {"silence": silence, "limit": MAX_SILENCE}
    text = f"a wheel received no command for {silence:.2f} s, so the drive does not test the gains"
    return [Finding("verification_disturbed", "refused", text, evidence, _TIMING)]


def loop_settings(parameters: Mapping[str, Any]) -> LoopSettings:
    """Return the running loop of a wheel's parameters, as ``tune`` writes them."""
    usual = {name: one.default for name, one in parameters_in(LoopSettings).items()}
    return build_settings(LoopSettings, usual | flatten(parameters))


def _draw_entries(estimate: Estimate, supply: float) -> list[MotorEntry]:
    """Return the nominal motor and draws of the estimate's uncertainty."""
    nominal = make_motors(estimate)
    drawn = draw_motors(estimate, DRAWS, np.random.default_rng(0))
    hardware = estimate.hardware
    gearbox = Gearbox(hardware.gear_ratio)
    encoder = Encoder(hardware.counts_per_revolution or 1e6, 0)
    entries = []
    for batch in (nominal, *([nominal] * DRAWS if drawn is None else [drawn])):
        for k in range(len(batch)):
            combined = batch.combine(k)
            delay = combined.pop("delay")
            motor = MotorParameters.from_combinations(**combined)
            entries.append(MotorEntry(motor, gearbox, encoder, supply, delay))
    return entries
