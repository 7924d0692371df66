"""The angle a window ago, for a speed that is a mean over it.

Derivation: docs/derivations.md, section 4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident._compile import compiled
from smp_motor_ident.likelihood.lanes import ST, SW

Array = NDArray[np.float64]


@compiled
def remember(ring: Array, k: int, t: float, x: Array, m: Array) -> None:
    """Keep time, angle, speed and the sensitivities of both."""
    row = ring[k % ring.shape[0]]
    p = (ring.shape[1] - 3) // 2
    row[0] = t
    row[1] = x[2]
    row[2] = x[1]
    for j in range(p):
        row[3 + j] = m[ST + j]
        row[3 + p + j] = m[SW + j]


@compiled
def recall(ring: Array, k: int, first: int, t: float, p: int, past: Array) -> float:
    """Put the angle at time t and its sensitivities into `past`; return the speed there."""
    n = ring.shape[0]
    oldest = max(first, k - n + 1)
    a = ring[oldest % n]
    if t <= a[0]:  # before the record: the speed it began with
        for j in range(p):
            past[1 + j] = a[3 + j] + (t - a[0]) * a[3 + p + j]
        past[0] = a[1] + (t - a[0]) * a[2]
        return float(a[2])
    i = k
    while i > oldest and ring[(i - 1) % n][0] > t:
        i -= 1
    a, b = ring[(i - 1) % n], ring[i % n]
    h = b[0] - a[0]
    u = (t - a[0]) / h
    h00 = (1 + 2 * u) * (1 - u) * (1 - u)
    h10 = u * (1 - u) * (1 - u) * h
    h01 = u * u * (3 - 2 * u)
    h11 = u * u * (u - 1) * h
    past[0] = h00 * a[1] + h10 * a[2] + h01 * b[1] + h11 * b[2]
    for j in range(p):
        past[1 + j] = h00 * a[3 + j] + h10 * a[3 + p + j] + h01 * b[3 + j] + h11 * b[3 + p + j]
    d = 6 * u * (1 - u) / h
    return float(d * (b[1] - a[1]) + (1 - u) * (1 - 3 * u) * a[2] + u * (3 * u - 2) * b[2])
