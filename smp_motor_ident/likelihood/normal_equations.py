"""The normal equations of a pass: gathered in tiles, own columns eliminated, damped step.

At a few parameters numpy's calls cost more than plain compiled loops.
Derivation: docs/derivations.md, sections 6 and 8.
"""

from __future__ import annotations

import math

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident._compile import compiled, inlined
from smp_motor_ident.likelihood.sensitivities import LANES

TILE = 64  # rows that are gathered before they are summed
ROOM = LANES + 1  # of each: columns and residual
SHAPE = 4  # coordinates that come first, all logarithms
FARTHEST = 1.5  # e-folds of one step


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


LOST = 1e-14  # of a column's information, below which what is left after elimination is rounding


@compiled
def cholesky_solve(a: Array, b: Array) -> None:
    """Solve ``a x = b`` for a symmetric positive matrix with unit diagonal or larger."""
    n, m = b.shape
    for j in range(n):
        pivot = a[j, j]
        for k in range(j):
            pivot -= a[j, k] * a[j, k]
        a[j, j] = math.sqrt(pivot) if pivot > 1e-16 else math.inf
        for i in range(j + 1, n):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            a[i, j] = total / a[j, j]
    for c in range(m):
        for i in range(n):
            for k in range(i):
                b[i, c] -= a[i, k] * b[k, c]
            b[i, c] /= a[i, i]
        for i in range(n - 1, -1, -1):
            for k in range(i + 1, n):
                b[i, c] -= a[k, i] * b[k, c]
            b[i, c] /= a[i, i]


@compiled
def eliminate(  # noqa: C901 - plain loops
    normal: Array,
    gradient: Array,
    away: Array,
    near: Array,
    value: Array,
    known: Array,
    size: int,
    common: Array,
    score: Array,
    local_step: Array,
    local_gain: Array,
    scores: Array,
    owner: Integers,
) -> tuple[float, float]:
    """Eliminate each segment's own columns from the normal equations.

    They are zero to within a precision that is known of each.  A wide prior around where they
    began keeps a motor at rest, whose speed the data do not touch, solvable; it weighs ``near``
    of a sample's information at most.
    """
    f, own = score.shape[0], away.shape[1]
    total = decrease = 0.0
    small = np.empty((own, own))
    right = np.empty((own, f + 1))
    scale = np.empty(own)
    before = np.empty(f)
    for g in range(normal.shape[0]):
        for j in range(own):
            d = f + j
            precision = near[j] * max(1e-12, normal[g, d, d] / size) + 1e-9
            total += precision * away[g, j] * away[g, j] + known[g, j] * value[g, j] * value[g, j]
            gradient[g, d] -= precision * away[g, j] + known[g, j] * value[g, j]
            normal[g, d, d] += precision + known[g, j]
            scale[j] = math.sqrt(normal[g, d, d])
        common += normal[g, :f, :f]
        score += gradient[g, :f]
    for i in range(f):
        before[i] = common[i, i]
    for g in range(normal.shape[0]):
        for j in range(own):
            scale[j] = math.sqrt(normal[g, f + j, f + j])
        for j in range(own):
            for i in range(own):
                small[j, i] = normal[g, f + j, f + i] / (scale[j] * scale[i])
            small[j, j] += 1e-12
            for i in range(f):
                right[j, i] = normal[g, f + j, i] / scale[j]
            right[j, f] = gradient[g, f + j] / scale[j]
        cholesky_solve(small, right)
        for j in range(own):
            local_step[g, j] = right[j, f] / scale[j]
            decrease += gradient[g, f + j] * local_step[g, j]
            for i in range(f):
                local_gain[g, j, i] = right[j, i] / scale[j]
            for i in range(f):
                cross = normal[g, f + j, i]
                score[i] -= cross * local_step[g, j]
                for k in range(f):
                    common[i, k] -= cross * local_gain[g, j, k]
    for b in range(owner.shape[0]):
        for j in range(own):
            for i in range(f):
                scores[b, i] -= scores[b, f + j] * local_gain[owner[b], j, i]
    for i in range(f):
        if common[i, i] <= LOST * before[i]:  # nothing but rounding is left
            common[i, :] = 0.0
            common[:, i] = 0.0
            score[i] = 0.0
    return total, decrease


@compiled
def damped_step(  # noqa: C901 - plain loops
    normal: Array,
    gradient: Array,
    damping: float,
    matrix: Array,
    z: Array,
    lower: Array,
    upper: Array,
) -> tuple[Array, float]:
    """Return the damped Gauss-Newton step; columns pushed against a bound stay."""
    f = gradient.shape[0]
    step = np.zeros(f)
    frozen = np.zeros(f, dtype=np.bool_)
    scale = np.empty(f)
    for i in range(f):
        scale[i] = math.sqrt(max(normal[i, i], 1e-300))
    for _ in range(f):
        a = np.zeros((f, f))
        b = np.zeros((f, 1))
        for i in range(f):
            a[i, i] = 1.0
            if frozen[i]:
                continue
            for j in range(f):
                if not frozen[j]:
                    a[i, j] = normal[i, j] / (scale[i] * scale[j])
            a[i, i] += damping + 1e-14
            b[i, 0] = gradient[i] / scale[i]
        cholesky_solve(a, b)
        for i in range(f):
            step[i] = b[i, 0] / scale[i]
        more = False
        for m in range(z.shape[0]):
            move = 0.0
            for i in range(f):
                move += matrix[m, i] * step[i]
            if (z[m] <= lower[m] and move < 0.0) or (z[m] >= upper[m] and move > 0.0):
                for i in range(f):
                    if matrix[m, i] != 0.0 and not frozen[i]:
                        frozen[i] = more = True
        if not more:
            break
    longest = size = 0.0
    for i in range(f):  # what shows in nothing, however far it goes, holds nothing else back
        for m in range(SHAPE):
            move = abs(matrix[m, i] * step[i])
            if move > FARTHEST and normal[i, i] * FARTHEST * FARTHEST < 1.0:
                step[i] *= FARTHEST / move
    for m in range(SHAPE):
        move = 0.0
        for i in range(f):
            move += matrix[m, i] * step[i]
        longest = max(longest, abs(move))
    if longest > FARTHEST:
        for i in range(f):
            step[i] *= FARTHEST / longest
    for i in range(f):
        for j in range(f):
            size += step[i] * normal[i, j] * step[j]
    return step, math.sqrt(max(size, 0.0))
