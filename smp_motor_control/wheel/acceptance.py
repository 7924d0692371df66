"""Which settings a wheel may be given: those whose loop runs, and is stable on the motor's model.

The loop is built from the settings and run for some hundred samples on the linear model of the
motor, as the hardware shows it: the voltage acts one sample late, and the speed is the mean over
a sample.  First without clamps, where an unstable loop grows; then as it would drive.  Whatever
the motor, its clamps let the output be zero, and the reference stands ``stop_time`` after a
set-point of zero.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from smp_motor_control.encoder import Encoder
from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.model import MotorModel
from smp_motor_control.motor.parameters import Gearbox
from smp_motor_control.motor.response import zero_order_hold
from smp_motor_control.pid import PidGains
from smp_motor_control.reference.profile import UNLIMITED, Profile
from smp_motor_control.wheel.loop import LEARNING, LoopSettings, WheelLoop

RATES = (0.001, 0.002, 0.005, 0.01)
"""Sampling intervals of which one must do, where the hardware's is not known yet [s]."""

SAMPLES, MOST_SAMPLES = 250, 1500
"""Length of a trial: four time constants and delays of the motor, but between these."""

LARGEST_GAIN = 1e5
"""Of p, d and feed-forward [V s/rad, V s^2/rad]: a supply's 12 V for an error of 1e-4 rad/s, a
thousandth of what any encoder resolves; of i, the same per millisecond."""

GROSS = 2.0
"""Speed in set-points that no stable loop reaches: an undamped one of second order swings to 2."""

USUAL_SUPPLY = 12.0
"""What drives a wheel whose supply and clamps are not known [V]."""

_UNKNOWN = Encoder(2.0**20)
"""An encoder that is not known yet speaks against no gains: they may be for a fine one."""

_GROWING = 1.02
_LONGER = 6  # times a trial whose error still grows: a slow integral's overshoot is over by then
_FAR = 1e3
_NOMINAL = MotorModel(dc_gain=25.0, time_constant=0.05)
_NOMINAL_RATIO = 65.5
_LARGEST = {
    "p": LARGEST_GAIN,
    "i": 1e3 * LARGEST_GAIN,
    "d": LARGEST_GAIN,
    "feedforward_static": LARGEST_GAIN,
    "feedforward_velocity": LARGEST_GAIN,
    "feedforward_acceleration": LARGEST_GAIN,
    "setpoint_weight_p": 1.0,
    "setpoint_weight_d": 1.0,
}


@dataclass(frozen=True)
class Circumstances:
    """What is known of the wheel that the settings are for."""

    sample_time: float = math.nan  # usual interval of feedback [s]; NaN before it is known
    supply: float = math.inf  # [V]; infinite where unknown
    gearbox: Gearbox | None = None  # none where unknown
    encoder: Encoder | None = None  # none where unknown


def check(settings: LoopSettings, wheel: Circumstances | None = None) -> None:
    """Refuse settings that no wheel should be driven with."""
    wheel = wheel or Circumstances()
    _check_signs(settings.gains)
    settings = settings.within(wheel.supply)
    known = _model_at_wheel(settings, wheel)
    model, ratio = known or (_NOMINAL, _NOMINAL_RATIO)
    given = wheel.sample_time
    intervals = RATES if math.isnan(given) else (min(max(given, 1e-4), 1.0),)
    _check_stop(settings, model.dc_gain / ratio, intervals[0])
    try:
        with np.errstate(all="ignore"):
            plants = [_Plant(model, ratio, dt) for dt in intervals]
            if known and not any(_is_stable(settings, plant) for plant in plants):
                raise ParameterError(_unstable(settings, plants[0]))
            swing = min(_swing(settings, plant, wheel) for plant in plants)
    except ParameterError:
        raise
    except (ArithmeticError, ValueError) as error:  # LinAlgError is a ValueError
        raise ParameterError(
            f"the loop cannot be computed with these parameters: {error}; "
            "look at those of model, observer and drive"
        ) from error
    if not math.isfinite(swing) or (known and swing > GROSS):
        raise ParameterError(
            f"the wheel would reach {swing:.3g} times its set-point on the motor's model; at most "
            f"{GROSS:g} times is accepted: lower i, or set antiwindup_strategy"
        )


def _check_signs(gains: PidGains) -> None:
    for name, largest in _LARGEST.items():
        value = getattr(gains, name)
        least = -largest if name == "d" else 0.0
        if not least <= value <= largest:
            beyond = max(value - largest, least - value)
            raise ParameterError(
                f"{name} is {value:g}; it must be in [{least:g}, {largest:g}], "
                f"and is beyond by {beyond:g}"
            )


