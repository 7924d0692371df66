r"""Feed-forward and reference: what makes wheels arrive together and without overshoot.

The feed-forward is the motor's own equation, ``a2 r'' + a1 r' + a0 r`` and dry friction, of the
reference r.  The wheel then follows r, and the measurement shows it later by a lag that is known:
delay, hold and averaging of the loop.  The error is taken from the reference of that long ago,
so the feedback, its integral above all, has nothing to do while the model is right, and nothing
to unwind afterwards, which is what overshoot of a well-damped loop comes from.

References
----------
.. [1] K. J. Astrom, T. Hagglund, Advanced PID Control (2006), sections 5.2 to 5.4.
.. [2] T. Flash, N. Hogan, The coordination of arm movements, J. Neuroscience 5 (1985), 1688-1703.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from smp_motor_ident.errors import DesignError
from smp_motor_ident.tune.arrays import Array
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.plant import Plant, sample
from smp_motor_ident.tune.response import Controller, minimum_jerk, simulate, step_figures

HEADROOM = 0.92
"""Share of the supply that a constant speed may use; the rest is left to the feedback."""

PEAK = 0.95
"""Share of the supply that a planned change of speed may use at its peak."""

CHANGE = 0.5
"""Share of the largest speed that the figures of a design are about."""

PEAK_RATE = 1.875
"""Peak acceleration of a minimum-jerk change of unit distance in unit time."""


@dataclass(frozen=True)
class Reference:
    """How a change of set-point is asked of a motor; at the motor shaft.

    Attributes
    ----------
    max_velocity : float
        [rad/s].
    max_acceleration : float
        [rad/s^2].
    transition_time : float
        Duration of every minimum-jerk change [s]; the acceleration limit stretches large ones.
    lag : float
        By which the measured speed follows the reference [s].
    """

    max_velocity: float
    max_acceleration: float
    transition_time: float
    lag: float


def controller_for(loop: Loop, feedback: Feedback) -> Controller:
    """Return the running controller of a loop.

    Parameters
    ----------
    loop : Loop
        Its supply is the clamp.
    feedback : Feedback
        The gains.

    Returns
    -------
    Controller
        With the anti-windup that suits the gains: [1], section 3.5.  Proportional and derivative
        action see the whole reference: it is smooth, and what the wheel shall do.
    """
    tracking = math.inf
    if feedback.i > 0 and feedback.d > 0:
        tracking = math.sqrt(feedback.d / feedback.i)
    elif feedback.i > 0 and feedback.p > 0:
        tracking = feedback.p / feedback.i
    return Controller(feedback, weight_d=1.0, limit=loop.supply_voltage, tracking=tracking)


def measured_lag(plant: Plant, loop: Loop) -> float:
    """Return how much later than the feed-forward acts the measurement shows it [s].

    Parameters
    ----------
    plant : Plant
        A batch of one.
    loop : Loop
        Delay and hold.

    Returns
    -------
    float
        Delay of loop and motor, half a sample of hold, half the averaging window.
    """
    dead = loop.expected_delay + float(plant.motors.delay[0])
    window = 0 if loop.speed_source == "observer" else plant.window
    return dead + 0.5 * loop.sample_time * (1 + window)


def duration_of(reference: Reference, distance: float) -> float:
    """Return how long a change takes: the transition time, stretched by the acceleration [s].

    Parameters
    ----------
    reference : Reference
        With its limits.
    distance : float
        Change of speed [rad/s].

    Returns
    -------
    float
    """
    stretched = PEAK_RATE * abs(distance) / reference.max_acceleration
    return max(reference.transition_time, stretched)


def planned_change(
    plant: Plant, lag: float, distance: float, duration: float, time: Array
) -> tuple[Array, Array]:
    """Return delayed reference and feed-forward of a minimum-jerk change from rest.

    Parameters
    ----------
    plant : Plant
        A batch of one.
    lag : float
        From :func:`measured_lag` [s].
    distance : float
        Change of speed [rad/s].
    duration : float
        [s].
    time : ndarray, shape (k,), [s]
        Sampling instants.

    Returns
    -------
    reference : ndarray, shape (k,), [rad/s]
    forward : ndarray, shape (k,), [V]
        Without dry friction.
    """
    m = plant.motors
    speed, rate, jerk = minimum_jerk(distance, duration, time)
    forward = float(m.a0[0]) * speed + float(m.a1[0]) * rate + float(m.a2[0]) * jerk
    return minimum_jerk(distance, duration, np.maximum(time - lag, 0.0))[0], forward


def top_speed(plant: Plant, supply: float) -> float:
    """Return the speed that a motor reaches at the headroom of the supply.

    Parameters
    ----------
    plant : Plant
        A batch of one.
    supply : float
        [V].

    Returns
    -------
    float
        At the motor shaft [rad/s].
    """
    m = plant.motors
    return float((HEADROOM * supply - m.static_voltage[0]) / m.a0[0])


def plan_reference(
    plant: Plant,
    loop: Loop,
    controller: Controller,
    *,
    max_velocity: float | None = None,
    max_acceleration: float | None = None,
    transition_time: float | None = None,
) -> Reference:
    """Return the fastest reference that the motor can follow without overshoot.

    Parameters
    ----------
    plant : Plant
        A batch of one, sampled with the loop's usual delay.
    loop : Loop
        Its supply is the limit.
    controller : Controller
        The design.
    max_velocity : float or None
        [rad/s, motor]; None takes 90 % of what the headroom reaches.
    max_acceleration : float or None
        [rad/s^2, motor]; None follows from the others.
    transition_time : float or None
        Of every change of set-point [s]; None takes the shortest.

    Returns
    -------
    Reference

    Raises
    ------
    DesignError
        When the motor cannot reach the speed or the acceleration that is asked for.
    """
    lag, ratio = measured_lag(plant, loop), loop.gear_ratio
    speed = _reachable(plant, loop, max_velocity)
    quickest = _quickest(plant, loop, controller, lag)
    steepest = _steepest(plant, loop, speed, quickest)
    if max_acceleration is not None and not 0 < max_acceleration <= steepest:
        raise DesignError(
            f"max_acceleration {max_acceleration / ratio:.4g} rad/s^2 is beyond the motor: a "
            f"change by {speed / ratio:.3g} rad/s within {PEAK:.0%} of {loop.supply_voltage:g} V "
            f"reaches {steepest / ratio:.4g} rad/s^2; ask for that or less"
        )
    if transition_time is not None and not transition_time >= quickest - 1e-9:
        raise DesignError(
            f"transition_time {transition_time:.4g} s is too short for the loop: without overshoot "
            f"a change takes at least {quickest:.3g} s; ask for that or more"
        )
    return Reference(
        max_velocity=speed,
        max_acceleration=steepest if max_acceleration is None else max_acceleration,
        transition_time=quickest if transition_time is None else transition_time,
        lag=lag,
    )


def _reachable(plant: Plant, loop: Loop, wished: float | None) -> float:
    top, ratio = top_speed(plant, loop.supply_voltage), loop.gear_ratio
    if top <= 0:
        raise DesignError(
            f"dry friction takes {plant.motors.static_voltage[0]:.3g} V of the "
            f"{loop.supply_voltage:g} V supply: the motor cannot turn; raise the supply"
        )
    if wished is not None and not 0 < wished <= top:
        raise DesignError(
            f"max_velocity {wished / ratio:.4g} rad/s is beyond the motor: {HEADROOM:.0%} of "
            f"{loop.supply_voltage:g} V reaches {top / ratio:.4g} rad/s; ask for that or less"
        )
    return 0.9 * top if wished is None else wished


def _quickest(plant: Plant, loop: Loop, controller: Controller, lag: float) -> float:
    """Return the shortest change of speed, however small, that does not overshoot [s].

    By more than one percent when the loop's delay is as usual, or one and a half when it is longer
    by the loop's doubt.
    """
    slow = float(plant.motors.a1[0] / plant.motors.a0[0])
    late = replace(loop, delay=loop.expected_delay + loop.delay_doubt)
    trials = ((plant, 1.0), (sample(plant.motors, late), 1.5))
    linear = replace(controller, limit=math.inf, tracking=math.inf)
    grain = max(0.002, loop.sample_time)
    grains = math.ceil(0.01 / grain)
    for _ in range(200):
        duration = grains * grain
        if all(_overshoot(one, linear, lag, duration, slow) <= most for one, most in trials):
            break
        grains += max(1, grains // 16)
    return round(duration, 9)


def _overshoot(
    plant: Plant, controller: Controller, lag: float, duration: float, slow: float
) -> float:
    """Return the overshoot of a change by 1 rad/s [%]."""
    T = plant.sample_time
    time = T * np.arange(int((duration + lag + 3 * slow) / T) + 2)
    reference, forward = planned_change(plant, lag, 1.0, duration, time)
    run = simulate(plant, controller, reference, forward=forward)
    return step_figures(time, run.speed[0], run.voltage[0], 1.0).overshoot


def _steepest(plant: Plant, loop: Loop, speed: float, quickest: float) -> float:
    """Return the largest acceleration that no change up to ``speed`` takes beyond the supply."""
    room = PEAK * loop.supply_voltage - float(plant.motors.static_voltage[0])
    highest = PEAK_RATE * speed / quickest
    rates = highest * np.geomspace(1.0, 0.01, 200)
    for rate in rates:
        # A change that just takes the shortest time has the most jerk for its acceleration.
        changes = np.geomspace(rate * quickest / PEAK_RATE, speed, 4)
        if all(_voltage(plant, c, PEAK_RATE * c / rate) <= room for c in changes):
            return float(rate)
    return float(rates[-1])


def _voltage(plant: Plant, distance: float, duration: float) -> float:
    """Return the largest voltage of a change, without dry friction."""
    time = np.linspace(0.0, duration, 100)
    return float(planned_change(plant, 0.0, distance, duration, time)[1].max())
