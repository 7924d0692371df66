# SPDX-License-Identifier: Apache-2.0
"""Acceptance test of a wheel's settings by simulation on the motor's model.

The loop runs for some hundred samples on the linear model, with one sample of delay and the speed
averaged over a sample: first without clamps, to detect instability; then with them.
For any motor the clamps must include zero, and the reference must reach zero within ``stop_time``.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from smp_motor_control.encoder import Encoder
from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.parameters import Gearbox, MotorModel
from smp_motor_control.motor.response import zero_order_hold
from smp_motor_control.pid import PidGains
from smp_motor_control.reference.profile import UNLIMITED, Profile
from smp_motor_control.wheel.loop import INTERVAL_SAMPLES, LoopSettings, WheelLoop

CANDIDATE_INTERVALS_S = (0.001, 0.002, 0.005, 0.01)
"""Candidate sampling intervals; one must pass while the actual one is unknown."""

MIN_SAMPLES, MAX_SAMPLES = 250, 1500
"""Bounds of a simulation's length, nominally four time constants plus delays."""

MAX_GAIN = 1e5
"""Maximum of p, d and feed-forward [V s/rad, V s^2/rad]: 12 V for an error of 1e-4 rad/s, a
thousandth of any encoder's resolution; of i, the same per millisecond."""

MAX_SPEED_RATIO = 2.0
"""Maximum speed relative to the set-point: the peak of an undamped second-order loop."""

TYPICAL_SUPPLY_V = 12.0  # voltage assumed for a wheel with unknown supply and clamps

_FINE_ENCODER = Encoder(2.0**20)
"""Assumed for an unknown encoder, so that quantisation rejects no gains."""

_GROWTH_LIMIT = 1.02
_EXTENSION = 6  # extension of a simulation whose error still grows, for a slow integral's overshoot
_DIVERGENCE_RATIO = 1e3
_NOMINAL_MODEL = MotorModel(dc_gain=25.0, time_constant=0.05)
_NOMINAL_RATIO = 65.5
_MAX_GAINS = {
    "p": MAX_GAIN,
    "i": 1e3 * MAX_GAIN,
    "d": MAX_GAIN,
    "feedforward_static": MAX_GAIN,
    "feedforward_velocity": MAX_GAIN,
    "feedforward_acceleration": MAX_GAIN,
    "setpoint_weight_p": 1.0,
    "setpoint_weight_d": 1.0,
}


@dataclass(frozen=True)
class OperatingConditions:
    """Known hardware and sampling interval of a wheel."""

    sample_time: float = math.nan  # usual interval of feedback [s]; NaN if unknown
    supply: float = math.inf  # [V]; infinite if unknown
    gearbox: Gearbox | None = None
    encoder: Encoder | None = None


def check(settings: LoopSettings, wheel: OperatingConditions | None = None) -> None:
    """Raise for settings that are unsafe to drive a wheel with."""
    wheel = wheel or OperatingConditions()
    _check_signs(settings.gains)
    settings = settings.clamp_to_supply(wheel.supply)
    known = _model_at_wheel(settings, wheel)
    model, ratio = known or (_NOMINAL_MODEL, _NOMINAL_RATIO)
    given = wheel.sample_time
    intervals = CANDIDATE_INTERVALS_S if math.isnan(given) else (min(max(given, 1e-4), 1.0),)
    _check_stop(settings, model.dc_gain / ratio, intervals[0])
    try:
        with np.errstate(all="ignore"):
            plants = [_Plant(model, ratio, dt) for dt in intervals]
            if known and not any(_is_stable(settings, plant) for plant in plants):
                raise ParameterError(_explain_instability(settings, plants[0]))
            swing = min(_find_peak_ratio(settings, plant, wheel) for plant in plants)
    except ParameterError:
        raise
    except (ArithmeticError, ValueError) as error:  # LinAlgError is a ValueError
        raise ParameterError(
            f"the loop cannot be computed with these parameters: {error}; "
            "check those of model, observer and drive"
        ) from error
    if not math.isfinite(swing) or (known and swing > MAX_SPEED_RATIO):
        raise ParameterError(
            f"the simulated speed reaches {swing:.3g} times the set-point, and at most "
            f"{MAX_SPEED_RATIO:g} times is accepted; lower i or set antiwindup_strategy"
        )


