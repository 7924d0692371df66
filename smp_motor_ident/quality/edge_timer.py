# SPDX-License-Identifier: Apache-2.0
"""Correct a speed from the time between two encoder edges, which is held until the next edge.

A reading ``T`` after the last edge is ``count / T``, the mean speed since that edge; until then the
reading before is held.  So the holding time of a reading, times the next reading, is one count for
any motion; for a speed sampled regularly, or rounded, it varies.  Where a count takes longer than a
sample, the held value lags by up to that time, and stays at the last speed when the motor stops:
friction seems to vanish, and a dead zone appears instead.
"""

import itertools
from dataclasses import replace

import numpy as np

from smp_motor_control.arrays import Array, Flags, Integers
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import (
    MIN_EDGE_READINGS,
    MIN_EDGE_SPEED,
    MIN_EXPLAINED_SHARE,
    MIN_HELD_SHARE,
)
from smp_motor_ident.quality.resolution import speed_quantum
from smp_motor_ident.record import Record

MIN_HOLDING_ROWS = 2.05  # shortest holding time that identifies a count
HOLDING_TOLERANCE_ROWS = 1.05
COUNT_PERCENTILES = np.arange(1.0, 100.0)  # percentiles tried as the size of a count
TIMER_TICK_S, TICK_TOLERANCE = 1e-6, 0.05  # resolution of a timer, and tolerance in ticks
MAX_NEIGHBOUR_ROWS = 2.5  # distance of interpolated readings: one row may be missing
MIN_COUNT_ROWS = 0.25  # duration of a count; a faster motor does not stop between two rows


def interpolate_edge_timing(record: Record) -> Record:
    """Interpolate an edge-timed speed that is held between edges; return others unchanged.

    Each reading is assigned to the middle of its edge interval, then interpolated to the rows.
    """
    velocity = record.velocity
    if velocity is None or record.count is not None or record.position is not None:
        return record
    count = _find_count_angle(record, velocity)
    if count == 0.0:
        return record
    known, share = _interpolate_speed(record, velocity, count)
    found = Finding(
        "edge_timer",
        "warning",
        f"the speed is measured by the time of one count ({count:.3g} rad) and held to the next, "
        f"so it lags at low speed; {100 * share:.0f} % of the readings were left out",
        {"count": count, "share": share},
        "record the encoder's counts",
    )
    return replace(record, velocity=known, findings=(*record.findings, found))


def read_held_share(record: Record) -> float:
    """Read the share of readings that were left out as held from the findings."""
    shares = [f.evidence["share"] for f in record.findings if f.code == "edge_timer"]
    return sum(float(s or 0.0) for s in shares)


def _find_count_angle(record: Record, velocity: Array) -> float:
    """Find the angle of a count, 0 if the speed is not from the time of one."""
    known = np.flatnonzero(np.isfinite(velocity))
    speed, when = velocity[known], record.time[known]
    at = np.flatnonzero(np.diff(speed) != 0) + 1
    if at.size < MIN_EDGE_READINGS:
        return 0.0
    held, after = np.diff(when[at]), np.abs(speed[at[1:]])
    held, after = held[after > 0], after[after > 0]
    per_turn = record.hardware.counts_per_revolution
    if per_turn and _are_timer_ticks(2 * np.pi / per_turn / after) and not speed_quantum(velocity):
        return 2 * np.pi / per_turn
    step = record.sample_time
    tells = held > MIN_HOLDING_ROWS * step
    best, max_alike = 0.0, MIN_EDGE_READINGS - 1
    least = MIN_EDGE_SPEED * MIN_HOLDING_ROWS * step * float(np.abs(speed).max())
    for count in np.percentile((held * after)[tells], COUNT_PERCENTILES) if tells.any() else ():
        slow = count / after > MIN_HOLDING_ROWS * step
        alike = np.abs(held - count / after)[slow] < HOLDING_TOLERANCE_ROWS * step
        if count < least or np.unique(after[slow]).size < MIN_EXPLAINED_SHARE * alike.size:
            continue  # levels of a rounded speed
        if alike.sum() > max_alike and alike.mean() > MIN_HELD_SHARE:
            best, max_alike = float(count), int(alike.sum())
    return best


