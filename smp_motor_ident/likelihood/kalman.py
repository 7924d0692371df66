"""The steady innovation gain of the sliding motor under torque noise.

The Riccati equation is solved by doubling, in plain loops over 3 x 3 matrices: it is asked
for at every step of a fit, where a general solver would cost more than the data.

References
----------
Anderson and Moore, Optimal Filtering, 1979, section 6.7 (doubling).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident._compile import compiled
from smp_motor_ident.likelihood.propagator import WIDTH, first_order, second_order

Array = NDArray[np.float64]


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


@compiled
def steady_gain(
    te: float,
    tm: float,
    k: float,
    be: float,
    resistance: float,
    step: float,
    ratio: float,
    current_noise: float,
) -> tuple[Array, Array]:
    """Return gain and innovation covariance for an angle (and a current) measured.

    Parameters
    ----------
    te, tm, k, be : float
        As in `propagator.second_order`; ``te`` 0 means first order.
    resistance : float
        R [ohm].
    step : float
        Sampling interval [s].
    ratio : float
        Intensity of white noise on the acceleration over the angle's noise variance.
    current_noise : float
        Variance of the current's noise over the angle's; 0 without current.

    Returns
    -------
    gain : ndarray, shape (3, 2)
        From (angle, current) to (q, w, angle).
    innovation : ndarray, shape (2, 2)
        Over the angle's noise variance.
    """
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
                h[i, j] += weight * step * ratio * c[i] * c[j]
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
