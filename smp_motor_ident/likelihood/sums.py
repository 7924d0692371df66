"""Sums of products of whitened rows, gathered in tiles so that they run along memory."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident._compile import compiled, inlined
from smp_motor_ident.likelihood.lanes import LANES

Array = NDArray[np.float64]

TILE = 64  # rows that are gathered before they are summed
ROOM = LANES + 1  # of each: columns and residual


@compiled
def sum_up(
    rows: Array, count: int, p: int, tile: Array, normal: Array, gradient: Array, scores: Array
) -> None:
    """Add the products of the gathered rows, each of the columns and then the residual."""
    for n in range(count):  # turned, so that the sums below run along memory
        for j in range(p):
            tile[j, n] = rows[n * ROOM + j]
        tile[p, n] = rows[n * ROOM + LANES]
    tile[: p + 1, count:] = 0.0
    residual = tile[p]
    for j in range(p):
        one = tile[j]
        for i in range(j + 1):
            other = tile[i]
            total = 0.0
            for n in range(TILE):
                total += one[n] * other[n]
            normal[j, i] += total
        total = 0.0
        for n in range(TILE):
            total += one[n] * residual[n]
        gradient[j] += total
        scores[j] += total


@inlined
def robust(r: float, huber: float) -> tuple[float, float]:
    """Return a residual's loss, and the root of the weight that it has left."""
    if abs(r) > huber:
        return huber * (2 * abs(r) - huber), math.sqrt(huber / abs(r))
    return r * r, 1.0