def _are_timer_ticks(period: Array) -> bool:
    """Return whether times of a count are whole microseconds, as of usual timers."""
    rest = period / TIMER_TICK_S - np.rint(period / TIMER_TICK_S)
    return bool(np.mean(np.abs(rest) < TICK_TOLERANCE) > MIN_HELD_SHARE)


def _interpolate_speed(record: Record, velocity: Array, count: float) -> tuple[Array, float]:
    """Return the interpolated speed at the rows, and the share of rows without a value."""
    speed, step = np.nan_to_num(velocity), record.sample_time
    out = np.full(speed.size, np.nan)
    with np.errstate(divide="ignore"):
        took = count / np.abs(speed)
    longest = float(took[speed != 0].max(initial=0.0))
    for begin, end in itertools.pairwise((*record.starts, speed.size)):
        rows = slice(begin, end)
        when, reading, time = record.time[rows], speed[rows], took[rows]
        before = np.append(np.nan, reading[:-1])
        # After a rest, or on the way back over the same edge, this time is not that of a count.
        fresh = (reading * before > 0) & ((reading != before) | (time < MIN_COUNT_ROWS * step))
        # The last edge was up to a row ago, or up to a count where that takes less.
        middle = when - 0.5 * (time + np.minimum(time, step))
        at, max_gap = np.flatnonzero(fresh), MAX_NEIGHBOUR_ROWS * step
        out[rows] = _interpolate_rows(when, middle[at], reading[at], max_gap)
        close = _find_adjacent(middle[at], reading[at], max_gap)
        # Before a reversal or a rest the last edge may be older.
        own = at[1:-1][close[:-1] & close[1:] & (time[at[1:-1]] <= step)]
        out[rows][own] = _extrapolate_readings(when, middle, reading, own, at)
        zero = (reading == 0) & np.isfinite(velocity[rows])
        out[rows][_find_rests(when, zero, 2 * longest + step)] = 0.0
    lost = np.isfinite(velocity) & ~np.isfinite(out)
    return out, float(lost.mean())


def _find_adjacent(middle: Array, reading: Array, max_gap: float) -> Flags:
    """Mark readings that closely follow one of the same sign."""
    apart = np.diff(middle)
    return np.asarray((apart > 0) & (apart < max_gap) & (reading[1:] * reading[:-1] > 0))


def _extrapolate_readings(
    when: Array, middle: Array, reading: Array, own: Integers, at: Integers
) -> Array:
    """Extrapolate readings to their rows from the reading before.

    The voltage may change in a reading's own row, so later readings belong to another motion.
    """
    before = at[np.searchsorted(at, own) - 1]
    slope = (reading[own] - reading[before]) / (middle[own] - middle[before])
    return np.asarray(reading[own] + (when[own] - middle[own]) * slope)


def _interpolate_rows(when: Array, middle: Array, reading: Array, max_gap: float) -> Array:
    """Interpolate adjacent readings linearly at the rows; a lone one holds in its nearest row.

    There it is up to half a row off, in which a fast motor may reverse.
    """
    out = np.full(when.size, np.nan)
    if middle.size < 2:
        return out
    middle = np.maximum.accumulate(middle)
    close = _find_adjacent(middle, reading, max_gap)
    alone = ~(np.append(close, False) | np.append(False, close)) & (middle >= when[0])
    row = np.interp(middle[alone], when, np.arange(when.size))
    out[np.rint(row).astype(np.int64)] = reading[alone]
    after = np.searchsorted(middle, when, side="right")
    inside = (after > 0) & (after < middle.size)
    inside[inside] = close[after[inside] - 1]
    out[inside] = np.interp(when[inside], middle, reading)
    return out


def _find_rests(when: Array, zero: Flags, longest: float) -> Flags:
    """Mark the rows of rests; a shorter one may be a reversal within two counts."""
    edges = np.flatnonzero(np.diff(zero.astype(np.int8), prepend=0, append=0))
    out = np.zeros(when.size, dtype=np.bool_)
    for first, after in zip(edges[::2], edges[1::2], strict=True):
        if first == 0 or after == when.size or when[after] - when[first] > longest:
            out[first:after] = True
    return out
