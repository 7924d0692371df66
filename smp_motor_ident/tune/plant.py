# SPDX-License-Identifier: Apache-2.0
r"""Sampled motor with exact zero-order hold and a delay of any length.

A batch of ``n`` motors :math:`e^{-sD} / (a_2 s^2 + a_1 s + a_0)` is sampled at once, so that
one motor and a thousand draws of an uncertain one are the same few array operations.  The plant
includes the sensor of the speed: a filter, an average over a window, or an observer.
All quantities are at the motor shaft.

The observer is a linear filter of angle and voltage.  Its state holds the difference ``e`` of its
angle from the counted one, so that no state grows.  With
``r = (speed, acceleration, load)`` and, over one sample, the angle ``s`` that was swept and the
mean voltage ``v``,

    nu = e + s - F_0 r - G_0 v,   e <- (1 - K_0) nu,   r <- F r + G v + K nu

which is ``state <- advance state + by_angle s + by_voltage v``.

References
----------
.. [1] K. J. Astrom, B. Wittenmark, Computer-Controlled Systems, 3rd ed. (1997), section 2.3:
   sampling of systems with time delay.
.. [2] R. F. Stengel, Optimal Control and Estimation (1994), section 4.3: the steady-state Kalman
   filter.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from smp_motor_control.arrays import Array, Complex
from smp_motor_control.motor.parameters import MotorModel
from smp_motor_control.motor.response import zero_order_hold
from smp_motor_control.observer import ObserverNoise, prediction, steady_gain
from smp_motor_ident.errors import DesignError
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.motors import Motors

MAX_LOOP_SAMPLES = 300  # largest delay and averaging of a loop [samples]

SPEED = 1  # where the speed is in the state


@dataclass(frozen=True, eq=False)
class ObserverModel:
    """The observer as a linear filter, the same for all motors of a batch."""

    advance: Array  # shape (q, q)
    # by_angle, by_voltage: shape (q,)
    by_angle: Array
    by_voltage: Array
    # shape (m,): shares of the last controller outputs in the mean voltage of a sample, as the
    # observer gets it and shifts it by the delay of its model
    taps: Array
    variance: float = 1.0  # assumed variance of the innovation [rad^2]

    def transfer(self, z: Complex) -> tuple[Complex, Complex]:
        """Return the transfer from swept angle and from mean voltage to the observed speed."""
        eye = np.eye(self.by_angle.size)
        inputs = np.stack([self.by_angle, self.by_voltage], axis=1)
        solved = np.linalg.solve(z[:, None, None] * eye - self.advance, inputs[None])
        found = np.asarray(solved, dtype=np.complex128)
        return found[:, SPEED, 0], found[:, SPEED, 1]


NO_OBSERVER = ObserverModel(np.zeros((0, 0)), np.zeros(0), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Plant:
    r"""A batch of sampled motors with their delay and the sensor of their speed.

    ``x[k+1] = phi x[k] + sum_j taps[j] u[k-j]`` with ``x = (speed, acceleration)``, last
    the filtered speed where the sensor has a lag; the angle run through in the step is
    ``phi_angle x[k] + sum_j taps_angle[j] u[k-j]``.
    """

    phi: Array  # shape (n, s, s): state transition over one sample
    taps: Array  # shape (n, m, s): effect of the last ``m`` controller outputs
    phi_angle: Array  # shape (n, s)
    taps_angle: Array  # shape (n, m)
    sample_time: float  # [s]
    # shape (n, q), [1/s]: weights of the angles run through in the last ``q`` steps, whose sum is
    # the measured speed; with ``q`` 0 it is the last state of a sensor with lag, else the speed
    # itself
    average: Array
    motors: Motors  # the sampled motors
    # The observer whose speed is fed back, if any; then ``q`` is 0
    observer: ObserverModel | None = None

    def __len__(self) -> int:
        """Return the number of motors."""
        return int(self.phi.shape[0])

    @property
    def window_length(self) -> Array:
        """Length of the window over which each motor's measured speed is averaged, (n,), [s]."""
        return 1 / self.average[:, 0] if self.window else np.zeros(len(self))

    @property
    def window(self) -> int:
        """Steps over which the measured speed is averaged."""
        return int(self.average.shape[1])

    @property
    def sensor(self) -> int:
        """Index of the state that is reported as the speed."""
        return self.phi.shape[1] - 1 if np.any(self.motors.sensor_lag > 0) else 0

    def response(self, omega: Array, *, true_speed: bool = False) -> Complex:
        """Return the frequency response from controller output to measured speed."""
        z = np.exp(1j * np.asarray(omega) * self.sample_time)
        return self.transfer(z, true_speed=true_speed)

    def transfer(self, z: Complex, *, true_speed: bool = False) -> Complex:
        """Return the transfer function at points of the z plane; see :meth:`response`."""
        z = np.asarray(z, dtype=np.complex128)
        delays = z[None, :] ** -np.arange(self.taps.shape[1])[:, None]
        drive = np.einsum("nms,mf->nsf", self.taps, delays)
        state = _resolvent(self.phi, z, drive)
        if true_speed:
            return state[:, 0]
        if self.observer is None and not self.window:
            return state[:, self.sensor]
        angle = np.einsum("ns,nsf->nf", self.phi_angle, state) + self.taps_angle @ delays
        if self.observer is not None:
            observed: Complex = self.observer.transfer(z)[0] * angle + self._predicted(z)
            return observed
        steps = z[None, :] ** -(1.0 + np.arange(self.window))[:, None]
        averaged: Complex = angle * (self.average @ steps)
        return averaged

    def through_motor(self, omega: Array) -> Complex:
        """Return the response without an observer's prediction from the voltage."""
        z = np.exp(1j * np.asarray(omega) * self.sample_time)
        return self.transfer(z) - self._predicted(z)

    def _predicted(self, z: Complex) -> Complex:
        """Return the transfer from controller output to the observer's own part, shape (f,)."""
        if self.observer is None:
            return np.zeros(z.size, dtype=np.complex128)
        delays = z[None, :] ** -np.arange(self.observer.taps.size)[:, None]
        predicted: Complex = self.observer.transfer(z)[1] * (self.observer.taps @ delays)
        return predicted

    def angle_noise(self, omega: Array) -> Array:
        """Return the power gain from an error of the angle to the speed of the first motor."""
        z = np.exp(1j * np.asarray(omega) * self.sample_time)
        if self.observer is not None:
            squared: Array = np.abs(self.observer.transfer(z)[0] * (z - 1)) ** 2
            return squared
        steps = z[None, :] ** -(1.0 + np.arange(self.window))[:, None]
        difference = (self.average[:1] @ steps)[0] * (z - 1)
        lag = 1 + 1j * np.asarray(omega) * self.motors.sensor_lag[0]
        noise: Array = np.abs(difference / lag) ** 2
        return noise


