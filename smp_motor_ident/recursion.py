"""The compiled recursion: simulate, differentiate, and gather the normal equations.

One pass over the samples carries the state ``(q, w, th)`` of `propagator`, its sensitivity
to every column of the problem, and sums ``psi psi^T``, ``psi r`` and ``r^2`` of the whitened
residuals on the way.  Nothing of the length of the record is allocated.
Derivation: docs/derivations.md, sections 4 to 7.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident._compile import compiled
from smp_motor_ident.events import advance, fill
from smp_motor_ident.internal import (
    ANGLE,
    BE,
    CURRENT_OFFSET,
    DELAY,
    LOAD,
    MEAN_SPEED,
    SPEED,
    STUCK,
    VC_MINUS,
    VC_PLUS,
    WINDOW,
    R,
)
from smp_motor_ident.propagator import ROW, WIDTH
from smp_motor_ident.window import recall, remember

__all__ = ["ANGLE", "MEAN_SPEED", "SPEED", "WINDOW", "run"]

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


@compiled
def run(  # noqa: C901 - one pass, kept whole so that nothing is stored between its steps
    time: Array,
    starts: Integers,
    section_end: Array,
    section_value: Array,
    section_start: Integers,
    output: Array,
    current: Array,
    kind: int,
    friction: bool,
    par: Array,
    slope: Array,
    n_slope: int,
    initial: Array,
    local: Integers,
    gain: Array,
    weight: Array,
    huber: float,
    normal: Array,
    gradient: Array,
    cost: Array,
    spread: Array,
    block_length: int,
    blocks: Array,
    block_segment: Integers,
    ring: Array,
    predicted: Array,
) -> int:
    """Run over all segments; fill the sums in place.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Sampling instants [s].
    starts : ndarray of int, shape (g + 1,)
        First sample of each segment, and n.
    section_end, section_value : ndarray, shape (m,)
        Instants [s] until which the input was held at the values [V].
    section_start : ndarray of int, shape (g,)
        First section of each segment; it also holds what came before.
    output, current : ndarray, shape (n,)
        Mechanical output (NaN where lost); current [A], shape (0,) where it is not used.
    kind : int
        SPEED, ANGLE or MEAN_SPEED (over the trailing window).
    friction : bool
        Whether Coulomb friction is in the model.
    par, slope : ndarray, shapes (11,) and (11, c)
        Internal parameters (see the constants of this module; te and tm not as logarithms)
        and their derivatives by the c common columns (those of te and tm logarithmic).
    n_slope : int
        Only the first of the common columns, this many, touch te, tm, K, be.
    initial : ndarray, shape (g, 4)
        q, w, th and load of each segment.
    local : ndarray of int, shape (l,)
        Which of these four are columns of the problem.
    gain : ndarray, shape (3, 2)
        Innovation gain from (output, current) to (q, w, th).
    weight : ndarray, shape (2, 3)
        Lower triangular whitening of (output, current); third column: of one alone.
    huber : float
        Residuals beyond this many standard deviations count linearly.
    normal, gradient, cost : ndarray, shapes (g, p, p), (g, p), (g,)
        Sums, p = c + l; overwritten.
    spread : ndarray, shape (6,)
        Sums of squares and product of the raw residuals, and their numbers; overwritten.
    block_length, blocks, block_segment
        Scores are summed over runs of ``block_length`` samples into rows of ``blocks``.
    ring : ndarray, shape (r, 3 + 2 p)
        Memory for the window of MEAN_SPEED; shape (0, 0) otherwise.
    predicted : ndarray, shape (n, 3)
        Speed, output and current as predicted; shape (0, 3) where not wanted.

    Returns
    -------
    int
        Number of rows of ``blocks`` in use.
    """
    n_common = slope.shape[1]
    p = n_common + local.shape[0]
    has_current = current.shape[0] > 0
    delay = par[DELAY]
    x = np.zeros(3)
    s = np.zeros((3, p))
    df = np.zeros((2, p))
    cache = np.zeros((5, WIDTH))
    derivatives = np.zeros(WIDTH)
    row_fast = np.zeros(WIDTH)  # of the interval that comes again and again
    whole = np.zeros(ROW)
    fast = last_h = -1.0
    cached = np.full(5, -1.0)
    cached[4] = 0.0
    past = np.zeros(1 + p)
    d0 = np.zeros(p)
    d1 = np.zeros(p)
    spread[:] = 0.0
    block = -1
    has_gain = False
    for n in range(3):
        for m in range(2):
            if gain[n, m] != 0.0:
                has_gain = True
    for j in range(n_common):
        df[0, j] = slope[VC_PLUS, j] + slope[LOAD, j]
        df[1, j] = -slope[VC_MINUS, j] + slope[LOAD, j]
    if not friction:
        for j in range(n_common):
            df[0, j] = slope[LOAD, j]
    for j in range(local.shape[0]):
        if local[j] == 3:
            df[0, n_common + j] = 1.0
            df[1, n_common + j] = 1.0
    for g in range(starts.shape[0] - 1):
        first, last = starts[g], starts[g + 1]
        normal[g] = 0.0
        gradient[g] = 0.0
        cost[g] = 0.0
        s[:] = 0.0
        for n in range(3):
            x[n] = initial[g, n]
        # A speed of exactly zero under friction is a motor at rest, not a free number: the
        # cost has a kink there.
        at_rest = friction and initial[g, 1] == 0.0
        for j in range(local.shape[0]):
            if local[j] < 3 and not (at_rest and local[j] == 1):
                s[local[j], n_common + j] = 1.0
        load = par[LOAD] + initial[g, 3]
        section = section_start[g]
        limit = section_start[g + 1] - 1 if g + 2 < starts.shape[0] else section_end.shape[0] - 1
        now = time[first]
        direction = 1.0
        if friction:
            direction = 0.0
            if x[1] > 0.0:
                direction = 1.0
            elif x[1] < 0.0:
                direction = -1.0
        block += 1
        block_segment[block] = g
        blocks[block] = 0.0
        filled = 0
        while section < limit and section_end[section] + delay <= now:
            section += 1
        for k in range(first, last):
            target = time[k]
            while now < target:
                end = target
                change = section_end[section] + delay
                switches = section < limit and change < target - 1e-9 * (target - now)
                if switches:
                    end = change
                v = section_value[section]
                h = end - now
                if h > 0.0:
                    if abs(h - fast) > 1e-9 * h and abs(h - last_h) <= 1e-9 * h:
                        fast = h
                        fill(row_fast, h, par, n_slope, slope, derivatives)
                        for n in range(ROW):
                            whole[n] = row_fast[n]
                    last_h = h
                    slides = abs(h - fast) <= 1e-9 * h
                    f = load
                    which = 0
                    q, w = x[0], x[1]
                    if slides and friction:
                        if direction > 0.0:
                            f += par[VC_PLUS]
                        else:
                            f -= par[VC_MINUS]
                            which = 1
                    new_q = whole[0] * q + whole[1] * w + whole[6] * v - whole[9] * f
                    new_w = whole[2] * q + whole[3] * w + whole[7] * v - whole[10] * f
                    if slides and friction:  # does it keep turning all the way?
                        slides = direction * w > 0.0 and direction * new_w >= 0.0
                        if slides and par[0] > 0.0:
                            begins = direction * (q - par[BE] * w - f)
                            ends = direction * (new_q - par[BE] * new_w - f)
                            slides = not (begins < 0.0 and ends > 0.0)
                    if slides:
                        e00, e01, e10, e11 = whole[0], whole[1], whole[2], whole[3]
                        h0, h1, g0, g1, g2 = whole[4], whole[5], whole[9], whole[10], whole[11]
                        for j in range(p):
                            a, b, c = s[0, j], s[1, j], df[which, j]
                            s[0, j] = e00 * a + e01 * b - g0 * c
                            s[1, j] = e10 * a + e11 * b - g1 * c
                            s[2, j] += h0 * a + h1 * b - g2 * c
                        for j in range(n_slope):
                            o = ROW * (j + 1)
                            r = row_fast[o : o + ROW]
                            s[0, j] += r[0] * q + r[1] * w + r[6] * v - r[9] * f
                            s[1, j] += r[2] * q + r[3] * w + r[7] * v - r[10] * f
                            s[2, j] += r[4] * q + r[5] * w + r[8] * v - r[11] * f
                        x[2] += h0 * q + h1 * w + whole[8] * v - g2 * f
                        x[0], x[1] = new_q, new_w
                    else:
                        direction = advance(
                            h,
                            v,
                            direction,
                            load,
                            friction,
                            par,
                            x,
                            s,
                            n_slope,
                            slope,
                            df,
                            cache,
                            cached,
                            derivatives,
                        )
                now = end
                if section < limit and change <= target + 1e-9 * (target - time[k - 1]):
                    section += 1
                    dv = v - section_value[section]
                    if par[0] > 0.0:
                        dv /= par[0]
                        for j in range(n_common):
                            s[0, j] += dv * slope[DELAY, j]
                    else:
                        if friction and direction == STUCK:  # it starts, if at all, just now
                            net = section_value[section] - load
                            dv = -max(0.0, net - par[VC_PLUS]) - min(0.0, net + par[VC_MINUS])
                        for j in range(n_common):
                            s[1, j] += dv / par[1] * slope[DELAY, j]
            # Outputs.
            y0 = x[1]
            row = 1
            if kind == ANGLE:
                y0 = x[2]
                row = 2
            if kind == MEAN_SPEED:
                remember(ring, k, target, x, s)
                width = par[WINDOW]
                w_past = recall(ring, k, first, target - width, p, past)
                y0 = (x[2] - past[0]) / width
                for j in range(p):
                    d0[j] = (s[2, j] - past[1 + j]) / width
                for j in range(n_common):
                    d0[j] += (w_past - y0) / width * slope[WINDOW, j]
            else:
                for j in range(p):
                    d0[j] = s[row, j]
            y1 = 0.0
            if has_current:
                y1 = x[0] / par[R] + par[CURRENT_OFFSET]
                for j in range(p):
                    d1[j] = s[0, j] / par[R]
                for j in range(n_common):
                    d1[j] += slope[CURRENT_OFFSET, j] - x[0] / par[R] * slope[R, j]
            if predicted.shape[0] > 0:
                predicted[k, 0] = x[1]
                predicted[k, 1] = y0
                predicted[k, 2] = y1
            # Residuals, whitened.
            e0 = output[k] - y0
            ok0 = e0 == e0
            e1 = 0.0
            ok1 = False
            if has_current:
                e1 = current[k] - y1
                ok1 = e1 == e1
            r0 = r1 = 0.0
            w00 = w10 = w11 = 0.0
            if ok0:
                w00 = weight[0, 0]
                spread[0] += e0 * e0
                spread[3] += 1.0
            if ok1:
                spread[1] += e1 * e1
                spread[4] += 1.0
                w11 = weight[1, 2]
                if ok0:
                    w10 = weight[1, 0]
                    w11 = weight[1, 1]
                    spread[2] += e0 * e1
                    spread[5] += 1.0
            if not ok0:
                e0 = 0.0
            if not ok1:
                e1 = 0.0
            r0 = w00 * e0
            r1 = w10 * e0 + w11 * e1
            u0 = u1 = 1.0
            if abs(r0) > huber:
                u0 = huber / abs(r0)
                cost[g] += huber * (2 * abs(r0) - huber)
            else:
                cost[g] += r0 * r0
            if abs(r1) > huber:
                u1 = huber / abs(r1)
                cost[g] += huber * (2 * abs(r1) - huber)
            else:
                cost[g] += r1 * r1
            if filled >= block_length:
                block += 1
                block_segment[block] = g
                blocks[block] = 0.0
                filled = 0
            filled += 1
            if ok1:
                for j in range(p):
                    a0 = w00 * d0[j]
                    a1 = w10 * d0[j] + w11 * d1[j]
                    score = u0 * a0 * r0 + u1 * a1 * r1
                    gradient[g, j] += score
                    blocks[block, j] += score
                    a0 *= u0
                    a1 *= u1
                    b0 = a0 * w00 + a1 * w10
                    b1 = a1 * w11
                    for i in range(j + 1):
                        normal[g, j, i] += b0 * d0[i] + b1 * d1[i]
            elif ok0:
                for j in range(p):
                    b0 = u0 * w00 * w00 * d0[j]
                    score = b0 * e0
                    gradient[g, j] += score
                    blocks[block, j] += score
                    for i in range(j + 1):
                        normal[g, j, i] += b0 * d0[i]
            # Innovations.
            if has_gain:
                for n in range(3):
                    if n == 1 and friction and direction == STUCK:
                        continue
                    k0 = gain[n, 0] if ok0 else 0.0
                    k1 = gain[n, 1] if ok1 else 0.0
                    x[n] += k0 * e0 + k1 * e1
                    for j in range(p):
                        s[n, j] -= k0 * d0[j] + k1 * d1[j]
                if friction and direction != STUCK and x[1] * direction < 0.0:
                    direction = -direction
        for j in range(p):
            for i in range(j):
                normal[g, i, j] = normal[g, j, i]
    return block + 1
