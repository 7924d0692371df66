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

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident._compile import compiled
from smp_motor_ident.likelihood.propagator import (
    BE,
    DECAYED,
    NODES,
    POINTS,
    ROW,
    TE,
    TM,
    WIDTH,
    K,
    evaluate,
    expand,
    first_order,
    half_range,
    second_order,
)
from smp_motor_ident.model.columns import LOAD

TILE = 128
# Rows of the basis: for a speed W, Q, D; for an angle the angle of the copy, W, Q.
ONE, RAMP, FREE_Q, FREE_W, RESIDUAL = 3, 4, 5, 6, 7
GONE = 1e-17  # of a free decay, below which it adds nothing to sums in double precision
NUMBERS = 18  # of a propagator that matter: E, H, Gv and their derivatives by K


@compiled
def _exact(row: Array, h: float, par: Array) -> None:
    """Put E, H and Gv over h into a row, then their derivatives by K."""
    whole = np.empty(WIDTH)
    if par[TE] > 0.0:
        second_order(whole, h, par[TE], par[TM], par[K], par[BE])
    else:
        first_order(whole, h, par[TM], par[K], par[BE])
    for n in range(9):
        row[n], row[9 + n] = whole[n], whole[3 * ROW + n]


@compiled
def tabulate(usual: float, par: Array) -> Array:
    """Return the table of propagators around a jittering interval; its range comes last."""
    half = half_range(usual, par[TE], par[TM], par[K], par[BE])
    if half == 0.0:
        return np.zeros(0)
    values, table = np.empty(NODES * NUMBERS), np.empty(NODES * NUMBERS + 2)
    for n in range(NODES):
        _exact(values[n * NUMBERS : (n + 1) * NUMBERS], usual + half * POINTS[n], par)
    expand(values, table[:-2])
    table[-2], table[-1] = usual, half
    return table


@compiled
def fill(row: Array, h: float, par: Array, table: Array) -> None:
    """Put the propagator over h into a row."""
    if table.shape[0] > 0 and abs(h - table[-2]) <= table[-1]:
        evaluate(table[:-2], (h - table[-2]) / table[-1], row, 0)
    else:
        _exact(row, h, par)


@compiled
def march(
    time: Array,
    voltage: Array,
    output: Array,
    begin: int,
    end: int,
    first: int,
    load: float,
    angle: bool,
    par: Array,
    x: Array,
    row: Array,
    table: Array,
    tile: Array,
) -> int:
    """Advance from sample begin to end, fill the tile; return how many outputs were there."""
    te, k, be = par[TE], par[K], par[BE]
    back = k if te > 0.0 else k + be
    step, q, w, th, cq, cw, cth = x[0], x[1], x[2], x[3], x[4], x[5], x[6]
    if abs(q) + abs(w) + abs(cq) + abs(cw) < DECAYED:
        q = w = cq = cw = 0.0
    pq, pw, pth, rq, rw, rth = x[7], x[8], x[9], x[10], x[11], x[12]
    fades = abs(pw) > GONE * abs(x[13]) or abs(pq) > GONE
    fades = fades or abs(rq) > GONE * abs(x[14]) or abs(rw) > GONE
    e00, e01, e10, e11, h0, h1 = row[0], row[1], row[2], row[3], row[4], row[5]
    v0, v1, v2 = row[6], row[7], row[8]
    o = NUMBERS // 2
    d00, d01, d10, d11, b0, b1 = row[o], row[o + 1], row[o + 2], row[o + 3], row[o + 4], row[o + 5]
    u0, u1, u2 = row[o + 6], row[o + 7], row[o + 8]
    there = 0
    for n in range(begin, end):
        if n > first:
            h = time[n] - time[n - 1]
            if abs(h - step) > 1e-9 * h + 1e-15 * abs(time[n]):
                step = h
                fill(row, h, par, table)
                e00, e01, e10, e11, h0, h1 = row[0], row[1], row[2], row[3], row[4], row[5]
                v0, v1, v2 = row[6], row[7], row[8]
                d00, d01, d10, d11 = row[o], row[o + 1], row[o + 2], row[o + 3]
                b0, b1, u0, u1, u2 = row[o + 4], row[o + 5], row[o + 6], row[o + 7], row[o + 8]
            v = voltage[n] - load
            if angle:
                cth += h0 * cq + h1 * cw - (b0 * q + b1 * w + u2 * v)
                th += h0 * q + h1 * w + v2 * v
            new_cq = e00 * cq + e01 * cw - (d00 * q + d01 * w + u0 * v)
            cw = e10 * cq + e11 * cw - (d10 * q + d11 * w + u1 * v)
            cq = new_cq
            new_q = e00 * q + e01 * w + v0 * v
            w = e10 * q + e11 * w + v1 * v
            q = new_q
            if fades:
                if angle:
                    pth += h0 * pq + h1 * pw
                    rth += h0 * rq + h1 * rw
                new_pq = e00 * pq + e01 * pw
                pw = e10 * pq + e11 * pw
                pq = new_pq
                new_rq = e00 * rq + e01 * rw
                rw = e10 * rq + e11 * rw
                rq = new_rq
        i = n - begin
        if angle:
            error = output[n] - th
            tile[0, i], tile[1, i], tile[2, i] = cth, cw, cq
            tile[RAMP, i] = time[n] - time[first]
            tile[FREE_Q, i], tile[FREE_W, i] = pth, rth
        else:
            error = output[n] - w
            tile[0, i], tile[1, i], tile[2, i] = cw, cq, w - cq - back * cw
            tile[FREE_Q, i], tile[FREE_W, i] = pw, rw
        tile[ONE, i] = 1.0
        tile[RESIDUAL, i] = error
        if error != error:
            for m in range(RESIDUAL + 1):
                tile[m, i] = 0.0
        else:
            there += 1
    x[0], x[1], x[2], x[3], x[4], x[5], x[6] = step, q, w, th, cq, cw, cth
    x[7], x[8], x[9], x[10], x[11], x[12] = pq, pw, pth, rq, rw, rth
    x[13], x[14] = max(x[13], abs(pw)), max(x[14], abs(rq))
    return there if fades else -there - 1


