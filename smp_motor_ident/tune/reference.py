# SPDX-License-Identifier: Apache-2.0
r"""Plan feed-forward and reference, so that wheels arrive together and without overshoot.

The feed-forward is the motor's own equation, ``a2 r'' + a1 r' + a0 r`` and dry friction, of the
reference r.  The wheel then follows r, and the measurement lags behind it by the delay and the
averaging of the loop.  The error is taken from the reference delayed by this lag.  While the model
is right the integral stays unchanged, and nothing has to unwind afterwards, which is the cause of
overshoot in a well-damped loop.

References
----------
.. [1] K. J. Astrom, T. Hagglund, Advanced PID Control (2006), sections 5.2 to 5.4.
.. [2] T. Flash, N. Hogan, The coordination of arm movements, J. Neuroscience 5 (1985), 1688-1703.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_control.reference import minimum_jerk
from smp_motor_control.reference.minimum_jerk import PEAK_ACCELERATION
from smp_motor_control.reference.profile import Drive, Profile, ProfileLimits
from smp_motor_control.wheel.loop import MAX_TRANSITION_S
from smp_motor_ident.errors import DesignError
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.plant import Plant, sample
from smp_motor_ident.tune.problem import check_target, compute_measured_lag
from smp_motor_ident.tune.simulation import Controller, Inputs, simulate, step_figures

STEADY_VOLTAGE_SHARE = 0.92
"""Share of the supply for a constant speed; the rest is left to the feedback."""

PEAK_VOLTAGE_SHARE = 0.95  # share of the supply for the peak of a planned change of speed

STEP_SHARE = 0.5  # change of set-point of the figures of a design, as a share of the top speed


@dataclass(frozen=True)
class Reference:
    """Limits and duration of planned changes of set-point, at the motor shaft."""

    max_velocity: float  # [rad/s]
    max_acceleration: float  # [rad/s^2]; infinite where voltage alone limits
    # Duration of every minimum-jerk change [s]; larger ones are made as fast as limits allow
    transition_time: float
    lag: float  # lag of the measured speed behind the reference [s]
    doubt: float  # error of that lag which the feedback ignores [s]
    drive: Drive  # motor and voltage limit for large changes

    def at_wheel(self, gear_ratio: float) -> "Reference":
        """Return the same at the wheel."""
        return replace(
            self,
            max_velocity=self.max_velocity / gear_ratio,
            max_acceleration=self.max_acceleration / gear_ratio,
            drive=replace(self.drive, top_speed=self.drive.top_speed / gear_ratio),
        )

    def duration(self, change: float, sample_time: float) -> float:
        """Return how long a change of set-point from rest is planned to take [s]."""
        profile = self.profile()
        profile.set_target(change, sample_time)
        return profile.duration

    def profile(self) -> Profile:
        """Return the reference as the running loop leads it, at rest at zero."""
        limits = ProfileLimits(acceleration=self.max_acceleration)
        return Profile(limits, self.transition_time, self.drive)


def controller_for(loop: Loop, feedback: Feedback) -> Controller:
    """Return the running controller of a loop."""
    tracking = math.inf
    if feedback.i > 0 and feedback.d > 0:
        tracking = math.sqrt(feedback.d / feedback.i)
    elif feedback.i > 0 and feedback.p > 0:
        tracking = feedback.p / feedback.i
    return Controller(feedback, weight_d=1.0, limit=loop.supply_voltage, tracking=tracking)


@dataclass(frozen=True, eq=False)
class Change:
    """A planned change of set-point from rest, at the sampling instants; each of shape (k,)."""

    # low, reference, high: [rad/s]: set-point of the feedback, and bounds of its dead band
    low: Array
    reference: Array
    high: Array
    forward: Array  # [V]: Feed-forward without dry friction
    friction: Array  # [-]: Share of the voltage against dry friction that is fed forward

    @property
    def inputs(self) -> Inputs:
        """Inputs of the loop."""
        return Inputs(self.low, self.high, self.forward)


def planned_change(plant: Plant, plan: Reference, distance: float, time: Array) -> Change:
    """Return the running loop's plan for a change of set-point from rest."""
    m, T = plant.motors, plant.sample_time
    profile = plan.profile()
    profile.set_target(distance, T)
    rows = [profile.ahead(k * T) for k in range(time.size + 1)]
    speed, rate = np.array([(r.velocity, r.acceleration) for r in rows]).T
    gained, turned = np.diff(speed), np.diff(rate)
    forward = float(m.a0[0]) * (0.5 * (speed[1:] + speed[:-1]) - T / 12 * turned)
    forward = forward + (float(m.a1[0]) * gained + float(m.a2[0]) * turned) / T
    around = [
        np.interp(time - plan.lag - late, time, speed[:-1])
        for late in (plan.doubt, 0.0, -min(plan.doubt, plan.lag))
    ]
    low, high = np.min(around, axis=0), np.max(around, axis=0)
    # From rest the running loop leads along a ramp, limited by the rise of its current.
    electrical = float(m.a2[0] / m.a1[0])
    reach = np.abs(rate) * max(0.25 * electrical, 0.5 * T)
    share = np.clip(np.divide(speed, reach, out=np.sign(speed), where=reach != 0), -1.0, 1.0)
    friction = 0.5 * (share[1:] + share[:-1]) + electrical * np.diff(share) / T
    return Change(low, around[1], high, forward, friction)


