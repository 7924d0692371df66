r"""Feed-forward, set-point weight and reference: what makes a wheel arrive without overshoot.

With ``y = e^{-h s} r`` wanted, hold and delay ``d`` in the forward path and a measurement that
lags by ``m``, the path from the reference must be

.. math:: F(s) + b p + i / s = (a_2 s^2 + a_1 s + a_0) e^{-(h-d) s} + C(s) e^{-(h+m) s} .

``F = velocity + acceleration s`` and the weight ``b`` match the powers -1, 0 and 1 of s; the lag
``h`` is the one at which power 2 vanishes as well.  The integral then has nothing to unwind, which
is what overshoot of a well-damped loop comes from.

References
----------
.. [1] K. J. Astrom, T. Hagglund, Advanced PID Control (2006), sections 5.2 to 5.4.
.. [2] T. Flash, N. Hogan, The coordination of arm movements, J. Neuroscience 5 (1985), 1688-1703.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from smp_motor_ident.errors import DesignError
from smp_motor_ident.tune.arrays import Array
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.plant import Plant
from smp_motor_ident.tune.response import TwoDegrees, minimum_jerk, simulate, step_figures

HEADROOM = 0.92
"""Share of the supply that a constant speed may use; the rest is left to the feedback."""

PEAK = 0.97
"""Share of the supply that a planned change of speed may use at its peak."""

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
        Duration of the minimum-jerk change [s].
    lag : float
        By which the wheel follows the reference [s].
    """

    max_velocity: float
    max_acceleration: float
    transition_time: float
    lag: float


def two_degrees(
    plant: Plant, loop: Loop, feedback: Feedback, lag: float | None = None
) -> tuple[TwoDegrees, float]:
    """Return the controller whose set-point path is a pure lag to second order, and the lag.

    Parameters
    ----------
    plant : Plant
        A batch of one.
    loop : Loop
        Delay, hold and supply.
    feedback : Feedback
        The gains that act on the measurement.
    lag : float or None
        Lag to realise [s], for wheels that shall go together; None takes the shortest natural.

    Returns
    -------
    controller : TwoDegrees
    lag : float
        [s].
    """
    lag = _natural_lag(plant, loop, feedback) if lag is None else lag
    constant, linear, _ = _powers(plant, loop, feedback, np.array([lag]))
    a0 = float(plant.motors.a0[0])
    weight = (float(constant[0]) - a0) / feedback.p if feedback.p > 0 else 1.0
    controller = TwoDegrees(
        feedback=feedback,
        weight=float(np.clip(weight, 0.0, 1.0)),
        velocity=a0,
        acceleration=max(float(linear[0]), 0.0),
        limit=loop.supply_voltage,
        tracking=tracking_time(feedback),
    )
    return controller, lag


def tracking_time(feedback: Feedback) -> float:
    """Return the time constant of back-calculation: the rule of thumb of [1], section 3.5."""
    if feedback.i <= 0:
        return math.inf
    if feedback.d > 0:
        return math.sqrt(feedback.d / feedback.i)
    return feedback.p / feedback.i if feedback.p > 0 else math.inf


def _powers(plant: Plant, loop: Loop, feedback: Feedback, lag: Array) -> tuple[Array, Array, Array]:
    """Return the coefficients of powers 0, 1 and 2 of s that the reference path must have."""
    m, T, window = plant.motors, plant.sample_time, plant.window
    a0, a1, a2 = float(m.a0[0]), float(m.a1[0]), float(m.a2[0])
    early = lag - (loop.loop_delay + 0.5 * T)  # the hold acts half a sample late
    late = lag + 0.5 * T * window
    late_d = late + feedback.filter_time + 0.5 * T
    p = feedback.p - 0.5 * T * feedback.i  # the forward-Euler sum lags the integral by T / 2
    i, d = feedback.i, feedback.d
    constant = a0 + feedback.p - i * late
    linear = a1 - a0 * early + d - p * late + 0.5 * i * late**2
    square = a2 - a1 * early + 0.5 * a0 * early**2 - d * late_d + 0.5 * p * late**2
    return constant, linear, square - i * late**3 / 6


