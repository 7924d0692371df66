"""What the sensors show of the state, and its derivatives.

Derivation: docs/derivations.md, sections 4 and 6.
"""

from __future__ import annotations

from smp_motor_control.arrays import Array
from smp_motor_ident._compile import compiled, inlined
from smp_motor_ident.likelihood.low_pass import low_passed
from smp_motor_ident.likelihood.sensitivities import D0, D1, LANES, SLOPE, SQ, ST, SW
from smp_motor_ident.model import measurement
from smp_motor_ident.model.columns import LN_R, OFFSET, WINDOW


@compiled
def remember(ring: Array, k: int, t: float, x: Array, m: Array) -> None:
    """Keep time, angle, speed and the sensitivities of both."""
    row = ring[k % ring.shape[0]]
    p = (ring.shape[1] - 3) // 2
    row[0] = t
    row[1] = x[2]
    row[2] = x[1]
    for j in range(p):
        row[3 + j] = m[ST + j]
        row[3 + p + j] = m[SW + j]


@compiled
def _last_before(ring: Array, k: int, oldest: int, t: float) -> int:
    """Return which of the kept samples, up to the one before the last, is the last before t."""
    before, after, n = oldest, k, ring.shape[0]
    while after - before > 1:  # a window may span thousands of samples
        middle = (before + after) // 2
        if ring[middle % n, 0] > t:
            after = middle
        else:
            before = middle
    return before


@compiled
def recall(ring: Array, k: int, first: int, t: float, p: int, past: Array) -> float:
    """Put the angle at time t and its sensitivities into `past`; return the speed there."""
    n = ring.shape[0]
    oldest = max(first, k - n + 1)
    a = ring[oldest % n]
    if t <= a[0]:  # before the record: the speed it began with
        for j in range(p):
            past[1 + j] = a[3 + j] + (t - a[0]) * a[3 + p + j]
        past[0] = a[1] + (t - a[0]) * a[2]
        return float(a[2])
    before = _last_before(ring, k, oldest, t)
    a, b = ring[before % n], ring[(before + 1) % n]
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
def recall_speed(ring: Array, k: int, first: int, t: float, p: int, past: Array) -> float:
    """Put the speed at time t and its sensitivities into `past`; return the acceleration there."""
    n = ring.shape[0]
    oldest = max(first, k - n + 1)
    a = ring[oldest % n]
    if t <= a[0]:  # before the record: the speed it began with
        past[0] = a[2]
        for j in range(p):
            past[1 + j] = a[3 + p + j]
        return 0.0
    before = _last_before(ring, k, oldest, t)
    a, b = ring[before % n], ring[(before + 1) % n]
    h = b[0] - a[0]
    u = (t - a[0]) / h
    mean, d0, d1 = 6 * u * (1 - u) / h, (1 - u) * (1 - 3 * u), u * (3 * u - 2)
    past[0] = mean * (b[1] - a[1]) + d0 * a[2] + d1 * b[2]
    for j in range(p):
        past[1 + j] = mean * (b[3 + j] - a[3 + j]) + d0 * a[3 + p + j] + d1 * b[3 + p + j]
    bend = 6 * (1 - 2 * u) / h * (b[1] - a[1])
    return float((bend + (6 * u - 4) * a[2] + (6 * u - 2) * b[2]) / h)


ANGLE, MEAN_SPEED = measurement.ANGLE.code, measurement.MEAN_SPEED.code
LATE_SPEED = measurement.LATE_SPEED.code
LOW_PASSED = measurement.LOW_PASSED.code
ON_OFFSET, ON_R = SLOPE + OFFSET * LANES, SLOPE + LN_R * LANES
ON_WINDOW = SLOPE + WINDOW * LANES


@inlined
def observe(
    kind: int, k: int, first: int, t: float, par: Array, x: Array, m: Array, ring: Array,
    past: Array, columns: bool,
) -> float:  # fmt: skip
    """Return the mechanical output; put its derivative into D0."""
    if kind == MEAN_SPEED:
        remember(ring, k, t, x, m)
        width = par[WINDOW]
        p = past.shape[0] - 1
        speed = recall(ring, k, first, t - width, p, past)
        y = float((x[2] - past[0]) / width)
        for j in range(p):
            m[D0 + j] = (m[ST + j] - past[1 + j] + (speed - y) * m[ON_WINDOW + j]) / width
        return y
    if kind == LATE_SPEED:
        remember(ring, k, t, x, m)
        p = past.shape[0] - 1
        acceleration = recall_speed(ring, k, first, t - 0.5 * par[WINDOW], p, past)
        for j in range(p):
            m[D0 + j] = past[1 + j] - 0.5 * acceleration * m[ON_WINDOW + j]
        return float(past[0])
    if kind >= LOW_PASSED:
        lag, ticks, p = 0.5 * par[WINDOW], kind - LOW_PASSED, past.shape[0] - 1
        return low_passed(k == first, t, lag, ticks, x, m, ring, p)
    if columns:
        if kind == ANGLE:
            for j in range(LANES):
                m[D0 + j] = m[ST + j]
        else:
            for j in range(LANES):
                m[D0 + j] = m[SW + j]
    return float(x[2] if kind == ANGLE else x[1])


@inlined
def observe_current(par: Array, x: Array, m: Array) -> float:
    """Return the current; put its derivative into D1."""
    amps = x[0] / par[LN_R]
    for j in range(LANES):
        m[D1 + j] = m[SQ + j] / par[LN_R] + m[ON_OFFSET + j] - amps * m[ON_R + j]
    return float(amps + par[OFFSET])


@inlined
def note(row: Array, speed: float, y0: float, y1: float) -> None:
    """Put into a row what it has room for: the output; speed, output (and current)."""
    if row.shape[0] == 1:
        row[0] = y0
        return
    row[0], row[1] = speed, y0
    if row.shape[0] > 2:
        row[2] = y1
