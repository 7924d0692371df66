"""A motor that only slides, its copy and its free decays, sample by sample.

Derivation: docs/derivations.md, section 6.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident._compile import compiled
from smp_motor_ident.likelihood.interpolation import NODES, POINTS, evaluate, expand, half_range
from smp_motor_ident.likelihood.propagator import ROW, WIDTH, first_order, second_order

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

TILE = 128
# Rows of the basis: for a speed W, Q, D; for an angle the angle of the copy, W, Q.
ONE, RAMP, FREE_Q, FREE_W, RESIDUAL = 3, 4, 5, 6, 7
GONE = 1e-17  # of a free decay, below which it adds nothing to sums in double precision
NUMBERS = 18  # of a propagator that matter: E, H, Gv and their derivatives by K


@compiled
def _exact(row: Array, h: float, par: Array) -> None:
    """Put E, H and Gv over h into a row, then their derivatives by K."""
    whole = np.empty(WIDTH)
    if par[0] > 0.0:
        second_order(whole, h, par[0], par[1], par[2], par[3])
    else:
        first_order(whole, h, par[1], par[2], par[3])
    for n in range(9):
        row[n], row[9 + n] = whole[n], whole[3 * ROW + n]


@compiled
def tabulate(usual: float, par: Array) -> Array:
    """Return the table of propagators around a jittering interval; its range comes last."""
    half = half_range(usual, par[0], par[1], par[2], par[3])
    if half == 0.0:
        return np.zeros(0)
    values, table = np.empty(NODES * NUMBERS), np.empty(NODES * NUMBERS + 2)
    for n in range(NODES):
        _exact(values[n * NUMBERS : (n + 1) * NUMBERS], usual + half * POINTS[n], par)
    expand(values, table[:-2])
    table[-2], table[-1] = usual, half
    return table


@compiled
def _fill(row: Array, h: float, par: Array, table: Array) -> None:
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
    te, k, be = par[0], par[2], par[3]
    back = k if te > 0.0 else k + be
    step, q, w, th, cq, cw, cth = x[0], x[1], x[2], x[3], x[4], x[5], x[6]
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
                _fill(row, h, par, table)
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
) -> tuple[float, float]:
    """Return the sum of squared residuals and their number, without sensitivities."""
    row, table = np.zeros(NUMBERS), tabulate(usual, par)
    step = -1.0
    total = count = 0.0
    e00 = e01 = e10 = e11 = h0 = h1 = v0 = v1 = v2 = 0.0
    for g in range(starts.shape[0] - 1):
        first = starts[g]
        load = par[6] + initial[g, 3]
        q, w, th = initial[g, 0] - load, initial[g, 1], initial[g, 2]
        for n in range(first, starts[g + 1]):
            if n > first:
                h = time[n] - time[n - 1]
                if abs(h - step) > 1e-9 * h + 1e-15 * abs(time[n]):
                    step = h
                    _fill(row, h, par, table)
                    e00, e01, e10, e11, h0, h1 = row[0], row[1], row[2], row[3], row[4], row[5]
                    v0, v1, v2 = row[6], row[7], row[8]
                v = voltage[n] - load
                th += h0 * q + h1 * w + v2 * v
                old = q
                q = e00 * q + e01 * w + v0 * v
                w = e10 * old + e11 * w + v1 * v
            e = output[n] - (th if angle else w)
            if e == e:
                total += e * e
                count += 1.0
    return total, count