def _natural_lag(plant: Plant, loop: Loop, feedback: Feedback) -> float:
    m = plant.motors
    slow = float(m.a1[0] / m.a0[0])
    lags = np.linspace(0.0, loop.loop_delay + float(m.delay[0]) + slow, 2000)
    square = _powers(plant, loop, feedback, lags)[2]
    roots = np.flatnonzero(np.diff(np.sign(square)))
    return float(lags[roots[0]] if roots.size else lags[np.argmin(np.abs(square))])


def top_speed(plant: Plant, supply: float) -> float:
    """Return the speed that a motor reaches at the headroom of the supply [rad/s]."""
    m = plant.motors
    return float((HEADROOM * supply - m.static_voltage[0]) / m.a0[0])


def plan_reference(
    plant: Plant,
    loop: Loop,
    controller: TwoDegrees,
    lag: float,
    *,
    max_velocity: float | None = None,
    max_acceleration: float | None = None,
    transition_time: float | None = None,
) -> Reference:
    """Return the fastest reference that the motor can follow without overshoot.

    Parameters
    ----------
    plant : Plant
        A batch of one.
    loop : Loop
        Its supply is the limit.
    controller : TwoDegrees
        With feed-forward.
    lag : float
        From :func:`two_degrees` [s].
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
    top = top_speed(plant, loop.supply_voltage)
    if top <= 0:
        raise DesignError(
            f"dry friction takes {plant.motors.static_voltage[0]:.3g} V of the "
            f"{loop.supply_voltage:g} V supply: the motor cannot turn; raise the supply"
        )
    if max_velocity is not None and max_velocity > top:
        raise DesignError(
            f"max_velocity {max_velocity / loop.gear_ratio:.4g} rad/s is beyond the motor: "
            f"{HEADROOM:.0%} of {loop.supply_voltage:g} V reaches {top / loop.gear_ratio:.4g} "
            "rad/s; ask for that or less"
        )
    speed = 0.9 * top if max_velocity is None else max_velocity
    shortest = _shortest(plant, loop, controller, speed)
    limit = PEAK_RATE * speed / shortest
    if max_acceleration is not None and max_acceleration > limit:
        raise DesignError(
            f"max_acceleration {max_acceleration / loop.gear_ratio:.4g} rad/s^2 is beyond the "
            f"motor: a change by {speed / loop.gear_ratio:.3g} rad/s within {PEAK:.0%} of "
            f"{loop.supply_voltage:g} V reaches {limit / loop.gear_ratio:.4g} rad/s^2; ask for "
            "that or less"
        )
    if transition_time is not None and transition_time < shortest - 1e-9:
        raise DesignError(
            f"transition_time {transition_time:.4g} s is too short for the motor: a change by "
            f"{speed / loop.gear_ratio:.3g} rad/s takes at least {shortest:.3g} s; ask for that "
            "or more"
        )
    if max_acceleration is not None:
        shortest = max(shortest, PEAK_RATE * speed / max_acceleration)
    duration = shortest if transition_time is None else transition_time
    return Reference(speed, PEAK_RATE * speed / duration, duration, lag)


def _shortest(plant: Plant, loop: Loop, controller: TwoDegrees, speed: float) -> float:
    """Return the shortest change from rest to ``speed`` within headroom and overshoot."""
    room = PEAK * loop.supply_voltage - float(plant.motors.static_voltage[0])
    duration = max(4 * loop.sample_time, 0.05)
    slow = float(plant.motors.a1[0] / plant.motors.a0[0])
    for _ in range(60):
        steps = int((duration + 4 * slow + 20 * loop.sample_time) / loop.sample_time)
        time = loop.sample_time * np.arange(steps)
        reference, rate = minimum_jerk(speed, duration, time)
        run = simulate(plant, controller, reference, acceleration=rate)
        figures = step_figures(time, run.speed[0], run.voltage[0], speed)
        if figures.peak_voltage <= room and figures.overshoot <= 1.0:
            return math.ceil(duration * 100 - 1e-9) / 100
        duration *= 1.15
    return math.ceil(duration * 100) / 100
