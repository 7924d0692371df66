"""What the residuals tell of the noise: innovation gain, covariance, whitening, deviance.

Derivation: docs/derivations.md, sections 6 and 7.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.likelihood import recursion
from smp_motor_ident.likelihood.kalman import steady_gain
from smp_motor_ident.model.structures import to_internal

Array = NDArray[np.float64]

LEAST = 1e-24  # variance
CLOSEST = 0.95  # correlation of two outputs' residuals


def kalman_gain(
    z: Array, order: int, kind: int, step: float, ratio: float, current_noise: float
) -> tuple[Array, Array]:
    """Return the steady innovation gain of the sliding motor under torque noise."""
    gain = np.zeros((3, 2))
    innovation = np.diag([1.0, current_noise if current_noise > 0 else 1.0])
    if ratio <= 0 or kind != recursion.ANGLE:
        return gain, innovation
    par, _ = to_internal(z, order)
    found, spread = steady_gain(par[0], par[1], par[2], par[3], par[7], step, ratio, current_noise)
    if not np.all(np.isfinite(found)):
        return gain, innovation
    return found, spread


def gain_for(
    z: Array, order: int, kind: int, step: float, ratio: float, noise: Array, current: bool
) -> Array:
    """Return the innovation gain that goes with a covariance of the innovations."""
    if ratio <= 0:
        return np.zeros((3, 2))
    relative = float(noise[1, 1] / noise[0, 0]) if current else 0.0
    gain, innovation = kalman_gain(z, order, kind, step, ratio, relative)
    for _ in range(3):  # noise holds innovations; the ratio of the sensors' own is wanted
        if not current:
            break
        relative = float(
            (noise[1, 1] / innovation[1, 1] * relative) / (noise[0, 0] / innovation[0, 0])
        )
        gain, innovation = kalman_gain(z, order, kind, step, ratio, relative)
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
    rest = math.sqrt(v1 - c * c / v0)
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
        limit = CLOSEST * math.sqrt(fresh[0, 0] * fresh[1, 1])
        fresh[0, 1] = fresh[1, 0] = min(max(spread[2] / max(spread[5], 1), -limit), limit)
    return fresh


def deviance(spread: Array) -> float:
    """Return -2 log likelihood up to a constant: N log det of the innovations' covariance."""
    v0 = spread[0] / max(spread[3], 1)
    if spread[4] < 1:
        return float(spread[3] * np.log(max(v0, 1e-300)))
    v1 = spread[1] / spread[4]
    # The three are means over different samples where outputs were lost, and need not belong
    # to one covariance.
    limit = CLOSEST * np.sqrt(v0 * v1)
    c = np.clip(spread[2] / max(spread[5], 1), -limit, limit)
    together = np.log(max(v0 * v1 - c * c, 1e-300))
    return float(
        spread[5] * together
        + (spread[3] - spread[5]) * np.log(max(v0, 1e-300))
        + (spread[4] - spread[5]) * np.log(max(v1, 1e-300))
    )
