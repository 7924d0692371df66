# SPDX-License-Identifier: Apache-2.0
"""Margins of the sampled loop: phase, gain, delay and peak of the sensitivity.

Loops are read where their frequency response on a grid crosses unit gain and the real axis: a
batch of uncertain ones all at once, the nominal one on a grid that is refined at its crossings.

References
----------
.. [1] K. J. Astrom, T. Hagglund, Advanced PID Control (2006), section 4.6.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from smp_motor_control.arrays import Array, Complex, Flags
from smp_motor_ident.tune.feedback import Feedback, spectral_radius
from smp_motor_ident.tune.plant import Plant

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
