"""What happens inside one interval: sliding, reversal, sticking and breaking loose.

Coulomb switching and sticking are located inside the interval; the sensitivities jump there.
Derivation: docs/derivations.md, sections 4 and 5.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident._compile import compiled, inlined
from smp_motor_ident.internal import STUCK, VC_MINUS, VC_PLUS
from smp_motor_ident.propagator import ROW, first_order, second_order, speed_at

Array = NDArray[np.float64]


@compiled
def fill(row: Array, h: float, par: Array, n_slope: int, slope: Array, derivatives: Array) -> None:
    """Put the propagator over h into a row, then its derivative by each common column.

    Parameters
    ----------
    row : ndarray, shape (WIDTH,)
        Overwritten.
    h : float
        Length of the interval [s].
    par : ndarray, shape (11,)
        Internal parameters.
    n_slope : int
        Number of columns that touch te, tm, K, be.
    slope : ndarray, shape (11, c)
        Derivatives of the internal parameters.
    derivatives : ndarray, shape (WIDTH,)
        Scratch.
    """
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
def advance(  # noqa: C901 - the events of one interval, in order
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
    """Advance by h at constant v, through all events; return the direction of motion.

    Parameters
    ----------
    h, v : float
        Length of the interval [s] and voltage.
    direction : float
        1, -1 or STUCK.
    load : float
        Constant load [V].
    friction : bool
        Whether there is Coulomb friction.
    par : ndarray, shape (11,)
        Internal parameters.
    x, s : ndarray, shapes (3,) and (3, p)
        State and sensitivities; updated.
    n_slope, slope
        As in `fill`.
    df : ndarray, shape (2, p)
        Derivative of friction and load in volts, turning forward and backward.
    cache, cached : ndarray, shapes (5, WIDTH) and (5,)
        Propagators of the last interval lengths, and these lengths.
    derivatives : ndarray, shape (WIDTH,)
        Scratch.

    Returns
    -------
    float
        Direction afterwards.
    """
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
                fill(cache[slot], h, par, n_slope, slope, derivatives)
        if friction:
            f += par[VC_PLUS] if direction > 0.0 else -par[VC_MINUS]
            which = 0 if direction > 0.0 else 1
            t = -1.0
            if not (whole and _keeps_turning(cache, slot, par, x, direction, v, f)):
                t = _zero_crossing(left, par, x, direction, v, f)
            if t >= 0.0:
                fill(cache[4], t, par, n_slope, slope, derivatives)
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
            fill(cache[4], left, par, n_slope, slope, derivatives)
        _slide(cache, slot, x, s, n_slope, v, f, df, which)
        return direction
    return direction
