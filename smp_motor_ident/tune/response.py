"""Step and load responses of the loop, a batch of motors or of controllers at once.

The running PID (saturation, anti-windup, set-point weights, feed-forward) on the sampled
motor, everything at the motor shaft.  Coulomb friction is left out: its feed-forward cancels
it while the wheel turns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from smp_motor_ident.tune.arrays import Array
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.plant import Plant


@dataclass(frozen=True, eq=False)
class TwoDegrees:
    """A complete controller at the motor shaft; every number may be an array of shape (n,).

    Attributes
    ----------
    feedback : Feedback
        Gains that act on the measurement.
    weight : float
        Set-point weight of the proportional action [-].
    velocity, acceleration : float
        Feed-forward [V s/rad], [V s^2/rad].
    limit : float
        Clamp of the output [V].
    tracking : float
        Time constant of back-calculation [s]; infinite switches it off.
    """

    feedback: Feedback
    weight: float = 1.0
    velocity: float = 0.0
    acceleration: float = 0.0
    limit: float = math.inf
    tracking: float = math.inf


@dataclass(frozen=True, eq=False)
class Response:
    """What the loop did; arrays of shape (n, k) at the sampling instants.

    Attributes
    ----------
    time : ndarray, shape (k,), [s]
    speed : ndarray, shape (n, k), [rad/s]
        True speed of the motor.
    voltage : ndarray, shape (n, k), [V]
        Output of the controller.
    """

    time: Array
    speed: Array
    voltage: Array


def simulate(
    plant: Plant,
    controller: TwoDegrees,
    reference: Array,
    *,
    acceleration: Array | None = None,
    load: Array | None = None,
    count_angle: float = 0.0,
) -> Response:
    """Run the closed loop from rest.

    Parameters
    ----------
    plant : Plant
        A batch of ``n`` motors.
    controller : TwoDegrees
        With numbers, or arrays of shape (n,).
    reference : ndarray, shape (k,), [rad/s]
        After the limits, at the sampling instants.
    acceleration : ndarray, shape (k,), [rad/s^2], or None
        Of the reference, for the feed-forward.
    load : ndarray, shape (k,), [V], or None
        Load as the voltage that it takes from the motor.
    count_angle : float
        One count [rad]; 0 measures without quantisation.

    Returns
    -------
    Response
    """
    n, m, s = plant.taps.shape
    T, window = plant.sample_time, plant.window
    fb = controller.feedback
    steps = reference.size
    x, past = np.zeros((n, s)), np.zeros((n, m))
    # The load acts at once, the controller's voltage after its delay.
    direct, direct_angle = plant.taps.sum(axis=1), plant.taps_angle.sum(axis=1)
    loads = np.zeros(steps) if load is None else load
    ahead = np.zeros(steps) if acceleration is None else acceleration
    angle = np.zeros((window + 1, n))
    integral, previous, rate = np.zeros(n), np.zeros(n), np.zeros(n)
    speed, voltage = np.empty((steps, n)), np.empty((steps, n))
    for k in range(steps):
        speed[k] = x[:, 0]
        if window:
            seen = np.floor(angle / count_angle) * count_angle if count_angle else angle
            measured = (seen[0] - seen[-1]) / (window * T)
        else:
            measured = x[:, 0]
        rate = (fb.filter_time * rate + (previous - measured)) / (fb.filter_time + T)
        previous = measured
        feedforward = controller.velocity * reference[k] + controller.acceleration * ahead[k]
        wanted = fb.p * (controller.weight * reference[k] - measured) + integral + fb.d * rate
        wanted = wanted + feedforward
        given = np.clip(wanted, -controller.limit, controller.limit)
        integral = integral + T * (
            fb.i * (reference[k] - measured) + (given - wanted) / controller.tracking
        )
        voltage[k] = given
        past = np.concatenate([np.broadcast_to(given, n)[:, None], past[:, :-1]], axis=1)
        swept = np.einsum("ns,ns->n", plant.phi_angle, x)
        swept += np.einsum("nm,nm->n", plant.taps_angle, past) - direct_angle * loads[k]
        angle = np.concatenate([(angle[0] + swept)[None], angle[:-1]])
        x = np.einsum("nij,nj->ni", plant.phi, x) + np.einsum("nms,nm->ns", plant.taps, past)
        x -= direct * loads[k]
    return Response(T * np.arange(steps), speed.T, voltage.T)


def minimum_jerk(distance: float, duration: float, time: Array) -> tuple[Array, Array]:
    """Return the smoothest change of speed over a duration, and its rate.

    Parameters
    ----------
    distance : float
        Change of speed [rad/s].
    duration : float
        [s].
    time : ndarray, shape (k,), [s]
        From the start of the change.

    Returns
    -------
    speed : ndarray, shape (k,), [rad/s]
    acceleration : ndarray, shape (k,), [rad/s^2]

    References
    ----------
    T. Flash, N. Hogan, The coordination of arm movements, J. Neuroscience 5 (1985), 1688-1703.
    """
    x = np.clip(time / duration, 0.0, 1.0)
    speed = distance * x**3 * (10 - 15 * x + 6 * x**2)
    return speed, distance / duration * 30 * x**2 * (1 - x) ** 2


@dataclass(frozen=True)
class StepFigures:
    """What a step response tells.

    Attributes
    ----------
    rise : float
        From 10 to 90 % [s].
    settling : float
        Until it stays within 2 % [s]; NaN where it does not.
    overshoot : float
        Beyond the final value [%].
    peak_voltage : float
        Largest magnitude [V].
    """

    rise: float
    settling: float
    overshoot: float
    peak_voltage: float


def step_figures(time: Array, speed: Array, voltage: Array, final: float) -> StepFigures:
    """Read a step response.

    Parameters
    ----------
    time, speed, voltage : ndarray, shape (k,)
        One response, [s], [rad/s], [V].
    final : float
        Value that was asked for [rad/s].

    Returns
    -------
    StepFigures
    """
    relative = speed / final
    outside = np.flatnonzero(np.abs(relative - 1) > 0.02)
    last = int(outside[-1]) if outside.size else -1
    settled = last + 1 < time.size
    low, high = np.argmax(relative >= 0.1), np.argmax(relative >= 0.9)
    rose = bool(np.any(relative >= 0.9))
    return StepFigures(
        rise=float(time[high] - time[low]) if rose else math.nan,
        settling=float(time[last + 1]) if settled else math.nan,
        overshoot=float(max(100 * (relative.max() - 1), 0.0)),
        peak_voltage=float(np.abs(voltage).max()),
    )


@dataclass(frozen=True)
class LoadFigures:
    """What the response to a load step tells, per volt that the load takes.

    Attributes
    ----------
    peak : float
        Largest loss of speed [rad/s/V].
    integral : float
        Integral of the magnitude of the error [rad/V].
    recovery : float
        Until the loss stays within a tenth of its peak [s]; NaN where it does not.
    """

    peak: float
    integral: float
    recovery: float


def load_figures(time: Array, speed: Array) -> LoadFigures:
    """Read the response to a load of 1 V at time 0 around a speed of 0.

    Parameters
    ----------
    time, speed : ndarray, shape (k,)
        [s], [rad/s].

    Returns
    -------
    LoadFigures
    """
    loss = np.abs(speed)
    outside = np.flatnonzero(loss > 0.1 * loss.max())
    last = int(outside[-1]) + 1
    return LoadFigures(
        peak=float(loss.max()),
        integral=float(np.trapezoid(loss, time)),
        recovery=float(time[last]) if last < time.size else math.nan,
    )
