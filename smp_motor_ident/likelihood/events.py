"""What happens inside one interval: sliding, reversal, sticking and breaking loose.

Coulomb switching and sticking are located inside the interval; the sensitivities jump there.
Derivation: docs/derivations.md, section 5.
"""

from __future__ import annotations

import math

from smp_motor_control.arrays import Array
from smp_motor_ident._compile import compiled, inlined
from smp_motor_ident.likelihood.current_sensor import after_move, before_move
from smp_motor_ident.likelihood.propagator import BE, ROW, TE, TM, K, speed_at
from smp_motor_ident.likelihood.sensitivities import (
    FORCED,
    LANES,
    PUSHED,
    SENSOR,
    SLOTS,
    SW,
    activate,
    fill,
    push_columns,
    slide_columns,
    slide_state,
    stay,
    turn,
)
from smp_motor_ident.model.columns import VC_MINUS, VC_PLUS

STUCK = 0.0  # direction of motion of a motor at rest
EVENTS = 32  # most in one interval


@compiled
def _zero_crossing(  # noqa: C901 - one search, branches for how it starts
    h: float, par: Array, x: Array, sign: float, v: float, f: float
) -> float:
    """Return when within (0, h) the sliding speed reaches zero, or -1."""
    te, tm, k, be = par[TE], par[TM], par[K], par[BE]
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
def keeps_turning(m: Array, at: int, par: Array, x: Array, sign: float, v: float, f: float) -> bool:
    """Tell from the propagator at hand that the speed does not reach zero on the way."""
    q, w = x[0], x[1]
    end = (
        m[at + ROW * LANES + 2] * q
        + m[at + ROW * LANES + 3] * w
        + m[at + ROW * LANES + 7] * v
        - m[at + ROW * LANES + 10] * f
    )
    if sign * end < 0.0 or sign * w <= 0.0:
        return False
    if par[TE] == 0.0:
        return True
    drive = (
        m[at + ROW * LANES] * q
        + m[at + ROW * LANES + 1] * w
        + m[at + ROW * LANES + 6] * v
        - m[at + ROW * LANES + 9] * f
    )
    return not (sign * (q - par[BE] * w - f) < 0.0 and sign * (drive - par[BE] * end - f) > 0.0)


@compiled
def _breakaway(h: float, v: float, load: float, par: Array, x: Array) -> tuple[float, float]:
    """Return when within h the stuck motor breaks loose (h: it does not), and which way."""
    drive = x[0] - load if par[TE] > 0.0 else v - load
    end = v - load
    if end > par[VC_PLUS]:
        limit, direction = par[VC_PLUS], 1.0
    elif end < -par[VC_MINUS]:
        limit, direction = -par[VC_MINUS], -1.0
    else:
        return h, STUCK
    wait = 0.0
    if par[TE] > 0.0 and direction * (limit - drive) > 0.0:  # else it pulls enough already
        wait = -par[TE] * math.log((limit - end) / (drive - end))
    return (wait, direction) if wait < h else (h, STUCK)


@compiled
def _stop(load: float, f: float, v: float, par: Array, x: Array, m: Array) -> float:
    """Put the speed to zero, let the columns jump, and return the direction from there."""
    x[1] = 0.0
    net = (x[0] if par[TE] > 0.0 else v) - load
    before = net - (f - load)
    direction, after = STUCK, 0.0
    if net > par[VC_PLUS]:
        direction, after = 1.0, net - par[VC_PLUS]
    elif net < -par[VC_MINUS]:
        direction, after = -1.0, net + par[VC_MINUS]
    ratio = after / before if before != 0.0 else 0.0
    for j in range(LANES):
        m[SW + j] *= ratio
    return direction


@compiled
def advance(
    h: float,
    v: float,
    direction: float,
    load: float,
    par: Array,
    x: Array,
    m: Array,
    cache: Array,
    marks: Array,
    scratch: Array,
) -> float:
    """Advance by h at constant v under friction, through all events; return the direction."""
    left, lags = h, marks[SENSOR] > 0.0
    for _ in range(EVENTS):
        if direction == STUCK:
            wait, direction = _breakaway(left, v, load, par, x)
            if lags:
                before_move(x, m)
            stay(wait, par, x, m, v)
            if lags:
                after_move(wait, v, 0.0, True, par, x, m, marks)
            left -= wait
            if direction == STUCK:
                break
        turn(m, direction)
        f = load + (par[VC_PLUS] if direction > 0.0 else -par[VC_MINUS])
        t = _zero_crossing(left, par, x, direction, v, f)
        span = t if t >= 0.0 else left
        fill(span, par, m, cache, marks, SLOTS, scratch)
        activate(m, cache, marks, SLOTS, 0)
        if lags:
            before_move(x, m)
        slide_columns(m, FORCED, x[0], x[1], v, f)
        if marks[PUSHED] > 0.0:
            push_columns(m, FORCED)
        slide_state(m, FORCED, x, v, f)
        if lags:
            after_move(span, v, f, False, par, x, m, marks)
        if t < 0.0:
            break
        direction = _stop(load, f, v, par, x, m)
        left -= t
        if left <= 1e-14 * h:
            break
    return direction