@compiled
def squares_sliding(
    time: Array,
    starts: Integers,
    voltage: Array,
    output: Array,
    angle: bool,
    par: Array,
    initial: Array,
    usual: float,
    predicted: Array,
) -> tuple[float, float]:
    """Return the sum of squared residuals and their number; note speed and output, if asked."""
    row, table = np.zeros(NUMBERS), tabulate(usual, par)
    step, total, count = -1.0, 0.0, 0.0
    e00 = e01 = e10 = e11 = h0 = h1 = v0 = v1 = v2 = 0.0
    for g in range(starts.shape[0] - 1):
        first = starts[g]
        load = par[LOAD] + initial[g, 3]
        q, w, th = initial[g, 0] - load, initial[g, 1], initial[g, 2]
        for n in range(first, starts[g + 1]):
            if n > first:
                h = time[n] - time[n - 1]
                if abs(h - step) > 1e-9 * h + 1e-15 * abs(time[n]):
                    step = h
                    fill(row, h, par, table)
                    e00, e01, e10, e11, h0, h1 = row[0], row[1], row[2], row[3], row[4], row[5]
                    v0, v1, v2 = row[6], row[7], row[8]
                v = voltage[n] - load
                if v == 0.0 and abs(q) + abs(w) < DECAYED:
                    q = w = 0.0
                th += h0 * q + h1 * w + v2 * v
                old = q
                q = e00 * q + e01 * w + v0 * v
                w = e10 * old + e11 * w + v1 * v
            y = th if angle else w
            if predicted.shape[0] > 0:
                predicted[n, 0], predicted[n, 1] = w, y
            e = output[n] - y
            if e == e:
                total += e * e
                count += 1.0
    return total, count


@compiled
def _chain(
    c: Array, angle: bool, par: Array, slope: Array, local: Integers, q: float, w: float
) -> None:
    """Fill c, shape (7, p): the columns of the problem in the basis; q, w: first state."""
    te, tm, k, be = par[TE], par[TM], par[K], par[BE]
    n_common = slope.shape[1]
    c[:] = 0.0
    for j in range(c.shape[1]):
        load = 0.0
        if j < n_common:
            on_te, on_tm, on_k, on_be = slope[TE, j], slope[TM, j], slope[K, j], slope[BE, j]
            load = slope[LOAD, j]
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
def _answer(tile: Array, c: Array, rows: Integers, answers: Array) -> None:
    """Put the sensitivities of the tile's samples, shape (m, p), from the basis."""
    for j in range(answers.shape[1]):
        one = np.zeros(TILE)
        for row in rows:
            share, signal = c[row, j], tile[row]
            for i in range(TILE):
                one[i] += share * signal[i]
        answers[:, j] = one[: answers.shape[0]]


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
    answers: Array,
) -> int:
    """Run as `recursion.run` does where nothing happens between the samples.

    Without friction, delay, window, current, robust loss and innovations; the input changes
    at the samples.  ``answers``, shape (n, 1, p) or none, takes the sensitivities of each sample.
    """
    p = slope.shape[1] + local.shape[0]
    loaded = bool(np.any(slope[LOAD] != 0.0)) or bool(np.any(local == 3))
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
        load = par[LOAD] + initial[g, 3]
        x[1:] = 0.0
        x[1], x[2], x[3] = initial[g, 0] - load, initial[g, 1], initial[g, 2]
        x[7] = x[11] = 1.0
        _chain(c, angle, par, slope, local, x[1], x[2])
        if par[TE] == 0.0:
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
                _answer(tile, c, rows, answers[begin:end, 0])
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
