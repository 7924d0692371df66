"""Where the compiled recursion keeps its sensitivities: lanes of one flat array.

Each row of 16 lanes holds one quantity for all columns of the problem.  One array, and rows at
fixed places in it, let the compiler see that they do not overlap: it then advances all columns
at once with the processor's vector instructions.
Derivation: docs/derivations.md, section 4.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident._compile import compiled, inlined
from smp_motor_ident.likelihood.propagator import (
    BE,
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
from smp_motor_ident.model.structures import LOAD, VC_MINUS, VC_PLUS

Array = NDArray[np.float64]

LANES = 16
# Rows: sensitivity of q, w, angle; of the output and of the current; of friction and load in
# volts, as it is, turning forward, turning backward; by the parameters (12 rows); of
# what the current's sensor keeps; of q, w and angle before the last move.
SQ, SW, ST, D0, D1, DF, FORWARD, BACKWARD, SLOPE = (LANES * n for n in range(9))
KEPT = SLOPE + 12 * LANES
BEFORE = KEPT + LANES
FORCED = BEFORE + 3 * LANES  # 12 rows: derivative of the propagator at hand by each column
WHOLE = FORCED + ROW * LANES  # the propagator itself, 12 numbers
SIZE = WHOLE + ROW
SLOTS = 4  # propagators that are kept, one more is scratch
SLOT = ROW * LANES + ROW
CACHE = (SLOTS + 1) * SLOT
# Beside the propagators: their lengths [s], the next to be overwritten, the length at hand,
# the middle and half the range of the lengths that are tabulated, whether there are columns that
# the propagator's derivatives reach, which sensor shows the current, and
# the rate of its low-pass [1/s].
NEXT, ACTIVE, MIDDLE, HALF, REACHED, SENSOR, RATE, MARKS = range(SLOTS, SLOTS + 8)


@compiled
def _aligned(size: int) -> Array:
    """Return zeros that begin where a line of the processor's cache does."""
    room = np.zeros(size + 8)
    shift = (-(int(room.ctypes.data) // 8)) % 8
    return room[shift : shift + size]


@compiled
def fill(h: float, par: Array, m: Array, cache: Array, slot: int, scratch: Array) -> None:
    """Put the propagator over h into a slot, with its derivative by each column."""
    if par[TE] == 0.0:
        first_order(scratch, h, par[TM], par[K], par[BE])
    else:
        second_order(scratch, h, par[TE], par[TM], par[K], par[BE])
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
    for c in range(ROW):
        cache[at + c] = scratch[c]


@compiled
def activate(m: Array, cache: Array, marks: Array, slot: int) -> None:
    """Put a slot's propagator where `slide` finds it."""
    at = slot * SLOT
    if marks[REACHED] > 0.0:
        for n in range(SLOT):
            m[FORCED + n] = cache[at + n]
    else:
        at += SLOT - ROW
        for n in range(ROW):
            m[WHOLE + n] = cache[at + n]
    marks[ACTIVE] = marks[slot] if slot < SLOTS else -1.0


@compiled
def tabulate(
    step: float, par: Array, m: Array, cache: Array, marks: Array, scratch: Array
) -> Array:
    """Return a table of the propagators around a usual interval."""
    half = half_range(step, par[TE], par[TM], par[K], par[BE])
    marks[MIDDLE], marks[HALF] = step, half
    if half == 0.0:
        return np.zeros(0)
    table, values = _aligned(NODES * SLOT), np.empty(NODES * SLOT)
    for n in range(NODES):
        fill(step + half * POINTS[n], par, m, cache, SLOTS, scratch)
        for i in range(SLOT):
            values[n * SLOT + i] = cache[SLOTS * SLOT + i]
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
) -> None:
    """Have the propagator over h at hand: tabulated, kept, or computed."""
    if table.shape[0] > 0 and abs(h - marks[MIDDLE]) <= marks[HALF]:
        evaluate(table, (h - marks[MIDDLE]) / marks[HALF], m, FORCED)
        marks[ACTIVE] = h
        return
    for n in range(SLOTS):
        if abs(marks[n] - h) <= slack:
            activate(m, cache, marks, n)
            return
    slot = int(marks[NEXT])
    marks[NEXT] = (slot + 1) % SLOTS
    marks[slot] = h
    fill(h, par, m, cache, slot, scratch)
    activate(m, cache, marks, slot)


@compiled
def slide_columns(m: Array, q: float, w: float, v: float, f: float) -> None:
    """Advance all columns over the interval at hand; q, w: state at its beginning."""
    e00, e01, e10, e11 = m[WHOLE], m[WHOLE + 1], m[WHOLE + 2], m[WHOLE + 3]
    h0, h1 = m[WHOLE + 4], m[WHOLE + 5]
    g0, g1, g2 = m[WHOLE + 9], m[WHOLE + 10], m[WHOLE + 11]
    for j in range(LANES):
        a, b, c = m[SQ + j], m[SW + j], m[DF + j]
        new_q = (
            e00 * a
            + e01 * b
            - g0 * c
            + m[FORCED + j] * q
            + m[FORCED + LANES + j] * w
            + m[FORCED + 6 * LANES + j] * v
            - m[FORCED + 9 * LANES + j] * f
        )
        new_w = (
            e10 * a
            + e11 * b
            - g1 * c
            + m[FORCED + 2 * LANES + j] * q
            + m[FORCED + 3 * LANES + j] * w
            + m[FORCED + 7 * LANES + j] * v
            - m[FORCED + 10 * LANES + j] * f
        )
        m[ST + j] += (
            h0 * a
            + h1 * b
            - g2 * c
            + m[FORCED + 4 * LANES + j] * q
            + m[FORCED + 5 * LANES + j] * w
            + m[FORCED + 8 * LANES + j] * v
            - m[FORCED + 11 * LANES + j] * f
        )
        m[SQ + j] = new_q
        m[SW + j] = new_w


@inlined
def slide_state(m: Array, x: Array, v: float, f: float) -> None:
    """Advance the state over the interval at hand."""
    q, w = x[0], x[1]
    x[0] = m[WHOLE] * q + m[WHOLE + 1] * w + m[WHOLE + 6] * v - m[WHOLE + 9] * f
    x[1] = m[WHOLE + 2] * q + m[WHOLE + 3] * w + m[WHOLE + 7] * v - m[WHOLE + 10] * f
    x[2] += m[WHOLE + 4] * q + m[WHOLE + 5] * w + m[WHOLE + 8] * v - m[WHOLE + 11] * f


@compiled
def stay(h: float, par: Array, x: Array, m: Array, v: float) -> None:
    """Advance the stuck motor: the current relaxes towards v / R, nothing turns."""
    if par[TE] == 0.0:
        return
    e = math.exp(-h / par[TE])
    d = (x[0] - v) * e * h / par[TE]
    x[0] = v + (x[0] - v) * e
    for j in range(LANES):
        m[SQ + j] = e * m[SQ + j] + d * m[SLOPE + j]


@compiled
def turn(m: Array, direction: float) -> None:
    """Let friction act against a direction of motion, in the columns."""
    for j in range(LANES):
        m[DF + j] = m[FORWARD + j] if direction > 0.0 else m[BACKWARD + j]


@compiled
def begin(
    slope: Array, local: NDArray[np.int64], friction: bool
) -> tuple[Array, Array, Array, Array]:
    """Return the lanes, cache, marks and scratch of a run."""
    m, cache, marks = _aligned(SIZE), _aligned(CACHE), np.full(MARKS, -1.0)
    n_common = slope.shape[1]
    marks[NEXT], marks[REACHED], marks[SENSOR] = 0.0, 1.0 if n_common > 0 else 0.0, 0.0
    for j in range(n_common):
        for i in range(12):
            m[SLOPE + LANES * i + j] = slope[i, j]
        m[FORWARD + j] = slope[LOAD, j] + (slope[VC_PLUS, j] if friction else 0.0)
        m[BACKWARD + j] = slope[LOAD, j] - (slope[VC_MINUS, j] if friction else 0.0)
    for j in range(local.shape[0]):
        if local[j] == 3:
            m[FORWARD + n_common + j] = m[BACKWARD + n_common + j] = 1.0
    return m, cache, marks, np.zeros(WIDTH)
