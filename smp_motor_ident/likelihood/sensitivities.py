"""Where the compiled recursion keeps its sensitivities: lanes of one flat array.

Each row of 16 lanes holds one quantity for all columns of the problem.  One array, and rows at
fixed places in it, let the compiler see that they do not overlap: it then advances all columns
at once with the processor's vector instructions.
Derivation: docs/derivations.md, section 4.
"""

from __future__ import annotations

import math

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident._compile import compiled, inlined
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
from smp_motor_ident.model.columns import LOAD, VC_MINUS, VC_PLUS

LANES = 16
# Rows: sensitivity of q, w, angle; of the output and of the current; of friction and load in
# volts, as it is, turning forward, turning backward; by the parameters (12 rows); of
# what the current's sensor keeps; of q, w and angle before the last move.
SQ, SW, ST, D0, D1, DF, FORWARD, BACKWARD, SLOPE = (LANES * n for n in range(9))
KEPT = SLOPE + 12 * LANES
PUSH = KEPT + LANES  # [V] beside the voltage, of the columns that are answers to a signal
BEFORE = PUSH + LANES
FORCED = BEFORE + 3 * LANES  # 12 rows: derivative of the propagator at hand by each column
WHOLE = FORCED + ROW * LANES  # the propagator itself, 12 numbers
OTHER = WHOLE + ROW + 4  # the same of a second propagator: a delay cuts intervals in two
SIZE = OTHER + ROW * LANES + ROW
SLOTS = 4  # propagators that are kept, one more is scratch
SLOT = ROW * LANES + ROW
CACHE = (SLOTS + 1) * SLOT
# Beside the propagators: their lengths [s], the next to be overwritten, the lengths in both banks,
# the bank that is next, the middle and half the range of the lengths that are tabulated, whether
# there are columns that the propagator's derivatives reach, which sensor shows the current, the
# rate of its low-pass [1/s], and whether there are columns that answer to signals.
NEXT, ACTIVE, BESIDE, BANK, MIDDLE, HALF, REACHED, SENSOR, RATE, PUSHED, MARKS = range(
    SLOTS, SLOTS + 11
)


