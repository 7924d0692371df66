"""The compiled recursion: simulate, differentiate, and gather the normal equations.

One pass over the samples carries the state ``(q, w, th)`` of `propagator`, its sensitivity
to every column of the problem, and sums ``psi psi^T``, ``psi r`` and ``r^2`` of the whitened
residuals on the way.  Coulomb switching and sticking are located inside the interval; the
sensitivities jump there.  Nothing of the length of the record is allocated.
Derivation: docs/derivations.md, sections 4 to 7.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident._compile import compiled, inlined
from smp_motor_ident.propagator import ROW, WIDTH, first_order, second_order, speed_at

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Entries of the internal parameter vector `par` (and rows of its derivative `slope`).
TE, TM, K, BE, VC_PLUS, VC_MINUS, LOAD, R, CURRENT_OFFSET, DELAY, WINDOW = range(11)
# What the mechanical output is.
SPEED, ANGLE, MEAN_SPEED = 0, 1, 2
STUCK = 0.0


@compiled
def _fill(row: Array, h: float, par: Array, n_slope: int, slope: Array, derivatives: Array) -> None:
    """Put the propagator over h into a row, then its derivative by each common column."""
    if par[0] == 0.0:
        first_order(derivatives, h, par[1], par[2], par[3])
    else:
        second_order(derivatives, h, par[0], par[1], par[2], par[3])
    for i in range(ROW):
        row[i] = derivatives[i]
    for j in range(n_slope):
        for i in range(ROW):
            total = 0.0
            for m in range(4):
                total += slope[m, j] * derivatives[ROW * (m + 1) + i]
            row[ROW * (j + 1) + i] = total


@inlined
def _slide(
    rows: Array,
    n: int,
    x: Array,
    s: Array,
    n_slope: int,
    v: float,
    f: float,
    df: Array,
    which: int,
) -> None:
    """Advance state x and sensitivities s over one interval with constant v and F = f.

    The propagator is row ``n`` of ``rows``; no view of it is made, that would cost more than
    the step itself.
    """
    q, w = x[0], x[1]
    e00, e01, e10, e11, h0, h1 = (
        rows[n, 0],
        rows[n, 1],
        rows[n, 2],
        rows[n, 3],
        rows[n, 4],
        rows[n, 5],
    )
    g0, g1, g2 = rows[n, 9], rows[n, 10], rows[n, 11]
    for j in range(s.shape[1]):
        sq, sw, fj = s[0, j], s[1, j], df[which, j]
        s[0, j] = e00 * sq + e01 * sw - g0 * fj
        s[1, j] = e10 * sq + e11 * sw - g1 * fj
        s[2, j] += h0 * sq + h1 * sw - g2 * fj
    for j in range(n_slope):
        o = ROW * (j + 1)
        s[0, j] += rows[n, o] * q + rows[n, o + 1] * w + rows[n, o + 6] * v - rows[n, o + 9] * f
        s[1, j] += (
            rows[n, o + 2] * q + rows[n, o + 3] * w + rows[n, o + 7] * v - rows[n, o + 10] * f
        )
        s[2, j] += (
            rows[n, o + 4] * q + rows[n, o + 5] * w + rows[n, o + 8] * v - rows[n, o + 11] * f
        )
    x[0] = e00 * q + e01 * w + rows[n, 6] * v - g0 * f
    x[1] = e10 * q + e11 * w + rows[n, 7] * v - g1 * f
    x[2] += h0 * q + h1 * w + rows[n, 8] * v - g2 * f


@compiled
def _stay(h: float, par: Array, x: Array, s: Array, n_slope: int, slope: Array, v: float) -> None:
    """Advance the stuck motor: the current relaxes towards v / R, nothing turns."""
    if par[0] == 0.0:
        return
    e = math.exp(-h / par[0])
    d = (x[0] - v) * e * h / par[0]
    x[0] = v + (x[0] - v) * e
    for j in range(s.shape[1]):
        s[0, j] *= e
    for j in range(n_slope):
        s[0, j] += d * slope[0, j]


@compiled
def _zero_crossing(  # noqa: C901 - one search, branches for how it starts
    h: float, par: Array, x: Array, sign: float, v: float, f: float
) -> float:
    """Return when within (0, h) the sliding speed reaches zero, or -1."""
    te, tm, k, be = par[0], par[1], par[2], par[3]
    w1, a1 = speed_at(h, te, tm, k, be, x[0], x[1], v, f)
    hi = h
    rounding = 1e-12 * (abs(x[1]) + abs(v - f) / (k + be))
    if sign * w1 >= -rounding:
        _, a0 = speed_at(0.0, te, tm, k, be, x[0], x[1], v, f)
        if not (sign * a0 < 0.0 and sign * a1 > 0.0):
            return -1.0
        lo = 0.0  # a dip inside the interval: find its bottom
        for _ in range(40):
            mid = 0.5 * (lo + hi)
            _, a = speed_at(mid, te, tm, k, be, x[0], x[1], v, f)
            if sign * a < 0.0:
                lo = mid
            else:
                hi = mid
        w1, _ = speed_at(hi, te, tm, k, be, x[0], x[1], v, f)
        if sign * w1 >= -rounding:
            return -1.0
    lo = 0.0
    t = hi * max(0.0, min(1.0, x[1] / (x[1] - w1)))
    if sign * x[1] <= 0.0:  # just started from rest: the crossing is after the peak
        _, a0 = speed_at(0.0, te, tm, k, be, x[0], x[1], v, f)
        if sign * a0 <= 0.0:
            return 0.0
        peak = hi
        for _ in range(50):
            mid = 0.5 * (lo + peak)
            _, a = speed_at(mid, te, tm, k, be, x[0], x[1], v, f)
            if sign * a > 0.0:
                lo = mid
            else:
                peak = mid
        t = 0.5 * (lo + hi)
    for _ in range(60):  # Newton, kept inside the bracket
        w, a = speed_at(t, te, tm, k, be, x[0], x[1], v, f)
        if sign * w > 0.0:
            lo = t
        else:
            hi = t
        step = -w / a if a != 0.0 else hi - lo
        new = t + step
        if not (lo < new < hi):
            new = 0.5 * (lo + hi)
        if abs(new - t) < 1e-13 * h:
            return float(new)
        t = new
    return float(t)


@inlined
def _keeps_turning(
    rows: Array, n: int, par: Array, x: Array, sign: float, v: float, f: float
) -> bool:
    """Tell from the propagator at hand that the speed does not reach zero on the way."""
    q, w = x[0], x[1]
    end = rows[n, 2] * q + rows[n, 3] * w + rows[n, 7] * v - rows[n, 10] * f
    if sign * end < 0.0 or sign * w <= 0.0:
        return False
    if par[0] == 0.0:
        return True
    drive = rows[n, 0] * q + rows[n, 1] * w + rows[n, 6] * v - rows[n, 9] * f
    return not (sign * (q - par[3] * w - f) < 0.0 and sign * (drive - par[3] * end - f) > 0.0)


@inlined
def _advance(  # noqa: C901 - the events of one interval, in order
    h: float,
    v: float,
    direction: float,
    load: float,
    friction: bool,
    par: Array,
    x: Array,
    s: Array,
    n_slope: int,
    slope: Array,
    df: Array,
    cache: Array,
    cached: Array,
    derivatives: Array,
) -> float:
    """Advance by h at constant v, through all events; return the direction of motion."""
    left = h
    whole = True
    for _ in range(32):
        if friction and direction == STUCK:
            drive = x[0] - load if par[0] > 0.0 else v - load
            end = v - load
            limit = 0.0
            if end > par[VC_PLUS]:
                limit = par[VC_PLUS]
            elif end < -par[VC_MINUS]:
                limit = -par[VC_MINUS]
            else:
                _stay(left, par, x, s, n_slope, slope, v)
                return direction
            wait = 0.0
            if par[0] > 0.0 and (limit - drive) * (end - drive) > 0.0:
                ratio = (limit - end) / (drive - end)
                wait = -par[0] * math.log(ratio) if ratio > 0.0 else left
            if wait >= left:
                _stay(left, par, x, s, n_slope, slope, v)
                return direction
            if wait > 0.0:
                _stay(wait, par, x, s, n_slope, slope, v)
                left -= wait
                whole = False
            direction = 1.0 if end > 0.0 else -1.0
        f = load
        which = 0
        slot = 4
        if whole:
            for n in range(4):
                if abs(cached[n] - h) < 1e-9 * h:
                    slot = n
                    break
            if slot == 4:
                slot = int(cached[4])
                cached[4] = (slot + 1) % 4
                cached[slot] = h
                _fill(cache[slot], h, par, n_slope, slope, derivatives)
        if friction:
            f += par[VC_PLUS] if direction > 0.0 else -par[VC_MINUS]
            which = 0 if direction > 0.0 else 1
            t = -1.0
            if not (whole and _keeps_turning(cache, slot, par, x, direction, v, f)):
                t = _zero_crossing(left, par, x, direction, v, f)
            if t >= 0.0:
                _fill(cache[4], t, par, n_slope, slope, derivatives)
                _slide(cache, 4, x, s, n_slope, v, f, df, which)
                x[1] = 0.0
                net = (x[0] if par[0] > 0.0 else v) - load
                before = net - (f - load)
                new = 0.0
                after = 0.0
                if net > par[VC_PLUS]:
                    new = 1.0
                    after = net - par[VC_PLUS]
                elif net < -par[VC_MINUS]:
                    new = -1.0
                    after = net + par[VC_MINUS]
                ratio = after / before if before != 0.0 else 0.0
                for j in range(s.shape[1]):
                    s[1, j] *= ratio
                direction = new
                left -= t
                whole = False
                if left <= 1e-14 * h:
                    return direction
                continue
        if not whole:
            _fill(cache[4], left, par, n_slope, slope, derivatives)
        _slide(cache, slot, x, s, n_slope, v, f, df, which)
        return direction
    return direction


@compiled
def _remember(ring: Array, k: int, t: float, x: Array, s: Array) -> None:
    row = ring[k % ring.shape[0]]
    p = s.shape[1]
    row[0] = t
    row[1] = x[2]
    row[2] = x[1]
    for j in range(p):
        row[3 + j] = s[2, j]
        row[3 + p + j] = s[1, j]


@compiled
def _recall(ring: Array, k: int, first: int, t: float, p: int, past: Array) -> float:
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
                        _fill(row_fast, h, par, n_slope, slope, derivatives)
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
                        direction = _advance(
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
                _remember(ring, k, target, x, s)
                width = par[WINDOW]
                w_past = _recall(ring, k, first, target - width, p, past)
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


@compiled
def run_linear(  # noqa: C901 - the same pass without its events
    time: Array,
    starts: Integers,
    voltage: Array,
    output: Array,
    angle: bool,
    par: Array,
    slope: Array,
    n_slope: int,
    initial: Array,
    local: Integers,
    weight: float,
    normal: Array,
    gradient: Array,
    cost: Array,
    spread: Array,
    block_length: int,
    blocks: Array,
    block_segment: Integers,
) -> int:
    """Run as `run` does where nothing happens between the samples.

    Without friction, delay, window, current, robust loss and innovations; the input changes
    at the samples.

    Parameters
    ----------
    time, starts
        As in `run`.
    voltage : ndarray, shape (n,)
        Held over the interval that ends at each sample [V].
    output
        As in `run`.
    angle : bool
        Whether it is the angle.
    par, slope, n_slope, initial, local
        As in `run`.
    weight : float
        Inverse standard deviation of the output.
    normal, gradient, cost, spread, block_length, blocks, block_segment
        As in `run`.

    Returns
    -------
    int
        Number of rows of ``blocks`` in use.
    """
    n_common = slope.shape[1]
    p = n_common + local.shape[0]
    row = np.zeros(WIDTH)
    derivatives = np.zeros(WIDTH)
    sq, sw, st, d = np.zeros(p), np.zeros(p), np.zeros(p), np.zeros(p)
    load_slope = np.zeros(p)
    squares = np.zeros((p, p))
    step = -1.0
    spread[:] = 0.0
    block = -1
    for j in range(n_common):
        load_slope[j] = slope[LOAD, j]
    for j in range(local.shape[0]):
        if local[j] == 3:
            load_slope[n_common + j] = 1.0
    e00 = e01 = e10 = e11 = h0 = h1 = g0 = g1 = g2 = 0.0
    for g in range(starts.shape[0] - 1):
        first, last = starts[g], starts[g + 1]
        q, w, th = initial[g, 0], initial[g, 1], initial[g, 2]
        f = par[LOAD] + initial[g, 3]
        sq[:] = 0.0
        sw[:] = 0.0
        st[:] = 0.0
        squares[:] = 0.0
        gradient[g] = 0.0
        for j in range(local.shape[0]):
            sq[n_common + j] = 1.0 if local[j] == 0 else 0.0
            sw[n_common + j] = 1.0 if local[j] == 1 else 0.0
            st[n_common + j] = 1.0 if local[j] == 2 else 0.0
        total = count = 0.0
        filled = block_length
        for k in range(first, last):
            if k > first:
                h = time[k] - time[k - 1]
                if abs(h - step) > 1e-9 * h:
                    step = h
                    _fill(row, h, par, n_slope, slope, derivatives)
                    e00, e01, e10, e11, h0, h1 = row[0], row[1], row[2], row[3], row[4], row[5]
                    g0, g1, g2 = row[9], row[10], row[11]
                v = voltage[k]
                for j in range(p):
                    a, b, c = sq[j], sw[j], load_slope[j]
                    sq[j] = e00 * a + e01 * b - g0 * c
                    sw[j] = e10 * a + e11 * b - g1 * c
                    if angle:
                        st[j] += h0 * a + h1 * b - g2 * c
                for j in range(n_slope):
                    o = ROW * (j + 1)
                    sq[j] += row[o] * q + row[o + 1] * w + row[o + 6] * v - row[o + 9] * f
                    sw[j] += row[o + 2] * q + row[o + 3] * w + row[o + 7] * v - row[o + 10] * f
                    if angle:
                        st[j] += row[o + 4] * q + row[o + 5] * w + row[o + 8] * v - row[o + 11] * f
                th += h0 * q + h1 * w + row[8] * v - g2 * f
                old = q
                q = e00 * q + e01 * w + row[6] * v - g0 * f
                w = e10 * old + e11 * w + row[7] * v - g1 * f
            if filled == block_length:
                block += 1
                block_segment[block] = g
                blocks[block] = 0.0
                filled = 0
            filled += 1
            e = output[k] - (th if angle else w)
            if e != e:
                continue
            total += e * e
            count += 1.0
            d = st if angle else sw
            for j in range(p):
                dj = d[j]
                blocks[block, j] += dj * e
                for i in range(j + 1):
                    squares[j, i] += dj * d[i]
        spread[0] += total
        spread[3] += count
        cost[g] = weight * weight * total
        for j in range(p):
            for i in range(j + 1):
                normal[g, j, i] = weight * weight * squares[j, i]
                normal[g, i, j] = normal[g, j, i]
    for b in range(block + 1):
        for j in range(p):
            blocks[b, j] *= weight * weight
            gradient[block_segment[b], j] += blocks[b, j]
    return block + 1