def _check_signs(gains: PidGains) -> None:
    for name, largest in _MAX_GAINS.items():
        value = getattr(gains, name)
        least = -largest if name == "d" else 0.0
        if not least <= value <= largest:
            excess = max(value - largest, least - value)
            raise ParameterError(
                f"{name} is {value:g}; it must be in [{least:g}, {largest:g}], "
                f"and is beyond by {excess:g}"
            )


def _check_stop(settings: LoopSettings, speed_per_volt: float, dt: float) -> None:
    """Raise for clamps that exclude zero and for a reference that exceeds ``stop_time``."""
    gains, limits, drive = settings.gains, settings.limits, settings.drive
    low, high = gains.u_clamp_min, gains.u_clamp_max
    if not low <= 0.0 <= high:
        raise ParameterError(
            f"u_clamp_min is {low:g} V and u_clamp_max {high:g} V, which drives the wheel at a "
            "set-point of zero; the first must not be above zero, the second not below"
        )
    speed = min(limits.velocity, max(high, -low) * speed_per_volt)
    if drive is not None:
        speed = min(speed, drive.top_speed)
    elif not math.isfinite(speed):
        speed = min(limits.velocity, TYPICAL_SUPPLY_V * speed_per_volt)
    try:
        profile = Profile(limits, settings.transition_time, drive)
        profile.reset(speed)
        profile.set_target(0.0, dt)
    except ArithmeticError as error:
        raise ParameterError(
            f"the reference cannot be computed with these limits: {error}"
        ) from error
    lag = settings.reference_delay + settings.reference_delay_uncertainty
    taken, allowed = profile.duration + lag, settings.stop_time
    if taken > allowed + 0.5 * dt:
        times = {
            "transition_time": settings.transition_time,
            "max_acceleration": limits.acceleration if math.isfinite(limits.acceleration) else 0.0,
            "max_jerk": limits.jerk if math.isfinite(limits.jerk) else 0.0,
            "drive.time_constant": 0.0 if drive is None else drive.time_constant,
            "reference_delay": settings.reference_delay,
            "reference_delay_uncertainty": settings.reference_delay_uncertainty,
        }
        given = ", ".join(f"{name} {value:g}" for name, value in times.items() if value)
        raise ParameterError(
            f"{given}: a wheel at {speed:.3g} rad/s stops {taken:.3g} s after a set-point of "
            f"zero, and stop_time is {allowed:g} s; make it stop faster or raise stop_time"
        )


def _model_at_wheel(
    settings: LoopSettings, wheel: OperatingConditions
) -> tuple[MotorModel, float] | None:
    """Return the motor's model and the gear ratio; None if unknown."""
    gains, model = settings.gains, settings.model
    velocity, acceleration = gains.feedforward_velocity, gains.feedforward_acceleration
    if model is not None:
        if wheel.gearbox is not None:
            return model, wheel.gearbox.ratio
        return (model, velocity * model.dc_gain) if velocity > 0.0 else None
    if velocity > 0.0 and acceleration > 0.0:
        implied = MotorModel(dc_gain=1.0 / velocity, time_constant=acceleration / velocity)
        return replace(implied, static_voltage=gains.feedforward_static), 1.0
    return None


class _Plant:
    """Exact discrete motor model with one sample of delay."""

    def __init__(self, model: MotorModel, ratio: float, dt: float) -> None:
        self.dt, self.ratio, self.static = dt, ratio, model.static_voltage
        self.final = model.dc_gain / ratio
        tau, tp = model.time_constant, model.time_constant_product
        # A first-order motor gets an electrical time constant of a thousandth of its own.
        tp = max(tp, 1e-3 * tau * tau)
        held = zero_order_hold(self.final, tau, tp, dt)
        turned = np.concatenate((held.angle_transition[0], held.angle_forced))
        moved = np.column_stack((held.transition[0], held.forced[0]))
        self._advance: list[list[float]] = np.vstack((turned, moved)).tolist()
        self.samples = round(min(max(4.0 * (tau + model.delay) / dt, MIN_SAMPLES), MAX_SAMPLES))
        self._delay_samples = 1 + math.ceil(min(model.delay / dt, MAX_SAMPLES) - 1e-9)

    def rest(self) -> None:
        self.angle = self.speed = self.rate = 0.0
        self._held = [0.0] * self._delay_samples

    def step(self, voltage: float, static: float) -> float:
        """Apply a voltage; return the mean speed until the next sample."""
        self._held.append(voltage)
        drive = self._held.pop(0)
        if static:
            drive -= math.copysign(min(static, abs(drive)), self.speed or drive)
        speed, rate = self.speed, self.rate
        turned, self.speed, self.rate = (
            a * speed + b * rate + c * drive for a, b, c in self._advance
        )
        self.angle += turned
        return turned / self.dt