@compiled
def _aligned(size: int) -> Array:
    """Return zeros that begin where a line of the processor's cache does."""
    room = np.zeros(size + 8)
    shift = (-(int(room.ctypes.data) // 8)) % 8
    return room[shift : shift + size]


@compiled
def fill(
    h: float, par: Array, m: Array, cache: Array, marks: Array, slot: int, scratch: Array
) -> None:
    """Put the propagator over h into a slot, with its derivative by each column that it reaches."""
    if par[TE] == 0.0:
        first_order(scratch, h, par[TM], par[K], par[BE])
    else:
        second_order(scratch, h, par[TE], par[TM], par[K], par[BE])
    at = slot * SLOT + ROW * LANES
    for c in range(ROW):
        cache[at + c] = scratch[c]
    if not marks[REACHED] > 0.0:
        return
    at = slot * SLOT
    for c in range(ROW):
        a, b = scratch[ROW + c], scratch[2 * ROW + c]
        d, e = scratch[3 * ROW + c], scratch[4 * ROW + c]
        for j in range(LANES):
            cache[at + j] = (
                a * m[SLOPE + j]
                + b * m[SLOPE + LANES + j]
                + d * m[SLOPE + 2 * LANES + j]
                + e * m[SLOPE + 3 * LANES + j]
            )
        at += LANES


@compiled
def activate(m: Array, cache: Array, marks: Array, slot: int, bank: int) -> None:
    """Put a slot's propagator into a bank, where `slide` finds it."""
    at, to = slot * SLOT, FORCED if bank == 0 else OTHER
    if marks[REACHED] > 0.0:
        for n in range(SLOT):
            m[to + n] = cache[at + n]
    else:
        for n in range(SLOT - ROW, SLOT):
            m[to + n] = cache[at + n]
    marks[ACTIVE + bank] = marks[slot] if slot < SLOTS else -1.0


@compiled
def tabulate(
    step: float, par: Array, m: Array, cache: Array, marks: Array, scratch: Array
) -> Array:
    """Return a table of the propagators around a usual interval.

    Their derivatives are in it only where there are columns that they reach.
    """
    half = half_range(step, par[TE], par[TM], par[K], par[BE])
    marks[MIDDLE], marks[HALF] = step, half
    if half == 0.0:
        return np.zeros(0)
    width = SLOT if marks[REACHED] > 0.0 else ROW
    table, values = _aligned(NODES * width), np.empty(NODES * width)
    for n in range(NODES):
        fill(step + half * POINTS[n], par, m, cache, marks, SLOTS, scratch)
        for i in range(width):
            values[n * width + i] = cache[CACHE - width + i]
    expand(values, table)
    return table


@compiled
def prepare_slide(
    h: float,
    slack: float,
    par: Array,
    m: Array,
    cache: Array,
    marks: Array,
    table: Array,
    scratch: Array,
) -> int:
    """Return the bank that has the propagator over h: tabulated, kept, or computed."""
    if table.shape[0] > 0 and abs(h - marks[MIDDLE]) <= marks[HALF]:
        to = FORCED if marks[REACHED] > 0.0 else WHOLE
        evaluate(table, (h - marks[MIDDLE]) / marks[HALF], m, to)
        marks[ACTIVE] = h
        return 0
    bank = int(marks[BANK])
    marks[BANK] = 1 - bank
    for n in range(SLOTS):
        if abs(marks[n] - h) <= slack:
            activate(m, cache, marks, n, bank)
            return bank
    slot = int(marks[NEXT])
    marks[NEXT] = (slot + 1) % SLOTS
    marks[slot] = h
    fill(h, par, m, cache, marks, slot, scratch)
    activate(m, cache, marks, slot, bank)
    return bank


@inlined
def slide_columns(m: Array, at: int, q: float, w: float, v: float, f: float) -> None:
    """Advance all columns over the interval at hand; q, w: state at its beginning."""
    e00, e01, e10, e11 = (
        m[at + ROW * LANES],
        m[at + ROW * LANES + 1],
        m[at + ROW * LANES + 2],
        m[at + ROW * LANES + 3],
    )
    h0, h1 = m[at + ROW * LANES + 4], m[at + ROW * LANES + 5]
    g0, g1, g2 = m[at + ROW * LANES + 9], m[at + ROW * LANES + 10], m[at + ROW * LANES + 11]
    for j in range(LANES):
        a, b, c = m[SQ + j], m[SW + j], m[DF + j]
        new_q = (
            e00 * a
            + e01 * b
            - g0 * c
            + m[at + j] * q
            + m[at + LANES + j] * w
            + m[at + 6 * LANES + j] * v
            - m[at + 9 * LANES + j] * f
        )
        new_w = (
            e10 * a
            + e11 * b
            - g1 * c
            + m[at + 2 * LANES + j] * q
            + m[at + 3 * LANES + j] * w
            + m[at + 7 * LANES + j] * v
            - m[at + 10 * LANES + j] * f
        )
        m[ST + j] += (
            h0 * a
            + h1 * b
            - g2 * c
            + m[at + 4 * LANES + j] * q
            + m[at + 5 * LANES + j] * w
            + m[at + 8 * LANES + j] * v
            - m[at + 11 * LANES + j] * f
        )
        m[SQ + j] = new_q
        m[SW + j] = new_w


@inlined
def push_columns(m: Array, at: int) -> None:
    """Let the signals beside the voltage act over the interval at hand."""
    v0, v1, v2 = m[at + ROW * LANES + 6], m[at + ROW * LANES + 7], m[at + ROW * LANES + 8]
    for j in range(LANES):
        m[SQ + j] += v0 * m[PUSH + j]
        m[SW + j] += v1 * m[PUSH + j]
        m[ST + j] += v2 * m[PUSH + j]


@inlined
def slide_state(m: Array, at: int, x: Array, v: float, f: float) -> None:
    """Advance the state over the interval at hand."""
    q, w = x[0], x[1]
    x[0] = (
        m[at + ROW * LANES] * q
        + m[at + ROW * LANES + 1] * w
        + m[at + ROW * LANES + 6] * v
        - m[at + ROW * LANES + 9] * f
    )
    x[1] = (
        m[at + ROW * LANES + 2] * q
        + m[at + ROW * LANES + 3] * w
        + m[at + ROW * LANES + 7] * v
        - m[at + ROW * LANES + 10] * f
    )
    x[2] += (
        m[at + ROW * LANES + 4] * q
        + m[at + ROW * LANES + 5] * w
        + m[at + ROW * LANES + 8] * v
        - m[at + ROW * LANES + 11] * f
    )


@compiled
def stay(h: float, par: Array, x: Array, m: Array, v: float) -> None:
    """Advance the stuck motor: the current relaxes towards v / R, nothing turns."""
    if par[TE] == 0.0:
        return
    e = math.exp(-h / par[TE])
    d = (x[0] - v) * e * h / par[TE]
    x[0] = v + (x[0] - v) * e
    for j in range(LANES):
        m[SQ + j] = e * m[SQ + j] + d * m[SLOPE + j] + (1.0 - e) * m[PUSH + j]


@compiled
def fade(m: Array) -> None:
    """Put to nothing what has decayed so far: numbers below the normal ones cost ten times more."""
    for at in (SQ, SW, ST, KEPT):
        for j in range(at, at + LANES):
            if abs(m[j]) < DECAYED:
                m[j] = 0.0


@compiled
def turn(m: Array, direction: float) -> None:
    """Let friction act against a direction of motion, in the columns."""
    for j in range(LANES):
        m[DF + j] = m[FORWARD + j] if direction > 0.0 else m[BACKWARD + j]


@compiled
def begin(slope: Array, local: Integers, friction: bool) -> tuple[Array, Array, Array, Array]:
    """Return the lanes, cache, marks and scratch of a run."""
    m, cache, marks = _aligned(SIZE), _aligned(CACHE), np.full(MARKS, -1.0)
    n_common = slope.shape[1]
    marks[NEXT] = marks[BANK] = 0.0
    marks[REACHED], marks[SENSOR], marks[PUSHED] = 1.0 if n_common > 0 else 0.0, 0.0, 0.0
    for j in range(n_common):
        for i in range(12):
            m[SLOPE + LANES * i + j] = slope[i, j]
        m[FORWARD + j] = slope[LOAD, j] + (slope[VC_PLUS, j] if friction else 0.0)
        m[BACKWARD + j] = slope[LOAD, j] - (slope[VC_MINUS, j] if friction else 0.0)
    for j in range(local.shape[0]):
        if local[j] == 3:
            m[FORWARD + n_common + j] = m[BACKWARD + n_common + j] = 1.0
    return m, cache, marks, np.zeros(WIDTH)