def sample(motors: Motors, loop: Loop, *, believed: Motors | None = None) -> Plant:
    """Sample a batch of motors exactly, with the loop's and the motor's delay."""
    T, n = loop.sample_time, len(motors)
    observer = None
    if loop.speed_source == "observer" and loop.count_angle:
        observer = _observer(motors if believed is None else believed, loop)
    lag = motors.sensor_lag if loop.reports_speed else np.zeros(1)
    motors = replace(motors, sensor_lag=np.broadcast_to(lag, n))
    window = np.zeros(n) if observer is not None else _window(motors, loop)
    total = loop.loop_delay + motors.delay
    whole = np.floor(total / T + 1e-9).astype(int)
    late = np.clip(total - whole * T, 0.0, T)
    delay, averaged = float(total.max()), float(window.max())
    samples = int(delay / T) + round(averaged / T)
    if samples > MAX_LOOP_SAMPLES:
        raise DesignError(
            f"a delay of {1e3 * delay:.4g} ms and a window of {1e3 * averaged:.4g} ms at "
            f"{loop.rate:.4g} Hz are {samples} samples, more than the limit of {MAX_LOOP_SAMPLES}. "
            f"Sample at {MAX_LOOP_SAMPLES / max(delay + averaged, T):.3g} Hz or less, or average "
            "over fewer samples"
        )
    phi, gamma, phi_angle, zeta = _hold(motors, np.full(n, T))
    _, newest, _, newest_angle = _hold(motors, T - late)
    # A window within one step sees the end of it only.
    tail = np.where(window > 0, np.minimum(window, T), T)
    if np.any(tail < T):
        begin = T - tail
        _, _, before, old = _hold(motors, begin)
        new = _hold(motors, np.maximum(begin - late, 0.0))[3]
        phi_angle, zeta, newest_angle = phi_angle - before, zeta - old, newest_angle - new
    s = phi.shape[1]
    taps: Array = np.zeros((n, int(whole.max()) + 2, s))
    taps_angle: Array = np.zeros(taps.shape[:2])
    row = np.arange(n)
    taps[row, whole], taps[row, whole + 1] = newest, gamma - newest
    taps_angle[row, whole], taps_angle[row, whole + 1] = newest_angle, zeta - newest_angle
    used = np.any(taps != 0, axis=(0, 2)) | np.any(taps_angle != 0, axis=0)
    m = int(np.flatnonzero(used)[-1]) + 1
    if observer is not None:
        short = max(observer.taps.size - taps.shape[1], 0)
        taps = np.pad(taps, ((0, 0), (0, short), (0, 0)))
        taps_angle = np.pad(taps_angle, ((0, 0), (0, short)))
        m = max(m, observer.taps.size)
    taps, taps_angle = taps[:, :m], taps_angle[:, :m]
    average = _average(window, tail, T)
    return Plant(phi, taps, phi_angle, taps_angle, T, average, motors, observer)


