# SPDX-License-Identifier: Apache-2.0
"""Compute the feedback of the controller, the closed loop, and its margins.

All at the motor shaft: volts per motor rad/s.  The integral is forward Euler and is used one
step later, the derivative is backward Euler behind its filter, exactly as the running PID does.

Margins are phase, gain, delay and peak of the sensitivity.  Loops are read where their frequency
response on a grid crosses unit gain and the real axis: a batch of uncertain ones all at once, the
nominal one on a grid that is refined at its crossings.

References
----------
.. [1] K. J. Astrom, T. Hagglund, Advanced PID Control (2006), section 4.6.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from smp_motor_control.arrays import Array, Complex, Flags
from smp_motor_ident.tune.plant import SPEED, Plant


@dataclass(frozen=True)
class Feedback:
    """Gains that act on the measurement."""

    p: float  # [V s/rad]
    i: float  # [V/rad]
    d: float = 0.0  # [V s^2/rad]
    filter_time: float = 0.0  # time constant of the derivative's filter [s]

    def scaled(self, factor: float) -> "Feedback":
        """Return the same controller with every gain multiplied by ``factor``."""
        return replace(self, p=self.p * factor, i=self.i * factor, d=self.d * factor)

    def response(self, omega: Array, sample_time: float) -> Complex:
        """Return the frequency response from error to volts."""
        integral, derivative = terms(omega, sample_time, self.filter_time)
        return self.p + self.i * integral + self.d * derivative


def terms(omega: Array, sample_time: float, filter_time: float | Array) -> tuple[Complex, Complex]:
    """Return the responses of integrator and filtered derivative, each with unit gain."""
    z = np.exp(1j * np.asarray(omega) * sample_time)
    keep = filter_time / (filter_time + sample_time)
    return sample_time / (z - 1), (1 - keep) * (z - 1) / (sample_time * (z - keep))


def closed_loop(plant: Plant, feedback: Feedback) -> Array:
    """Return the state matrices of the closed loop of every plant of a batch.

    The state is: motor, the angles run through in the last ``window`` steps or the observer, the
    voltages still under way, integral, and derivative filter.
    """
    n, m, s = plant.taps.shape
    T, window, observer = plant.sample_time, plant.window, plant.observer
    memory = window if observer is None else observer.by_angle.size
    volts, integral = s + memory, s + memory + m - 1
    size = integral + 2
    speed = np.zeros((n, size))
    if observer is not None:
        speed[:, s + SPEED] = 1.0
    elif window:
        speed[:, s:volts] = plant.average
    else:
        speed[:, plant.sensor] = 1.0
    keep = feedback.filter_time / (feedback.filter_time + T)
    unit = np.eye(size)
    # filtered[k] = keep filtered[k-1] + (1 - keep) speed[k]; the last state is filtered[k-1].
    filtered = keep * unit[-1] + (1 - keep) * speed
    rate = (filtered - unit[-1]) / T
    output = unit[integral] - feedback.p * speed - feedback.d * rate
    A = np.zeros((n, size, size))
    A[:, :s, :s] = plant.phi
    A[:, :s] += plant.taps[:, 0, :, None] * output[:, None, :]
    A[:, :s, volts:integral] += np.swapaxes(plant.taps[:, 1:], 1, 2)
    swept = np.zeros((n, size))
    swept[:, :s] = plant.phi_angle
    swept += plant.taps_angle[:, :1] * output
    swept[:, volts:integral] += plant.taps_angle[:, 1:]
    if observer is not None:
        delayed = observer.taps[0] * output
        delayed[:, volts : volts + observer.taps.size - 1] += observer.taps[1:]
        A[:, s:volts, s:volts] = observer.advance
        A[:, s:volts] += observer.by_angle[:, None] * swept[:, None, :]
        A[:, s:volts] += observer.by_voltage[:, None] * delayed[:, None, :]
    elif window:
        A[:, s] = swept
        A[:, s + 1 : volts] = unit[s : volts - 1]
    if m > 1:
        A[:, volts] = output
        A[:, volts + 1 : integral] = unit[volts : integral - 1]
    A[:, integral] = unit[integral] - feedback.i * T * speed
    A[:, -1] = filtered
    return A


def spectral_radius(plant: Plant, feedback: Feedback) -> Array:
    """Return the largest eigenvalue magnitude of every closed loop of a batch."""
    A = closed_loop(plant, feedback)
    if np.ndim(feedback.i) == 0 and feedback.i == 0.0:
        # An integral that nothing feeds stays as it is, and belongs to no loop.
        A = np.delete(np.delete(A, -2, axis=1), -2, axis=2)
    eigenvalues = np.linalg.eigvals(A)
    return np.asarray(np.abs(eigenvalues).max(axis=1), dtype=np.float64)


TINY = float(np.finfo(np.float64).tiny)
ROUNDING = 1e-9
"""Response [-] that counts as zero: an average over an even window has a zero at Nyquist."""


@dataclass(frozen=True)
class Margins:
    """How far the sampled loop is from instability."""

    phase: float  # phase margin [deg]
    gain: float  # gain margin as a factor [-]; infinite where the phase never crosses -180 deg
    delay: float  # additional delay that the loop bears [s]
    sensitivity: float  # peak Ms of ``|1 / (1 + L)|`` [-]
    crossover: float  # frequency at which the loop gain is 1 [rad/s]
    spectral_radius: float  # largest closed-loop eigenvalue magnitude [-]; stable below 1

    @property
    def stable(self) -> bool:
        """Whether the closed loop is stable."""
        return self.spectral_radius < 1.0


def frequencies(sample_time: float, slowest: float, count: int = 500) -> Array:
    """Return a logarithmic grid from well below the loop's slowest corner to Nyquist."""
    nyquist = math.pi / sample_time
    lowest = min(0.02 * slowest, 1e-3 * nyquist)
    return np.geomspace(lowest, nyquist, count, dtype=np.float64)