def _is_stable(settings: LoopSettings, plant: _Plant) -> bool:
    """Return whether the loop without clamps settles after a step, possibly on a filtered speed."""
    filtered = settings.speed_source == "measured"
    lag = settings.reference_delay - plant.dt if filtered else 0.0
    return _error_decays(settings, plant, 1.0) or (
        lag > plant.dt and _error_decays(settings, plant, 1 - math.exp(-plant.dt / lag))
    )


def _error_decays(settings: LoopSettings, plant: _Plant, share: float) -> bool:
    """Return whether the error stops growing; ``share`` is the weight of the speed's filter."""
    open_clamps = replace(
        settings.gains, u_clamp_min=-math.inf, u_clamp_max=math.inf, i_clamp_min=-math.inf,
        i_clamp_max=math.inf, antiwindup_strategy="none", error_deadband=0.0,
    )  # fmt: skip
    loop = WheelLoop(
        LoopSettings(gains=open_clamps, limits=UNLIMITED, reference_delay=settings.reference_delay)
    )
    plant.rest()
    speed = shown = 0.0
    errors: list[float] = []
    for length in (plant.samples, _EXTENSION * plant.samples):
        while len(errors) < length:
            speed = plant.step(loop.step(1.0, shown, plant.dt).output, 0.0)
            shown += share * (speed - shown)
            if not -_DIVERGENCE_RATIO < speed < _DIVERGENCE_RATIO:
                return False
            errors.append(abs(1.0 - speed))
        quarter = length // 4
        early, late = max(errors[quarter : 2 * quarter]), max(errors[-quarter:])
        if late < max(_GROWTH_LIMIT * early, 0.02):
            return True
    return False


def _explain_instability(settings: LoopSettings, plant: _Plant) -> str:
    gains = settings.gains
    low, high = 0.0, 1.0
    for _ in range(5):
        share = 0.5 * (low + high)
        scaled = replace(gains, p=share * gains.p, i=share * gains.i, d=share * gains.d)
        if _is_stable(replace(settings, gains=scaled), plant):
            low = share
        else:
            high = share
    remedy = f"it is stable with {low:.2g} times these" if low else "lower them by far"
    return (
        f"p {gains.p:g}, i {gains.i:g}, d {gains.d:g}: the loop is unstable on the motor's model "
        f"at intervals of {1e3 * plant.dt:.3g} ms; {remedy}"
    )


def _find_peak_ratio(settings: LoopSettings, plant: _Plant, wheel: OperatingConditions) -> float:
    """Return the peak speed relative to the set-point, with clamps.

    The wheel stands until an observer has learnt its interval.
    """
    encoder = wheel.encoder or _FINE_ENCODER
    loop = WheelLoop(settings, Gearbox(plant.ratio), encoder, 1.5 * wheel.supply)
    plant.rest()
    dt = plant.dt
    most = min(settings.gains.u_clamp_max, -settings.gains.u_clamp_min, TYPICAL_SUPPLY_V)
    target = max(0.2 * plant.final * max(most - plant.static, 0.0), 1e-9)
    target = min(target, settings.limits.velocity or math.inf)
    speed = voltage = fastest = 0.0
    for k in range(INTERVAL_SAMPLES + plant.samples):
        count = math.floor(plant.angle * plant.ratio / encoder.angle_per_count)
        measured = loop.speed(dt, speed, count, voltage)
        out = 0.0
        if measured == measured:
            out = loop.step(target if k >= INTERVAL_SAMPLES else 0.0, measured, dt).output
            if out - out != 0.0:
                return math.nan
        speed = plant.step(out, plant.static)
        voltage = out
        fastest = max(fastest, abs(plant.speed))
        if not fastest < _DIVERGENCE_RATIO * target:
            break
    return fastest / target