def _window(motors: Motors, loop: Loop) -> Array:
    """Return the length over which the fed back speed is averaged [s], 0 where it is not."""
    own = np.full(len(motors), loop.difference_window * loop.sample_time)
    if not loop.reports_speed or loop.averaging_given:
        return own
    # An identified filter is the sensor's whole effect.
    plain = np.where(motors.sensor_lag > 0, 0.0, own)
    found = np.where(motors.averaging_window > 0, motors.averaging_window, plain)
    return np.maximum(found, 0.01 * loop.sample_time) if np.any(found > 0) else found


def _average(window: Array, tail: Array, T: float) -> Array:
    """Return the weights of the steps in an average, the last step's in part."""
    if not np.any(window > 0):
        return np.zeros((window.size, 0))
    steps = np.maximum(window / T, 1.0)
    weights = np.clip(steps[:, None] - np.arange(int(np.ceil(steps.max() - 1e-9))), 0.0, 1.0)
    weights /= np.where(window < T, tail, window)[:, None]
    return np.asarray(weights)


def _observer(believed: Motors, loop: Loop) -> ObserverModel:
    """Return the steady-state observer that runs with the first of some motors as its model."""
    model = MotorModel(**believed.combine())
    sample_time = loop.sample_time
    *gain, variance = steady_gain(model, loop.count_angle, ObserverNoise(), sample_time)
    correct = np.array(gain)
    (F,), (G,) = prediction(model, np.array([sample_time]))
    size = correct.size
    # Coefficients of the innovation.
    innovation = np.concatenate([[1.0], -F[0, 1:]])
    advance = np.zeros((size, size))
    advance[0] = (1 - correct[0]) * innovation
    advance[1:, 1:] = F[1:, 1:]
    advance[1:] += correct[1:, None] * innovation
    by_angle = np.concatenate([[1 - correct[0]], correct[1:]])
    by_voltage = np.concatenate([[0.0], G[1:]]) - G[0] * by_angle
    total = loop.loop_delay + model.delay
    whole = math.floor(total / sample_time + 1e-9)
    late = min(max(total / sample_time - whole, 0.0), 1.0)
    taps = np.zeros(whole + 2)
    taps[whole], taps[whole + 1] = 1 - late, late
    return ObserverModel(advance, by_angle, by_voltage, taps if late else taps[:-1], variance)


def _hold(motors: Motors, t: Array) -> tuple[Array, Array, Array, Array]:
    """Return transition, effect of a held volt, and both for the angle, over ``t``.

    With a sensor of lag f its speed y is a third state: ``y + f y' = w`` has the particular
    solution ``c1 w + c2 w'``, and its angle lags by the filter's stored part.
    """
    gain, tau, tp = 1 / motors.a0, motors.a1 / motors.a0, motors.a2 / motors.a0
    held = zero_order_hold(gain, tau, tp, t)
    if not np.any(motors.sensor_lag > 0):
        return held
    f = np.maximum(motors.sensor_lag, 1e-6 * np.max(motors.sensor_lag))
    f = np.where(np.abs(tp - tau * f + f * f) < 1e-6 * f * f, 1.00001 * f, f)
    c2 = -f * tp / (tp - tau * f + f * f)
    c1 = 1 - f * f / (tp - tau * f + f * f)
    decay = np.exp(-t / f)
    phi, gamma = np.zeros((t.size, 3, 3)), np.zeros((t.size, 3))
    phi[:, :2, :2], phi[:, 2, 2] = held.transition, decay
    rows = c1[:, None] * held.transition[:, 0] + c2[:, None] * held.transition[:, 1]
    phi[:, 2, :2] = rows - decay[:, None] * np.stack([c1, c2], axis=1)
    gamma[:, :2], gamma[:, 2] = held.forced, gain * (1 - phi[:, 2, 0] - decay)
    angle = -f[:, None] * phi[:, 2]
    angle[:, :2] += held.angle_transition
    angle[:, 2] += f
    return phi, gamma, angle, held.angle_forced - f * gamma[:, 2]


def _resolvent(phi: Array, z: Complex, drive: Complex) -> Complex:
    """Return (z I - phi)^-1 drive for a batch; the last of three states, a sensor's, feeds none."""
    if phi.shape[1] == 3:
        inner = _resolvent(phi[:, :2, :2], z, drive[:, :2])
        last = np.einsum("ns,nsf->nf", phi[:, 2, :2], inner) + drive[:, 2]
        last = last / (z - phi[:, 2, 2, None])
        return np.concatenate([inner, last[:, None]], axis=1)
    a, b = z - phi[:, 0, 0, None], -phi[:, 0, 1, None]
    c, d = -phi[:, 1, 0, None], z - phi[:, 1, 1, None]
    determinant = a * d - b * c
    return np.stack(
        [
            (d * drive[:, 0] - b * drive[:, 1]) / determinant,
            (a * drive[:, 1] - c * drive[:, 0]) / determinant,
        ],
        axis=1,
    )
