"""What a sensor shows of the current: its value, a mean over a window, or a low-pass of it.

Over a piece of constant voltage and friction the integrals of the state follow from the state at
its ends, whatever happens between: ``int q = v h - K dth - te dq`` for the mean, and for the
low-pass the same equations under the weight ``a e^{-a (h - s)}``.  A digital low-pass follows what
the current is at the samples.
Derivation: docs/derivations.md, section 6.
"""

from __future__ import annotations

import math

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident._compile import compiled, inlined
from smp_motor_ident.likelihood.propagator import BE, TE, TM, K
from smp_motor_ident.likelihood.sensitivities import (
    BEFORE,
    DF,
    KEPT,
    LANES,
    PUSH,
    RATE,
    SENSOR,
    SLOPE,
    SQ,
    ST,
    SW,
)
from smp_motor_ident.model.columns import CURRENT_LAG, LN_R, OFFSET

DIRECT, AVERAGED, LOW_PASSED, SMOOTHED = range(4)
# The state and what the sensor keeps (the charge R int i, or R times the low-passed current); the
# state before the last move.
KEEPS, Q0, W0, TH0, STATE = range(3, 8)
ON_OFFSET, ON_R, ON_LAG = (SLOPE + n * LANES for n in (OFFSET, LN_R, CURRENT_LAG))
CHARGE, FLOW, MARK = 0, 1, 2  # of a row of the trail: charge, R i, then the charge's columns
APART = 1e-5
"""Least distance of the sensor's pole from the motor's, as a share: nearer, rounding decides."""


@compiled
def sensor_rate(sensor: int, par: Array) -> float:
    """Return the rate 1/s of a low-pass, kept apart from the motor's own poles."""
    if sensor != LOW_PASSED:
        return 0.0
    a = 1.0 / par[CURRENT_LAG]
    te, tm, k, be = par[TE], par[TM], par[K], par[BE]
    for _ in range(8):
        square, middle, last = a * a * te * tm, a * (tm + te * be), k + be
        near = abs(square - middle + last) < APART * (abs(square) + abs(middle) + abs(last))
        if not near and abs(1.0 - a * te) > APART:
            break
        a *= 1.0 + 2 * APART
    return float(a)


@compiled
def begin_current(more: float, own: Integers, x: Array, m: Array, sensor: int) -> None:
    """Begin a segment: no charge yet, or a low-pass that has settled on the current before it.

    That was more than the first by so many volts, of which the columns ``own`` are the derivative.
    """
    low = sensor != AVERAGED
    x[KEEPS] = x[0] + more if low else 0.0
    for j in range(LANES):
        m[KEPT + j] = m[SQ + j] if low else 0.0
    for j in own:
        m[KEPT + j] = 1.0 if low else 0.0


@compiled
def before_move(x: Array, m: Array) -> None:
    """Keep the state and its columns as they are before a move."""
    x[Q0], x[W0], x[TH0] = x[0], x[1], x[2]
    for j in range(LANES):
        m[BEFORE + j] = m[SQ + j]
        m[BEFORE + LANES + j] = m[SW + j]
        m[BEFORE + 2 * LANES + j] = m[ST + j]


@compiled
def after_move(
    h: float, v: float, f: float, stuck: bool, par: Array, x: Array, m: Array, marks: Array
) -> None:
    """Let the sensor follow a move of h seconds under constant voltage and friction."""
    if marks[SENSOR] == AVERAGED:
        _charge(h, v, par, x, m)
    else:
        _low_pass(h, v, f, stuck, par, x, m, marks[RATE])


@compiled
def _charge(h: float, v: float, par: Array, x: Array, m: Array) -> None:
    te, k = par[TE], par[K]
    dq, dth = x[0] - x[Q0], x[2] - x[TH0]
    x[KEEPS] += v * h - k * dth - te * dq
    for j in range(LANES):
        m[KEPT + j] -= (
            k * (m[ST + j] - m[BEFORE + 2 * LANES + j])
            + te * (m[SQ + j] - m[BEFORE + j])
            + m[SLOPE + 2 * LANES + j] * dth
            + m[SLOPE + j] * te * dq
            - h * m[PUSH + j]
        )


