# SPDX-License-Identifier: Apache-2.0
"""Steady-state Kalman filter of the motor speed from encoder counts and voltage.

The state is ``(theta, w, w', d)`` of :class:`~smp_motor_control.motor.parameters.MotorModel`.  The
load d is a random walk, so that a constant load does not bias the speed:

    theta' = w,   tp w'' + tau w' + w = K (v - friction - d + n_v),   d' = n_d,
    counts = theta / q + quantisation, uniform, variance 1/12.

Each step predicts exactly over its own dt (zero-order hold) and corrects with the steady-state
gain of that dt.  While the mean normalised innovation squared shows that counts and model
disagree, the speed is differenced from counts.  Stamp jitter of variance ``s^2`` adds
``(w s)^2`` to the innovation variance.

References
----------
R. F. Stengel, *Optimal Control and Estimation*, Dover 1994, sections 4.3 and 4.5;
Y. Bar-Shalom, X.-R. Li and T. Kirubarajan, *Estimation with Applications to Tracking and
Navigation*, Wiley 2001, section 5.4 for the innovation test; B. D. O. Anderson and
J. B. Moore, *Optimal Filtering*, 1979, section 6.7 for the doubling of the Riccati equation.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_control.encoder import DifferencedSpeed, Encoder, Unwrapper
from smp_motor_control.errors import ParameterError, check_range
from smp_motor_control.fields import described
from smp_motor_control.motor.parameters import MotorModel
from smp_motor_control.motor.response import FreeResponse, zero_order_hold

_STEPS_PER_OCTAVE = 2
_OCTAVES = 2
_TRUST_RATIO, DISTRUST_RATIO = 3.0, 9.0
INNOVATION_MEMORY_S = 0.05
_NOISE_LEVELS = 10
_MAX_JITTER_SHARE = 0.5
"""Largest stamp jitter, relative to the usual interval; beyond it a sample was lost."""
_MAX_DOUBLINGS = 100
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)


@dataclass(frozen=True, kw_only=True)
class ObserverNoise:
    """Process and measurement noise of the observer."""

    # A higher value raises the bandwidth of the load estimate.
    load: float = described(1.0, "Random walk of the load, as a voltage [V/sqrt(s)].")
    # Includes the error of the model.
    voltage: float = described(0.005, "White noise of the voltage [V sqrt(s)].")
    # The default is quantisation only.
    count: float = described(
        1.0 / math.sqrt(12.0), "Standard deviation of the encoder error [counts]."
    )

    def __post_init__(self) -> None:
        for name, unit in (("load", "V/sqrt(s)"), ("voltage", "V sqrt(s)"), ("count", "counts")):
            check_range(name, getattr(self, name), 1e-6, 1e6, unit)


class SteadyGain(NamedTuple):
    """Steady-state Kalman gain per radian of innovation."""

    # angle, speed, acceleration, load: [-], [1/s], [1/s^2], [V/rad]
    angle: float
    speed: float
    acceleration: float
    load: float
    variance: float  # innovation variance [rad^2]


def prediction(model: MotorModel, intervals: Array) -> tuple[Array, Array]:
    """Return transition and input matrices of ``(angle, w, w', d)`` for each interval."""
    held = zero_order_hold(
        model.dc_gain, model.time_constant, model.time_constant_product, intervals
    )
    F = np.zeros((len(intervals), 4, 4))
    G = np.zeros((len(intervals), 4))
    F[:, 0, 0] = F[:, 3, 3] = 1.0
    F[:, 0, 1:3] = held.angle_transition
    F[:, 1:3, 1:3] = held.transition
    G[:, 0], G[:, 1:3] = held.angle_forced, held.forced
    F[:, :3, 3] = -G[:, :3]
    return F, G


def steady_gain(model: MotorModel, quantum: float, noise: ObserverNoise, dt: float) -> SteadyGain:
    """Return the steady-state Kalman gain for steps of length ``dt``.

    Process noise is integrated by Gauss-Legendre over an interval shorter than the fastest time
    constant, then doubled, ``Q(2h) = F Q(h) F' + Q(h)``; the Riccati equation is solved by doubling
    too.  All sums have positive terms, so nothing cancels however small L/R is.
    """
    free = FreeResponse(model.time_constant, model.time_constant_product)
    gain, tau, tp = model.dc_gain, model.time_constant, free.product
    fastest = 1.0 / tau if not tp else max(-free.fast, 1.0 / math.sqrt(tp))
    levels = max(math.ceil(math.log2(2.0 * dt * fastest)), 0)
    spans = dt * 2.0 ** np.arange(-levels, 1)
    F, _ = prediction(model, np.concatenate((spans, 0.5 * spans[0] * (1.0 + _NODES))))
    # Scale angles to counts, and speeds to one count per time constant.
    lag = tau if not tp else 1.0 / fastest
    scale = quantum * np.array([1.0, 1.0 / tau, 1.0 / (tau * lag), 1.0 / (gain * tau)])
    F *= scale / scale[:, None]
    entry = np.array([0.0, 0.0, gain / tp, 0.0] if tp else [0.0, gain / tau, 0.0, 0.0])
    sources = np.stack((noise.voltage * entry, [0.0, 0.0, 0.0, noise.load])) / scale
    answers = F[levels + 1 :] @ sources.T
    Q = np.einsum("k,kia,kja->ij", 0.5 * spans[0] * _WEIGHTS, answers, answers)
    for advance in F[:levels]:
        Q = Q + advance @ Q @ advance.T
    P = _steady_covariance(F[levels], Q, noise.count**2)
    variance = P[0, 0] + noise.count**2
    angle, speed, acceleration, load = (float(x) for x in P[:, 0] / variance * scale / quantum)
    return SteadyGain(angle, speed, acceleration, load, float(variance) * quantum * quantum)


def _steady_covariance(F: Array, Q: Array, R: float) -> Array:
    """Return the predicted covariance when the first state is measured, by doubling."""
    A, H, eye = F.T, Q, np.eye(len(Q))
    G = np.zeros_like(Q)
    G[0, 0] = 1.0 / R
    for _ in range(_MAX_DOUBLINGS):
        both = np.linalg.solve((eye + G @ H).T, np.concatenate((A, H)).T).T
        carried, seen = both[: len(Q)], both[len(Q) :]
        added = A.T @ seen @ A
        G = G + carried @ G @ A.T
        A = carried @ A
        G, H = 0.5 * (G + G.T), H + 0.5 * (added + added.T)
        if np.all(np.diag(added) <= 1e-15 * np.diag(H)):
            break
    return H


class SpeedObserver:
    """Observer of speed, acceleration [rad/s^2] and load of one motor, at its shaft.

    Steps from a quarter to four times ``sample_time`` are filtered.  ``load`` is the voltage [V]
    beyond the model, positive against forward motion; a load beyond ``max_load`` contradicts the
    model.  While model and counts disagree the observer is not ``trusted``, and the speed is
    differenced over ``window`` samples.
    """

    def __init__(
        self,
        model: MotorModel,
        sample_time: float,
        encoder: Encoder,
        noise: ObserverNoise | None = None,
        window: int = 4,
        max_load: float = math.inf,
    ) -> None:
        check_range("sample_time of the observer", sample_time, 1e-7, 1e3, "s")
        if not max_load > 0.0:
            raise ParameterError(f"max_load of the observer is {max_load} V; it must be positive")
        self._model, self._max_load = model, max_load
        self._free = FreeResponse(model.time_constant, model.time_constant_product)
        self._quantum = encoder.angle_per_count
        self._unwrap = Unwrapper(encoder.bits)
        self._differenced = DifferencedSpeed(Encoder(encoder.counts_per_revolution), window)
        self._usual = sample_time
        self._shortest = sample_time / 2**_OCTAVES
        self._longest = sample_time * 2**_OCTAVES
        self._noise = noise or ObserverNoise()
        self._steps = [
            self._shortest * 2 ** (k / _STEPS_PER_OCTAVE)
            for k in range(2 * _OCTAVES * _STEPS_PER_OCTAVE + 1)
        ]
        # Gains for larger measurement noise are computed when needed, in less than a millisecond.
        self._gains = {(0, k): self._design_gain(0, k) for k in range(len(self._steps))}
        # Below this speed, less than a count in the shortest memory, the motor may stick.
        self._slow = self._quantum / max(8.0 * sample_time, 0.02)
        self._dt = 0.0
        self._cache_step(sample_time)
        self.reset()

    def reset(self) -> None:
        """Discard the state, as after lost feedback."""
        self._unwrap.reset()
        self._differenced.reset()
        self._has_state = False
        self._time = 0.0
        self._voltages: deque[tuple[float, float]] = deque()
        self._theta = self._speed = self.acceleration = self.load = 0.0
        self._innovation_ratio = 1.0
        self._jitter = 0.0  # variance of the stamps [s^2]
        self.trusted = True
        self.speed = math.nan  # [rad/s]; NaN before the second sample

    def step(self, count: int, voltage: float, dt: float) -> float:
        """Return the speed [rad/s] after one more sample."""
        if not 0.0 < dt < math.inf or voltage - voltage != 0.0:
            raise ParameterError(
                f"the observer got {voltage} V over {dt} s; both must be finite, dt positive"
            )
        total = self._unwrap(count)
        self._time += dt
        differenced = self._differenced.step(self._time, total)
        angle = total * self._quantum
        if not self._has_state or dt > self._longest:
            self._restart(angle, differenced)
            return self.speed
        if dt != self._dt:
            self._cache_step(dt)
        self._predict(self._delayed(voltage, dt) if self._model.delay else voltage, dt)
        variance = self._variance
        off = dt - self._usual
        if -_MAX_JITTER_SHARE * self._usual < off < _MAX_JITTER_SHARE * self._usual:
            self._jitter += self._memory * (0.5 * off * off - self._jitter)
        innovation = angle - self._theta
        # A stamp error e changes the measured angle by speed times e, which raises the innovation
        # variance without contradicting the model.
        scatter = 1.0 + self._speed * self._speed * self._jitter / variance
        self._innovation_ratio += self._memory * (
            innovation * innovation / variance - self._innovation_ratio
        )
        g_theta, g_speed, g_acceleration, g_load, _ = self._gain_under(scatter)
        self._theta += g_theta * innovation
        self._speed += g_speed * innovation
        self.acceleration += g_acceleration * innovation
        self.load += g_load * innovation
        normalised = self._innovation_ratio / scatter
        if normalised > DISTRUST_RATIO or abs(self.load) > self._max_load:
            if self.trusted:
                self._restart(angle, differenced)
            self.trusted = False
        elif normalised < _TRUST_RATIO:
            self.trusted = True
        self.speed = self._speed if self.trusted else differenced
        return self.speed

    def _restart(self, angle: float, speed: float) -> None:
        """Restart from a measured angle and speed, with the last load."""
        self._has_state = True
        self._theta = angle
        self._speed = speed if speed == speed else 0.0
        self.acceleration = 0.0
        self.load = min(max(self.load, -self._max_load), self._max_load)
        self.speed = speed

    def _cache_step(self, dt: float) -> None:
        """Cache the coefficients of steps of length ``dt``."""
        self._dt = dt
        place = math.log2(max(dt / self._shortest, 1.0)) * _STEPS_PER_OCTAVE
        self._place = min(round(place), len(self._steps) - 1)
        self._variance = self._gains[0, self._place].variance
        self._memory = min(dt / INNOVATION_MEMORY_S, 1.0)
        self._coefficients = self._free.after(dt)

    def _gain_under(self, scatter: float) -> SteadyGain:
        """Return the gain for the observed innovation ratio, up to that of the stamp jitter."""
        ratio = self._innovation_ratio if self._innovation_ratio < scatter else scatter
        level = 0 if ratio < 2.0 else min(round(0.5 * math.log2(ratio)), _NOISE_LEVELS - 1)
        at = level, self._place
        if at not in self._gains:
            self._gains[at] = self._design_gain(*at)
        return self._gains[at]

    def _design_gain(self, level: int, place: int) -> SteadyGain:
        """Return the gain for measurement noise that is ``2^level`` times the nominal."""
        noise = replace(self._noise, count=self._noise.count * 2.0**level)
        return steady_gain(self._model, self._quantum, noise, self._steps[place])

    def _predict(self, voltage: float, dt: float) -> None:
        """Advance the state by the exact response to a constant voltage."""
        model, speed, acceleration = self._model, self._speed, self.acceleration
        drive = voltage - self.load
        static = model.static_voltage
        if static:
            if -self._slow < speed < self._slow:
                drive -= min(max(drive, -static), static)
            else:
                drive -= static if speed > 0.0 else -static
        final = model.dc_gain * drive
        off = speed - final
        g, h, g_rate, h_rate = self._coefficients
        new_off = g * off + h * acceleration
        new_acceleration = g_rate * off + h_rate * acceleration
        swept = self._free.integral(off - new_off, acceleration - new_acceleration)
        self._theta += final * dt + swept
        self._speed = final + new_off
        self.acceleration = new_acceleration

    def _delayed(self, voltage: float, dt: float) -> float:
        """Return the mean voltage during the step, delayed by the model's dead time."""
        past = self._voltages
        now = self._time
        past.append((now, voltage))
        begin, end = now - dt - self._model.delay, now - self._model.delay
        while len(past) > 1 and past[0][0] <= begin:
            past.popleft()
        volt_seconds, since = 0.0, begin
        for until, held in past:
            stop = min(until, end)
            if stop > since:
                volt_seconds += held * (stop - since)
                since = stop
        return volt_seconds / dt