def plan_reference(
    plants: Sequence[Plant],
    loop: Loop,
    controller: Controller,
    targets: Mapping[str, Any],
    least: float,
    drive: float = math.inf,
    slew: float = math.inf,
) -> Reference:
    """Return the fastest reference, of ``least`` seconds at least, that causes no overshoot.

    It is planned for the first of ``plants`` and holds for the others.  The voltage beyond back-EMF
    and friction is at most ``drive``, its rate at most ``slew`` [V/s].
    """
    plant = plants[0]
    ratio = loop.gear_ratio
    asked = (check_target(targets, name) for name in ("max_velocity", "max_acceleration"))
    speed, rate = (None if one is None else one * ratio for one in asked)
    duration = check_target(targets, "transition_time")
    m = plant.motors
    plan = Reference(
        max_velocity=_limit_velocity(plant, loop, speed),
        max_acceleration=math.inf,
        transition_time=0.0,
        lag=compute_measured_lag(plant, loop.expected_delay),
        doubt=0.0 if targets.get("together") else loop.delay_doubt,
        drive=Drive(
            top_speed=(PEAK_VOLTAGE_SHARE * loop.supply_voltage - float(m.static_voltage[0]))
            / float(m.a0[0]),
            time_constant=float(m.a1[0] / m.a0[0]),
            time_constant_product=float(m.a2[0] / m.a0[0]),
        ),
    )
    plan = _find_shortest(plants, loop, controller, plan, least)
    quickest = plan.transition_time
    if rate is not None or math.isfinite(min(drive, slew)):
        steepest = _limit_acceleration(plan, PEAK_VOLTAGE_SHARE * slew / float(m.a0[0]))
        steepest = min(steepest, PEAK_VOLTAGE_SHARE * drive / float(m.a1[0]))
        rate = steepest if rate is None else rate
        if rate > steepest:
            raise DesignError(
                f"max_acceleration {rate / ratio:.4g} rad/s^2 is beyond the motor: a change by "
                f"{plan.max_velocity / ratio:.3g} rad/s within {100 * PEAK_VOLTAGE_SHARE:.0f} % of "
                f"{loop.supply_voltage:g} V reaches {steepest / ratio:.4g} rad/s^2; ask for "
                "that or less"
            )
        plan = replace(plan, max_acceleration=rate)
    if duration is not None:
        if duration < quickest - 1e-9:
            raise DesignError(
                f"transition_time {duration:.4g} s is too short for the loop: without "
                f"overshoot a change takes at least {quickest:.3g} s; ask for that or more"
            )
        plan = replace(plan, transition_time=duration)
    return plan