def make_grid(plant: Plant, count: int = 500) -> Array:
    """Return the frequency grid that suits a batch of plants; see :func:`frequencies`."""
    motors = plant.motors
    return frequencies(plant.sample_time, float(np.min(motors.a0 / motors.a1)), count)


class BatchMargins(NamedTuple):
    """Margins of a batch of loops: arrays of shape (n,), order and units as in Margins.

    The phase margin is the smallest rotation, of either sign, that brings the loop to -1.
    """

    phase: Array
    gain: Array
    delay: Array
    sensitivity: Array
    crossover: Array


def loop_margins(plant: Plant, feedback: Feedback) -> Margins:
    """Return the margins of one loop, to six digits or better."""
    omega = make_grid(plant, 1000)
    for _ in range(3):
        loop = plant.response(omega)[:1] * feedback.response(omega, plant.sample_time)
        m = batch_margins(loop, omega)
        omega = _refine(omega, loop[0])
    radius = float(spectral_radius(plant, feedback)[0])
    phase, gain, delay, sensitivity, crossover = (float(values[0]) for values in m)
    phase = math.copysign(phase, 1 - radius)
    return Margins(phase, gain, delay, sensitivity, crossover, radius)


def _refine(omega: Array, loop: Complex) -> Array:
    """Return the grid, 16 times finer where a margin is read."""
    near = _changes(np.abs(loop) > 1) | _changes(loop.imag > 0)
    closest = int(np.argmin(np.abs(1 + loop)))
    near[max(closest - 1, 0) : closest + 1] = True
    inner = omega[:-1][near, None] + np.diff(omega)[near, None] * np.arange(1, 16) / 16
    return np.sort(np.concatenate([omega, inner.ravel()]))


def _changes(flags: Flags) -> Flags:
    return np.asarray(flags[..., :-1] != flags[..., 1:], dtype=np.bool_)


def batch_margins(loop: Complex, omega: Array) -> BatchMargins:
    """Return the margins of many loops from their frequency responses on a grid up to Nyquist."""
    falls = _changes(np.abs(loop) > 1)
    size = np.log(np.maximum(np.abs(loop), TINY))
    share = size[:, :-1] / np.where(falls, size[:, :-1] - size[:, 1:], 1.0)
    # The angle from -180 deg: rotate by pi so that the principal value is the margin itself.
    turn = np.angle(-loop[:, :-1]) + share * np.angle(loop[:, 1:] * loop[:, :-1].conj())
    turn = np.where(falls, np.remainder(turn, 2 * np.pi), np.inf)  # lag that brings it to -1
    where = np.where(falls, omega[:-1] + share * np.diff(omega), np.nan)
    phase = np.rad2deg(np.minimum(turn, np.abs(2 * np.pi - turn)).min(axis=1))
    delay = np.where(falls, turn / where, np.inf).min(axis=1)
    crossover = np.fmax.reduce(where, axis=1)  # NaN where there is none
    crosses = _changes(loop.imag > 0)
    part = loop[:, :-1].imag / np.where(crosses, loop[:, :-1].imag - loop[:, 1:].imag, 1.0)
    real = loop[:, :-1].real + part * np.diff(loop.real, axis=1)
    # At Nyquist the response of a sampled loop is real: a crossing of its own.
    real = np.concatenate([np.where(crosses, real, 0.0), loop[:, -1:].real], axis=1)
    below = (real < -ROUNDING) & (real > -1)
    gain = np.where(below, -1 / np.where(below, real, -1.0), np.inf).min(axis=1)
    # The Nyquist curve's distance from -1, by its chords.
    start, chord = 1 + loop[:, :-1], np.diff(loop, axis=1)
    nearest = -(start * chord.conj()).real / np.maximum(np.abs(chord) ** 2, TINY)
    distance = np.abs(start + np.clip(nearest, 0.0, 1.0) * chord).min(axis=1)
    return BatchMargins(phase, gain, delay, 1 / distance, crossover)