def _check_stop(settings: LoopSettings, speed_per_volt: float, dt: float) -> None:
    """Refuse clamps that leave no zero, and a reference that stands later than ``stop_time``."""
    gains, limits, drive = settings.gains, settings.limits, settings.drive
    low, high = gains.u_clamp_min, gains.u_clamp_max
    if not low <= 0.0 <= high:
        raise ParameterError(
            f"u_clamp_min is {low:g} V and u_clamp_max {high:g} V, so that the wheel is driven at "
            "a set-point of zero; the first must not be above zero, the second not below"
        )
    speed = min(limits.velocity, max(high, -low) * speed_per_volt)
    if drive is not None:
        speed = min(speed, drive.top_speed)
    elif not math.isfinite(speed):
        speed = min(limits.velocity, USUAL_SUPPLY * speed_per_volt)
    try:
        profile = Profile(limits, settings.transition_time, drive)
        profile.reset(speed)
        profile.set_target(0.0, dt)
    except ArithmeticError as error:
        raise ParameterError(f"no reference can be computed with these limits: {error}") from error
    lag = settings.reference_delay + settings.reference_doubt
    taken, allowed = profile.duration + lag, settings.stop_time
    if taken > allowed + 0.5 * dt:
        times = {
            "transition_time": settings.transition_time,
            "max_acceleration": limits.acceleration if math.isfinite(limits.acceleration) else 0.0,
            "max_jerk": limits.jerk if math.isfinite(limits.jerk) else 0.0,
            "drive.time_constant": 0.0 if drive is None else drive.time_constant,
            "reference_delay": settings.reference_delay,
            "reference_doubt": settings.reference_doubt,
        }
        given = ", ".join(f"{name} {value:g}" for name, value in times.items() if value)
        raise ParameterError(
            f"{given}: a wheel at {speed:.3g} rad/s stands {taken:.3g} s after a set-point of "
            f"zero, and stop_time is {allowed:g} s; let it stop faster, or give stop_time what "
            "you can wait for"
        )


def _model_at_wheel(
    settings: LoopSettings, wheel: Circumstances
) -> tuple[MotorModel, float] | None:
    """Return the motor's model and the gear ratio; None where they are not known."""
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
    """A motor by its model: exact for a voltage that is held, which acts one sample late."""

    def __init__(self, model: MotorModel, ratio: float, dt: float) -> None:
        self.dt, self.ratio, self.static = dt, ratio, model.static_voltage
        self.final = model.dc_gain / ratio
        tau, tp = model.time_constant, model.time_constant_product
        # A motor of first order gets an electrical time constant a thousandth of its own.
        tp = max(tp, 1e-3 * tau * tau)
        held = zero_order_hold(self.final, tau, tp, dt)
        turned = np.concatenate((held.angle_transition[0], held.angle_forced))
        moved = np.column_stack((held.transition[0], held.forced[0]))
        self._advance: list[list[float]] = np.vstack((turned, moved)).tolist()
        self.samples = round(min(max(4.0 * (tau + model.delay) / dt, SAMPLES), MOST_SAMPLES))
        self._late = 1 + math.ceil(min(model.delay / dt, MOST_SAMPLES) - 1e-9)

    def rest(self) -> None:
        self.angle = self.speed = self.rate = 0.0
        self._held = [0.0] * self._late

    def step(self, voltage: float, static: float) -> float:
        """Take a command; return the mean speed until the next sample."""
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
    """Tell whether the loop without clamps comes to rest after a step of its set-point.

    A measured speed may be late by a filter's lag, for which its gains are made.
    """
    filtered = settings.speed_source == "measured"
    lag = settings.reference_delay - plant.dt if filtered else 0.0
    return _settles(settings, plant, 1.0) or (
        lag > plant.dt and _settles(settings, plant, 1 - math.exp(-plant.dt / lag))
    )


def _settles(settings: LoopSettings, plant: _Plant, share: float) -> bool:
    """Tell whether the error ceases to grow, a share of the speed's change shown in a sample.

    A slow integral overshoots for longer than the motor's own response takes.
    """
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
    for length in (plant.samples, _LONGER * plant.samples):
        while len(errors) < length:
            speed = plant.step(loop.step(1.0, shown, plant.dt).output, 0.0)
            shown += share * (speed - shown)
            if not -_FAR < speed < _FAR:
                return False
            errors.append(abs(1.0 - speed))
        quarter = length // 4
        early, late = max(errors[quarter : 2 * quarter]), max(errors[-quarter:])
        if late < max(_GROWING * early, 0.02):
            return True
    return False


def _unstable(settings: LoopSettings, plant: _Plant) -> str:
    gains = settings.gains
    low, high = 0.0, 1.0
    for _ in range(5):
        share = 0.5 * (low + high)
        fewer = replace(gains, p=share * gains.p, i=share * gains.i, d=share * gains.d)
        if _is_stable(replace(settings, gains=fewer), plant):
            low = share
        else:
            high = share
    remedy = f"it is stable with {low:.2g} times these" if low else "lower them by far"
    return (
        f"p {gains.p:g}, i {gains.i:g}, d {gains.d:g}: the loop is unstable on the motor's model "
        f"at intervals of {1e3 * plant.dt:.3g} ms; {remedy}"
    )


def _swing(settings: LoopSettings, plant: _Plant, wheel: Circumstances) -> float:
    """Return the largest speed, in set-points, of the loop as it would drive the wheel.

    It stands until an observer knows its interval, as it does before the first set-point.
    """
    encoder = wheel.encoder or _UNKNOWN
    loop = WheelLoop(settings, Gearbox(plant.ratio), encoder, 1.5 * wheel.supply)
    plant.rest()
    dt = plant.dt
    most = min(settings.gains.u_clamp_max, -settings.gains.u_clamp_min, USUAL_SUPPLY)
    target = max(0.2 * plant.final * max(most - plant.static, 0.0), 1e-9)
    target = min(target, settings.limits.velocity or math.inf)
    speed = voltage = fastest = 0.0
    for k in range(LEARNING + plant.samples):
        count = math.floor(plant.angle * plant.ratio / encoder.angle_per_count)
        measured = loop.speed(dt, speed, count, voltage)
        out = 0.0
        if measured == measured:
            out = loop.step(target if k >= LEARNING else 0.0, measured, dt).output
            if out - out != 0.0:
                return math.nan
        speed = plant.step(out, plant.static)
        voltage = out
        fastest = max(fastest, abs(plant.speed))
        if not fastest < _FAR * target:
            break
    return fastest / target
