"""Motor speed from encoder counts and voltage by a steady-state Kalman filter.

State ``(theta, w, w', d)`` of the identified motor (see :mod:`~smp_motor_control.motor.model`)
with the load ``d`` as a random walk, so that the speed has no bias under any constant load:

    theta' = w,   tp w'' + tau w' + w = K (v - friction - d + n_v),   d' = n_d,
    counts = theta / q + quantisation, uniform, variance 1/12.

Each step predicts exactly over its own dt (voltage held constant) and corrects with the
steady-state gain for that dt.  Where the counts contradict the model, by the mean of the
normalised innovation squared, the speed falls back to differenced counts until they agree.
Stamps that scatter with variance ``s^2`` add ``(w s)^2`` to the variance of an innovation.

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
from smp_motor_control.motor.model import MotorModel
from smp_motor_control.motor.response import FreeResponse, zero_order_hold

_STEPS_PER_OCTAVE = 2
_OCTAVES = 2
_AGREE, DISAGREE = 3.0, 9.0
INNOVATION_MEMORY = 0.05
_LEVELS = 10
_REGULAR = 0.5
"""Of the usual interval, by which stamps scatter; what is farther off is a sample lost."""
_DOUBLINGS = 100
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)


@dataclass(frozen=True, kw_only=True)
class ObserverNoise:
    """How far the observer trusts the model and the counts."""

    # More of the first raises the bandwidth with which changes of the load are seen; the second
    # stands for what the model leaves out, too; the third's default is quantisation alone.
    load: float = described(1.0, "Wander of the load in one second, as a voltage [V/sqrt(s)].")
    voltage: float = described(0.005, "White noise of the voltage [V sqrt(s)].")
    count: float = described(
        1.0 / math.sqrt(12.0), "Standard deviation of the encoder's error [counts]."
    )

    def __post_init__(self) -> None:
        for name, unit in (("load", "V/sqrt(s)"), ("voltage", "V sqrt(s)"), ("count", "counts")):
            check_range(name, getattr(self, name), 1e-6, 1e6, unit)


class SteadyGain(NamedTuple):
    """Kalman gain in the steady state, per radian of innovation."""

    # angle, speed, acceleration, load: [-], [1/s], [1/s^2], [V/rad]
    angle: float
    speed: float
    acceleration: float
    load: float
    variance: float  # of the innovation [rad^2]


def prediction(model: MotorModel, intervals: Array) -> tuple[Array, Array]:
    """Return the exact transition of ``(angle, w, w', d)`` and the effect of the voltage."""
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
    """Return the steady-state Kalman gain for steps of a given length.

    The noise of a step is gathered over a part of it that is short beside the fastest time
    constant (Gauss-Legendre), then doubled, ``Q(2h) = F Q(h) F' + Q(h)``; the Riccati equation
    is doubled as well.  Sums of positive terms alone: nothing overflows or cancels, however
    small L/R is against the step.
    """
    free = FreeResponse(model.time_constant, model.time_constant_product)
    gain, tau, tp = model.dc_gain, model.time_constant, free.product
    fastest = 1.0 / tau if not tp else max(-free.fast, 1.0 / math.sqrt(tp))
    levels = max(math.ceil(math.log2(2.0 * dt * fastest)), 0)
    spans = dt * 2.0 ** np.arange(-levels, 1)
    F, _ = prediction(model, np.concatenate((spans, 0.5 * spans[0] * (1.0 + _NODES))))
    # In counts, and in shares of a steady turn of one count per time constant.
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
    """Return the covariance before a measurement of the first state, by doubling."""
    A, H, eye = F.T, Q, np.eye(len(Q))
    G = np.zeros_like(Q)
    G[0, 0] = 1.0 / R
    for _ in range(_DOUBLINGS):
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
    """Speed, acceleration [rad/s^2] and load of one motor, at its shaft.

    Steps from a quarter to four times the usual interval are filtered.  The ``load`` is the voltage
    [V] that it takes beyond the model, positive against forward turning; beyond ``max_load``, such
    as 1.5 times the supply, it contradicts the model.  While model and counts do not agree the
    speed is not ``trusted``, and is differenced over ``window`` samples.
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
            raise ParameterError(f"max_load of the observer is {max_load} V: must be positive")
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
        # For counts as they are; for stamps that make them less certain as it is asked for, which
        # is a fraction of a millisecond each.
        self._gains = {(0, k): self._designed(0, k) for k in range(len(self._steps))}
        # Below this speed the motor may stick: less than a count in the shortest memory.
        self._slow = self._quantum / max(8.0 * sample_time, 0.02)
        self._dt = 0.0
        self._prepare(sample_time)
        self.reset()

    def reset(self) -> None:
        """Forget everything, as after lost feedback."""
        self._unwrap.reset()
        self._differenced.reset()
        self._known = False
        self._time = 0.0
        self._voltages: deque[tuple[float, float]] = deque()
        self._theta = self._speed = self.acceleration = self.load = 0.0
        self._surprise = 1.0
        self._jitter = 0.0  # variance of the stamps [s^2]
        self.trusted = True
        self.speed = math.nan  # [rad/s], before the second sample

    def step(self, count: int, voltage: float, dt: float) -> float:
        """Take in one sample."""
        if not 0.0 < dt < math.inf or voltage - voltage != 0.0:
            raise ParameterError(f"observer got {voltage} V over {dt} s: must be finite, dt > 0")
        total = self._unwrap(count)
        self._time += dt
        differenced = self._differenced.step(self._time, total)
        angle = total * self._quantum
        if not self._known or dt > self._longest:
            self._restart(angle, differenced)
            return self.speed
        if dt != self._dt:
            self._prepare(dt)
        self._predict(self._delayed(voltage, dt) if self._model.delay else voltage, dt)
        variance = self._variance
        off = dt - self._usual
        if -_REGULAR * self._usual < off < _REGULAR * self._usual:
            self._jitter += self._memory * (0.5 * off * off - self._jitter)
        innovation = angle - self._theta
        # A stamp that is off by e moves a turning encoder's angle by its speed times e: so much of
        # what surprises is no contradiction, and the counts are as much less certain.
        scatter = 1.0 + self._speed * self._speed * self._jitter / variance
        self._surprise += self._memory * (innovation * innovation / variance - self._surprise)
        g_theta, g_speed, g_acceleration, g_load, _ = self._gain_under(scatter)
        self._theta += g_theta * innovation
        self._speed += g_speed * innovation
        self.acceleration += g_acceleration * innovation
        self.load += g_load * innovation
        unlike = self._surprise / scatter
        if unlike > DISAGREE or abs(self.load) > self._max_load:
            if self.trusted:
                self._restart(angle, differenced)
            self.trusted = False
        elif unlike < _AGREE:
            self.trusted = True
        self.speed = self._speed if self.trusted else differenced
        return self.speed

    def _restart(self, angle: float, speed: float) -> None:
        """Begin again at a measured angle and speed, with the load as last known."""
        self._known = True
        self._theta = angle
        self._speed = speed if speed == speed else 0.0
        self.acceleration = 0.0
        self.load = min(max(self.load, -self._max_load), self._max_load)
        self.speed = speed

    def _prepare(self, dt: float) -> None:
        """Compute what a step of this length needs; kept while the length stays the same."""
        self._dt = dt
        place = math.log2(max(dt / self._shortest, 1.0)) * _STEPS_PER_OCTAVE
        self._place = min(round(place), len(self._steps) - 1)
        self._variance = self._gains[0, self._place].variance
        self._memory = min(dt / INNOVATION_MEMORY, 1.0)
        self._coefficients = self._free.after(dt)

    def _gain_under(self, scatter: float) -> SteadyGain:
        """Return the gain for counts as uncertain as they show themselves, up to a ratio."""
        ratio = self._surprise if self._surprise < scatter else scatter
        level = 0 if ratio < 2.0 else min(round(0.5 * math.log2(ratio)), _LEVELS - 1)
        at = level, self._place
        if at not in self._gains:
            self._gains[at] = self._designed(*at)
        return self._gains[at]

    def _designed(self, level: int, place: int) -> SteadyGain:
        """Return the gain for counts that are ``2^level`` times as uncertain as they come."""
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
        """Return the mean voltage that acted during the step, ``delay`` after it was applied."""
        past = self._voltages
        now = self._time
        past.append((now, voltage))
        begin, end = now - dt - self._model.delay, now - self._model.delay
        while len(past) > 1 and past[0][0] <= begin:
            past.popleft()
        volt_seconds, since = 0.0, begin
        for until, held in past:
            upto = min(until, end)
            if upto > since:
                volt_seconds += held * (upto - since)
                since = upto
        return volt_seconds / dt