def _limit_velocity(plant: Plant, loop: Loop, wished: float | None) -> float:
    m, ratio = plant.motors, loop.gear_ratio
    top = float((STEADY_VOLTAGE_SHARE * loop.supply_voltage - m.static_voltage[0]) / m.a0[0])
    if top <= 0:
        raise DesignError(
            f"dry friction takes {m.static_voltage[0]:.3g} V of the "
            f"{loop.supply_voltage:g} V supply: the motor cannot turn; raise the supply"
        )
    if wished is not None and wished > top:
        raise DesignError(
            f"max_velocity {wished / ratio:.4g} rad/s is beyond the motor: "
            f"{100 * STEADY_VOLTAGE_SHARE:.0f} % of {loop.supply_voltage:g} V reaches "
            f"{top / ratio:.4g} rad/s; ask for that or less"
        )
    return 0.9 * top if wished is None else wished


def _find_shortest(
    plants: Sequence[Plant], loop: Loop, controller: Controller, plan: Reference, least: float
) -> Reference:
    """Return the plan with the shortest transition that hardly overshoots.

    The limit is 1 % with the usual delay, and 1.5 % with the doubted delay or with another motor.
    """
    late = replace(loop, delay=loop.expected_delay + loop.delay_doubt)
    first, *others = plants
    trials = [(first, first, 1.0), (first, sample(first.motors, late), 1.5)]
    trials += [(first, other, 1.5) for other in others]
    linear = replace(controller, limit=math.inf, tracking=math.inf)
    grain = max(0.002, loop.sample_time)
    grains = math.ceil(max(0.01, least) / grain)
    while grains * grain <= MAX_TRANSITION_S:
        plan = replace(plan, transition_time=round(grains * grain, 9))
        if all(_measure_overshoot(led, one, linear, plan) <= most for led, one, most in trials):
            return plan
        grains += max(1, grains // 16)
    raise DesignError(
        f"every change of set-point shorter than {MAX_TRANSITION_S:g} s overshoots; ask for a "
        "larger phase_margin"
    )


def _measure_overshoot(led: Plant, plant: Plant, controller: Controller, plan: Reference) -> float:
    """Return the overshoot of a small change [%] that is planned for the plant ``led``."""
    slow, T = plan.drive.time_constant, plant.sample_time
    time = T * np.arange(
        int((plan.transition_time + plan.lag + 3 * slow) / T) + 2, dtype=np.float64
    )
    small = replace(plan, drive=replace(plan.drive, top_speed=1e9))
    change = planned_change(led, small, 1.0, time)
    run = simulate(plant, controller, change.inputs)
    return step_figures(time, run.speed[0], run.voltage[0], 1.0).overshoot


def _limit_acceleration(plan: Reference, slew: float) -> float:
    """Return the largest acceleration that keeps the voltage and its rate within their limits.

    ``slew`` is the limit of the rate, divided by the volts per speed [rad/s^2].
    """
    quickest, drive, rest = plan.transition_time, plan.drive, minimum_jerk.Reference(0.0, 0.0, 0.0)
    highest = PEAK_ACCELERATION * plan.max_velocity / quickest
    for rate in highest * np.geomspace(1.0, 0.01, 200):
        # A change that just takes the shortest time has the most jerk for its acceleration.
        for change in np.geomspace(rate * quickest / PEAK_ACCELERATION, plan.max_velocity, 4):
            motion = minimum_jerk.MinimumJerk(rest, change, PEAK_ACCELERATION * change / rate)
            instants = np.linspace(0.0, motion.duration, 100)
            needed = np.array([drive.needed(motion.at(t)) for t in instants.tolist()])
            fastest = np.abs(np.diff(needed)).max() / float(instants[1])
            if needed.max() > drive.top_speed or fastest > slew:
                break
        else:
            break
    return float(rate)
