"""Margins of the sampled loop: phase, gain, delay and peak of the sensitivity.

One nominal loop is analysed with python-control; a batch of uncertain ones by the same
definitions on a frequency grid, all at once.

References
----------
.. [1] K. J. Astrom, T. Hagglund, Advanced PID Control (2006), section 4.6.
"""

import math
from dataclasses import dataclass

import control
import numpy as np

from smp_motor_control.arrays import Array, Complex
from smp_motor_ident.tune.feedback import Feedback, spectral_radius
from smp_motor_ident.tune.plant import Plant


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


def grid_for(plant: Plant, count: int = 500) -> Array:
    """Return the frequency grid that suits a batch of plants; see :func:`frequencies`."""
    motors = plant.motors
    return frequencies(plant.sample_time, float(np.min(motors.a0 / motors.a1)), count)


def loop_margins(plant: Plant, feedback: Feedback) -> Margins:
    """Return the margins of one loop, by python-control."""
    omega = grid_for(plant, 2000)
    loop = plant.response(omega)[0] * feedback.response(omega, plant.sample_time)
    data = control.FRD(loop, omega, smooth=True)
    gain, phase, least, _, crossings, _ = control.stability_margins(data, returnall=True)
    upward = np.array([g for g in np.atleast_1d(gain) if g > 1.0])
    phases, crossings = np.atleast_1d(phase), np.atleast_1d(crossings)
    radius = float(spectral_radius(plant, feedback)[0])
    worst = int(np.argmin(np.abs(phases))) if phases.size else -1
    delays = np.deg2rad(np.where(phases < 0, phases + 360, phases)) / crossings
    distance = float(np.min(least)) if np.size(least) else float(np.min(np.abs(1 + loop)))
    return Margins(
        phase=float(phases[worst]) if phases.size else math.inf,
        gain=float(upward.min()) if upward.size else math.inf,
        delay=float(delays.min()) if phases.size else math.inf,
        sensitivity=1 / min(distance, float(np.min(np.abs(1 + loop)))),
        crossover=float(crossings.max()) if phases.size else math.nan,
        spectral_radius=radius,
    )


@dataclass(frozen=True, eq=False)
class BatchMargins:
    """The same margins for a batch of loops: arrays of shape (n,), units as in Margins."""

    phase: Array
    gain: Array
    sensitivity: Array
    crossover: Array


def batch_margins(loop: Complex, omega: Array) -> BatchMargins:
    """Return the margins of many loops from their frequency responses."""
    size = np.log(np.abs(loop))
    falls = (size[:, :-1] > 0) != (size[:, 1:] > 0)
    share = size[:, :-1] / np.where(falls, size[:, :-1] - size[:, 1:], 1.0)
    # The angle from -180 deg: rotate by pi so that the principal value is the margin itself.
    turn = np.angle(-loop)
    step = np.angle(loop[:, 1:] / loop[:, :-1])
    at = np.rad2deg(np.abs(turn[:, :-1] + share * step))
    phase = np.where(falls, at, np.inf).min(axis=1)
    where = np.where(falls, omega[:-1] + share * np.diff(omega), 0.0)
    crosses = (loop[:, :-1].imag > 0) != (loop[:, 1:].imag > 0)
    part = loop[:, :-1].imag / np.where(crosses, loop[:, :-1].imag - loop[:, 1:].imag, 1.0)
    real = loop[:, :-1].real + part * np.diff(loop.real, axis=1)
    # At Nyquist the response of a sampled loop is real: a crossing of its own.
    real = np.concatenate([np.where(crosses, real, 0.0), loop[:, -1:].real], axis=1)
    below = (real < 0) & (real > -1)
    gain = np.where(below, -1 / np.where(below, real, -1.0), np.inf).min(axis=1)
    distance = np.abs(1 + loop).min(axis=1)
    return BatchMargins(phase, gain, 1 / distance, where.max(axis=1))
