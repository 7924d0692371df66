"""What the residuals tell of the noise: innovation gain, covariance, whitening, deviance.

Derivation: docs/derivations.md, sections 6 and 7.

The Riccati equation is solved by doubling (Anderson and Moore, Optimal Filtering, 1979, section
6.7) in plain compiled loops over 3 x 3 matrices: it is asked for at every step of a fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident._compile import compiled
from smp_motor_ident.likelihood.propagator import BE, TE, TM, WIDTH, K, first_order, second_order
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.measurement import ANGLE, Measurement
from smp_motor_ident.model.structure import Structure

NO_GAIN = np.zeros((3, 2))


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """How residuals come about and weigh."""

    # shape (2, 2): of the innovations of (output, current)
    covariance: Array = field(default_factory=lambda: np.eye(2))
    # shape (3, 2): innovation gain; zero for output error
    gain: Array = field(default_factory=lambda: NO_GAIN)
    # Bound of the robust loss [standard deviations]; infinite for least squares
    huber: float = math.inf


@compiled
def _times(a: Array, b: Array) -> Array:
    c = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            for k in range(a.shape[1]):
                c[i, j] += a[i, k] * b[k, j]
    return c


@compiled
def _inverse(a: Array) -> Array:
    """Return the inverse of a 3 x 3 matrix by cofactors."""
    b = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            i1, i2, j1, j2 = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            b[j, i] = a[i1, j1] * a[i2, j2] - a[i1, j2] * a[i2, j1]
    det = a[0, 0] * b[0, 0] + a[0, 1] * b[1, 0] + a[0, 2] * b[2, 0]
    for i in range(3):
        for j in range(3):
            b[i, j] /= det
    return b


@compiled
def _row(h: float, te: float, tm: float, k: float, be: float) -> Array:
    row = np.zeros(WIDTH)
    if te > 0.0:
        second_order(row, h, te, tm, k, be)
    else:
        first_order(row, h, tm, k, be)
    return row


def transition(structure: Structure, z: Coordinates, step: float) -> Array:
    """Return how voltage over the resistance, speed and angle follow from those a step before."""
    par, _ = structure.internal(z)
    row = _row(step, par[TE], par[TM], par[K], par[BE])
    return np.array([[row[0], row[1], 0.0], [row[2], row[3], 0.0], [row[4], row[5], 1.0]])


@compiled
def steady_gain(
    te: float,
    tm: float,
    k: float,
    be: float,
    resistance: float,
    step: float,
    noise_ratio: float,
    current_noise: float,
) -> tuple[Array, Array]:
    """Return gain and innovation covariance for an angle (and a current) measured."""
    row = _row(step, te, tm, k, be)
    a: Array = np.zeros((3, 3))  # the transposed transition
    a[0, 0], a[1, 0], a[0, 1], a[1, 1] = row[0], row[1], row[2], row[3]
    a[0, 2], a[1, 2], a[2, 2] = row[4], row[5], 1.0
    # Noise gathered over the step: Gauss-Legendre over the answers to an impulse.
    h: Array = np.zeros((3, 3))
    for n in range(3):
        x = 0.5 + (n - 1) * 0.3872983346207417
        weight = 5 / 18 if n != 1 else 8 / 18
        part = _row(x * step, te, tm, k, be)
        c = (part[1], part[3], part[5])
        for i in range(3):
            for j in range(3):
                h[i, j] += weight * step * noise_ratio * c[i] * c[j]
    g: Array = np.zeros((3, 3))
    g[2, 2] = 1.0
    if current_noise > 0.0:
        g[0, 0] = 1.0 / (resistance * resistance * current_noise)
    for _ in range(60):
        w = _times(g, h)
        for i in range(3):
            w[i, i] += 1.0
        aw = _times(a, _inverse(w))
        hw = _times(h, _inverse(w))
        g_new = g + _times(_times(aw, g), a.T)
        add = _times(_times(a.T, hw), a)
        a = _times(aw, a)
        g = 0.5 * (g_new + g_new.T)
        h = h + 0.5 * (add + add.T)
        size = abs(add[0, 0]) + abs(add[1, 1]) + abs(add[2, 2])
        if not math.isfinite(size) or size < 1e-13 * (h[0, 0] + h[1, 1] + h[2, 2]):
            break
    gain = np.zeros((3, 2))
    innovation = np.eye(2)
    s00 = h[2, 2] + 1.0
    if current_noise == 0.0:
        innovation[0, 0] = s00
        for i in range(3):
            gain[i, 0] = h[i, 2] / s00
        return gain, innovation
    s01 = h[2, 0] / resistance
    s11 = h[0, 0] / (resistance * resistance) + current_noise
    det = s00 * s11 - s01 * s01
    for i in range(3):
        p0, p1 = h[i, 2], h[i, 0] / resistance
        gain[i, 0] = (p0 * s11 - p1 * s01) / det
        gain[i, 1] = (p1 * s00 - p0 * s01) / det
    innovation[0, 0], innovation[0, 1], innovation[1, 0], innovation[1, 1] = s00, s01, s01, s11
    return gain, innovation


LEAST = 1e-24  # variance
CLOSEST = 0.95  # correlation of two outputs' residuals


def kalman_gain(
    structure: Structure,
    z: Coordinates,
    kind: Measurement,
    step: float,
    noise_ratio: float,
    current_noise: float,
) -> tuple[Array, Array]:
    """Return the steady innovation gain of the sliding motor under torque noise."""
    gain = np.zeros((3, 2))
    innovation = np.diag([1.0, current_noise if current_noise > 0 else 1.0])
    if noise_ratio <= 0 or kind != ANGLE:
        return gain, innovation
    par, _ = structure.internal(z)
    resistance = float(np.exp(z.ln_r))
    found, spread = steady_gain(
        par[TE], par[TM], par[K], par[BE], resistance, step, noise_ratio, current_noise
    )
    if not np.all(np.isfinite(found)):
        return gain, innovation
    return found, spread


def gain_for(
    structure: Structure,
    z: Coordinates,
    kind: Measurement,
    step: float,
    noise_ratio: float,
    noise: Array,
    current: bool,
) -> Array:
    """Return the innovation gain that goes with a covariance of the innovations."""
    if noise_ratio <= 0:
        return NO_GAIN
    relative = float(noise[1, 1] / noise[0, 0]) if current else 0.0
    gain, innovation = kalman_gain(structure, z, kind, step, noise_ratio, relative)
    for _ in range(3):  # noise holds innovations; the ratio of the sensors' own is wanted
        if not current:
            break
        relative = float(
            (noise[1, 1] / innovation[1, 1] * relative) / (noise[0, 0] / innovation[0, 0])
        )
        gain, innovation = kalman_gain(structure, z, kind, step, noise_ratio, relative)
    return gain


def proper(noise: Array) -> Array:
    """Return the nearest covariance that can be one: finite, positive, not fully correlated."""
    v0, v1 = (float(v) if math.isfinite(v) and v > 0 else 1.0 for v in np.diag(noise))
    limit = CLOSEST * math.sqrt(v0 * v1)
    c = float(noise[1, 0])
    c = min(max(c, -limit), limit) if math.isfinite(c) else 0.0
    return np.array([[v0, c], [c, v1]])


def whitening(noise: Array) -> Array:
    """Return the whitening rows of `recursion.run` for a 2 x 2 noise covariance."""
    v0, c, v1 = noise[0, 0], noise[1, 0], noise[1, 1]
    rest = math.sqrt(v1 - c / v0 * c)  # of variances whose product overflows, too
    w = np.zeros((2, 3))
    w[0, 0] = w[0, 2] = 1 / math.sqrt(v0)
    w[1] = -c / v0 / rest, 1 / rest, 1 / math.sqrt(v1)
    return w


def renewed(spread: Array, noise: Array, current: bool) -> Array:
    """Return the covariance that the residuals show."""
    fresh = noise.copy()
    fresh[0, 0] = max(spread[0] / max(spread[3], 1), LEAST)
    fresh[0, 1] = fresh[1, 0] = 0.0
    if current:
        fresh[1, 1] = max(spread[1] / max(spread[4], 1), LEAST)
        limit = CLOSEST * math.sqrt(fresh[0, 0]) * math.sqrt(fresh[1, 1])
        fresh[0, 1] = fresh[1, 0] = min(max(spread[2] / max(spread[5], 1), -limit), limit)
    return fresh


def deviance(spread: Array) -> float:
    """Return -2 log likelihood up to a constant: N log det of the innovations' covariance."""
    log0 = math.log(max(spread[0] / max(spread[3], 1), 1e-300))
    if spread[4] < 1:
        return float(spread[3] * log0)
    log1 = math.log(max(spread[1] / spread[4], 1e-300))
    # The three are means over different samples where outputs were lost, and need not belong
    # to one covariance.  Far from the motor only their logarithms are numbers.
    alike = float(spread[2]) / max(spread[5], 1) * math.exp(-0.5 * log0) * math.exp(-0.5 * log1)
    alike = min(max(alike, -CLOSEST), CLOSEST)
    return float(spread[5] * math.log1p(-alike * alike) + spread[3] * log0 + spread[4] * log1)