@compiled
def _low_pass(
    h: float, v: float, f: float, stuck: bool, par: Array, x: Array, m: Array, a: float
) -> None:
    """Advance ``y' = a (q - y)``: y is what the sensor keeps.

    The weighted integrals ``Iq``, ``Iw`` of q and w obey the motor's equations by parts,

        (1 - a te) Iq + K Iw = v (1 - e) - a te (q1 - e q0),
        -Iq + (be - a tm) Iw = -F (1 - e) - a tm (w1 - e w0),    e = e^{-a h}.
    """
    te, tm, k, be = par[TE], par[TM], par[K], par[BE]
    e, gone = math.exp(-a * h), -math.expm1(-a * h)
    on_q, on_w = 1.0 - a * te, be - a * tm
    dq, dw = x[0] - e * x[Q0], x[1] - e * x[W0]
    r1, r2 = v * gone - a * te * dq, -f * gone - a * tm * dw
    below = on_q if stuck else on_q * on_w + k
    iq = r1 / below if stuck else (r1 * on_w - k * r2) / below
    iw = 0.0 if stuck else (on_q * r2 + r1) / below
    y = x[KEEPS]
    for j in range(LANES):
        da = -a * a * m[ON_LAG + j]
        de = -h * e * da
        dte, dtm = te * m[SLOPE + j], tm * m[SLOPE + LANES + j]
        d1 = (
            m[PUSH + j] * gone
            - v * de
            - (da * te + a * dte) * (dq - iq)
            - a * te * (m[SQ + j] - e * m[BEFORE + j] - de * x[Q0])
            - m[SLOPE + 2 * LANES + j] * iw
        )
        if stuck:
            diq = d1 / below
        else:
            d2 = (
                f * de
                - m[DF + j] * gone
                - (da * tm + a * dtm) * (dw - iw)
                - a * tm * (m[SW + j] - e * m[BEFORE + LANES + j] - de * x[W0])
                - m[SLOPE + 3 * LANES + j] * iw
            )
            diq = (d1 * on_w - k * d2) / below
        m[KEPT + j] = e * m[KEPT + j] + de * y + diq
    x[KEEPS] = e * y + iq


@compiled
def smooth(lag: float, period: float, x: Array, m: Array) -> None:
    """Let a digital low-pass take its next sample, ``y += a (q - y)``, ``a = T / (T + lag)``."""
    a = period / (period + lag)
    more, by_lag = a * (x[0] - x[KEEPS]), a * (x[0] - x[KEEPS]) / (period + lag)
    for j in range(LANES):
        m[KEPT + j] += a * (m[SQ + j] - m[KEPT + j]) - by_lag * m[ON_LAG + j]
    x[KEEPS] += more


@inlined
def samples_between(h: float, period: float) -> float:
    """Return how many samples a digital filter takes in h seconds: of rows that are lost, too."""
    return max(1.0, math.floor(h / period + 0.5))


@compiled
def mark_first(
    trail: Array, time: Array, first: int, last: int, width: float, more: float, own: Integers,
    x: Array, m: Array,
) -> int:  # fmt: skip
    """Mark the samples whose windows begin before the segment; return the next one."""
    k = mark(trail, time, first, last, time[first], width, x, m)
    for n in range(first, k):
        row, since = trail[n % trail.shape[0]], time[first] - (time[n] - width)
        row[CHARGE] -= since * more
        row[FLOW] += more
        for j in own:
            row[MARK + j] -= since
    return k


@compiled
def mark(
    trail: Array, time: Array, k: int, last: int, now: float, width: float, x: Array, m: Array
) -> int:
    """Put the charge into the trail for samples from k on whose windows have begun by now.

    Where that is earlier than now the current is taken for constant.  Returns the next sample.
    """
    while k < last and time[k] - width <= now + 1e-9 * width + 1e-15 * abs(now):
        row, since = trail[k % trail.shape[0]], now - (time[k] - width)
        row[CHARGE], row[FLOW] = x[KEEPS] - since * x[0], x[0]
        for j in range(LANES):
            row[MARK + j] = m[KEPT + j] - since * m[SQ + j]
        k += 1
    return k


@compiled
def observe_lagging(sensor: int, k: int, par: Array, x: Array, m: Array, on: int,
                    trail: Array) -> float:  # fmt: skip
    """Return the current that a sensor shows; put its derivative into row ``on``."""
    r = par[LN_R]
    if sensor != AVERAGED:
        amps = x[KEEPS] / r
        for j in range(LANES):
            m[on + j] = m[KEPT + j] / r + m[ON_OFFSET + j] - amps * m[ON_R + j]
        return float(amps + par[OFFSET])
    row, width = trail[k % trail.shape[0]], 2 * par[CURRENT_LAG]
    amps = (x[KEEPS] - row[CHARGE]) / width / r
    longer = 2 * (row[FLOW] / r - amps) / width
    for j in range(LANES):
        m[on + j] = (
            (m[KEPT + j] - row[MARK + j]) / width / r
            + longer * m[ON_LAG + j]
            + m[ON_OFFSET + j]
            - amps * m[ON_R + j]
        )
    return float(amps + par[OFFSET])
