"""The pass over a motor that only slides: every sensitivity from one copy of the motor.

Without events the speed's sensitivity to any parameter is a combination of the same few
signals: the speed sent once more through the motor (``W``, with ``Q = R i`` of that copy and
``D = te Q'``), the two free decays, and a constant.  Two recursions of second order are run
therefore, whatever the number of parameters; sums of squares and products are gathered tile
by tile in the basis, and mapped to the parameters once per segment.
Derivation: docs/derivations.md, section 6.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident._compile import compiled
from smp_motor_ident.likelihood.sliding import (
    FREE_Q,
    FREE_W,
    NUMBERS,
    ONE,
    RAMP,
    RESIDUAL,
    TILE,
    march,
    tabulate,
)

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


@compiled
def _chain(
    c: Array, angle: bool, par: Array, slope: Array, local: Integers, q: float, w: float
) -> None:
    """Fill c, shape (7, p): the columns of the problem in the basis; q, w: first state."""
    te, tm, k, be = par[0], par[1], par[2], par[3]
    n_common = slope.shape[1]
    c[:] = 0.0
    for j in range(c.shape[1]):
        load = 0.0
        if j < n_common:
            on_te, on_tm, on_k, on_be = slope[0, j], slope[1, j], slope[2, j], slope[3, j]
            load = slope[6, j]
            if te > 0.0:
                lag = (tm - te * be) / tm
                c[0, j] = -on_k - on_be * lag + on_tm * lag * be
                c[1, j] = -on_be * te / tm - on_tm * lag
                c[FREE_Q, j] = on_te * (q - tm / te * w)
            else:
                on_te = 0.0
                c[0, j] = -on_k - on_be
            c[2, j] = -on_te - on_tm
            c[FREE_W, j] = (on_te + on_tm) * w
        else:
            own = local[j - n_common]
            if own == 0:
                c[FREE_Q, j] = 1.0
            elif own == 1:
                c[FREE_W, j] = 1.0
            elif own == 3:
                load = 1.0
        # A constant load is a voltage less, and R i less at the beginning.
        c[ONE, j] = -load / (k + be)
        c[FREE_W, j] += load / (k + be)
        c[FREE_Q, j] += load * (be / (k + be) - 1.0)
        if angle:
            c[RAMP, j] = c[ONE, j]
            c[ONE, j] = 1.0 if j >= n_common and local[j - n_common] == 2 else 0.0
            on_w, on_q, on_d = c[0, j], c[1, j], c[2, j]
            c[0, j] = on_w + on_q * be
            c[1, j] = on_q * tm + (on_d * tm if te == 0.0 else 0.0)
            c[2, j] = on_d * te


@compiled
def _gather(tile: Array, m: int, rows: Integers, squares: Array, scores: Array) -> float:
    """Add the tile's products to the sums; return its sum of squared residuals."""
    residual = tile[RESIDUAL]
    for a in range(rows.shape[0]):
        one = tile[rows[a]]
        for b in range(a + 1):
            other = tile[rows[b]]
            total = 0.0
            for i in range(m):
                total += one[i] * other[i]
            squares[rows[a], rows[b]] += total
        total = 0.0
        for i in range(m):
            total += one[i] * residual[i]
        scores[rows[a]] += total
    total = 0.0
    for i in range(m):
        total += residual[i] * residual[i]
    return total


@compiled
def _project(c: Array, squares: Array, weight: float, normal: Array) -> None:
    """Fill the normal matrix of the columns, ``weight^2 c' S c``."""
    n, p = c.shape
    for a in range(n):
        for b in range(a):
            squares[b, a] = squares[a, b]
    half = np.zeros((n, p))
    for a in range(n):
        for j in range(p):
            for b in range(n):
                half[a, j] += squares[a, b] * c[b, j]
    for i in range(p):
        for j in range(i + 1):
            total = 0.0
            for a in range(n):
                total += c[a, i] * half[a, j]
            normal[i, j] = normal[j, i] = weight * weight * total


@compiled
def _rows(angle: bool, load: bool, fades: bool) -> Integers:
    """Return which rows of the basis matter."""
    wanted = np.zeros(7, dtype=np.int64)
    count = 3
    for n in range(3):
        wanted[n] = n
    for row, there in (
        (ONE, angle or load),
        (RAMP, angle and load),
        (FREE_Q, fades or angle),
        (FREE_W, fades or angle),
    ):
        if there:
            wanted[count] = row
            count += 1
    return wanted[:count]


@compiled
def run_sliding(
    time: Array,
    starts: Integers,
    voltage: Array,
    output: Array,
    angle: bool,
    par: Array,
    slope: Array,
    initial: Array,
    local: Integers,
    usual: float,
    weight: float,
    normal: Array,
    gradient: Array,
    cost: Array,
    spread: Array,
    block_length: int,
    blocks: Array,
    block_segment: Integers,
) -> int:
    """Run as `recursion.run` does where nothing happens between the samples.

    Without friction, delay, window, current, robust loss and innovations; the input changes
    at the samples.
    """
    p = slope.shape[1] + local.shape[0]
    loaded = bool(np.any(slope[6] != 0.0)) or bool(np.any(local == 3))
    row, table = np.zeros(NUMBERS), tabulate(usual, par)
    x = np.zeros(15)
    tile = np.zeros((RESIDUAL + 1, TILE))
    c = np.zeros((RESIDUAL, p))
    squares = np.zeros((RESIDUAL, RESIDUAL))
    scores = np.zeros(RESIDUAL)
    spread[:] = 0.0
    block = -1
    for g in range(starts.shape[0] - 1):
        first, last = starts[g], starts[g + 1]
        load = par[6] + initial[g, 3]
        x[1:] = 0.0
        x[1], x[2], x[3] = initial[g, 0] - load, initial[g, 1], initial[g, 2]
        x[7] = x[11] = 1.0
        _chain(c, angle, par, slope, local, x[1], x[2])
        if par[0] == 0.0:
            x[1] = x[7] = 0.0
        squares[:] = 0.0
        gradient[g] = 0.0
        total = 0.0
        rows = _rows(angle, loaded, True)
        begin = first
        while begin < last:
            stop = min(begin + block_length, last)
            block += 1
            block_segment[block] = g
            scores[:] = 0.0
            while begin < stop:
                end = min(begin + TILE, stop)
                there = march(
                    time, voltage, output, begin, end, first, load, angle, par, x, row, table, tile
                )
                if there < 0:
                    there = -there - 1
                    rows = _rows(angle, loaded, False)
                spread[3] += there
                total += _gather(tile, end - begin, rows, squares, scores)
                begin = end
            for j in range(p):
                score = 0.0
                for a in range(RESIDUAL):
                    score += c[a, j] * scores[a]
                blocks[block, j] = weight * weight * score
                gradient[g, j] += blocks[block, j]
        spread[0] += total
        cost[g] = weight * weight * total
        _project(c, squares, weight, normal[g])
    return block + 1
