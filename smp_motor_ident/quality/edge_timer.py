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
from smp_motor_ident.limits import EDGE_SPEED, EDGES, HALF_EXPLAINED, HELD
from smp_motor_ident.quality.resolution import speed_quantum
from smp_motor_ident.record import Record

ROWS = 2.05  # shortest holding time that identifies a count [rows]
ALIKE = 1.05  # uncertainty of a holding time [rows]
TRIED = np.arange(1.0, 100.0)  # percentiles tried as the size of a count
TICK, NEAR = 1e-6, 0.05  # tick of a timer [s]; rounding of a published speed [ticks]
NEIGHBOURS = 2.5  # rows between two readings that are read off between: with one row left out
QUICK = 0.25  # rows of a count: a motor that is as fast does not come to rest between two rows


def between_edges(record: Record) -> Record:
    """Return a record with an edge-timed speed interpolated instead of held; others unchanged.

    Each reading is assigned to the middle of its edge interval, then interpolated to the rows.
    """
    velocity = record.velocity
    if velocity is None or record.count is not None or record.position is not None:
        return record
    count = _count_of(record, velocity)
    if count == 0.0:
        return record
    known, share = _centre(record, velocity, count)
    found = Finding(
        "edge_timer",
        "warning",
        f"the speed is from the time of one count ({count:.3g} rad), held until the next: it lags "
        f"at low speed; {100 * share:.0f} % of the readings were left out",
        {"count": count, "share": share},
        "record the encoder's counts",
    )
    return replace(record, velocity=known, findings=(*record.findings, found))


def held_of(record: Record) -> float:
    """Return which share of the readings was left out for being held."""
    said = [f.evidence["share"] for f in record.findings if f.code == "edge_timer"]
    return sum(float(s or 0.0) for s in said)


def _count_of(record: Record, velocity: Array) -> float:
    """Return the angle of a count, 0 where a speed is not the time of one."""
    known = np.flatnonzero(np.isfinite(velocity))
    speed, when = velocity[known], record.time[known]
    at = np.flatnonzero(np.diff(speed) != 0) + 1
    if at.size < EDGES:
        return 0.0
    held, after = np.diff(when[at]), np.abs(speed[at[1:]])
    held, after = held[after > 0], after[after > 0]
    per_turn = record.hardware.counts_per_revolution
    if per_turn and _ticks(2 * np.pi / per_turn / after) and not speed_quantum(velocity):
        return 2 * np.pi / per_turn
    step = record.sample_time
    tells = held > ROWS * step
    best, most = 0.0, EDGES - 1
    least = EDGE_SPEED * ROWS * step * float(np.abs(speed).max())
    for count in np.percentile((held * after)[tells], TRIED) if tells.any() else ():
        slow = count / after > ROWS * step
        alike = np.abs(held - count / after)[slow] < ALIKE * step
        if count < least or np.unique(after[slow]).size < HALF_EXPLAINED * alike.size:
            continue  # levels of a rounded speed
        if alike.sum() > most and alike.mean() > HELD:
            best, most = float(count), int(alike.sum())
    return best


def _ticks(period: Array) -> bool:
    """Tell whether times of a count are whole microseconds, the ticks of usual timers."""
    rest = period / TICK - np.rint(period / TICK)
    return bool(np.mean(np.abs(rest) < NEAR) > HELD)


def _centre(record: Record, velocity: Array, count: float) -> tuple[Array, float]:
    """Return the interpolated speed at the rows, and the share of rows without a value."""
    speed, step = np.nan_to_num(velocity), record.sample_time
    out = np.full(speed.size, np.nan)
    with np.errstate(divide="ignore"):
        took = count / np.abs(speed)
    longest = float(took[speed != 0].max(initial=0.0))
    for begin, end in itertools.pairwise((*record.starts, speed.size)):
        rows = slice(begin, end)
        when, said, time = record.time[rows], speed[rows], took[rows]
        before = np.append(np.nan, said[:-1])
        # After a rest, or back over the same edge, that time is not one of a count.
        fresh = (said * before > 0) & ((said != before) | (time < QUICK * step))
        # The last edge was up to a row ago, or up to a count where that takes less.
        middle = when - 0.5 * (time + np.minimum(time, step))
        at, most = np.flatnonzero(fresh), NEIGHBOURS * step
        out[rows] = _between(when, middle[at], said[at], most)
        close = _close(middle[at], said[at], most)
        # Before a reversal or a rest the last edge may be longer ago than by that.
        own = at[1:-1][close[:-1] & close[1:] & (time[at[1:-1]] <= step)]
        out[rows][own] = _ahead(when, middle, said, own, at)
        zero = (said == 0) & np.isfinite(velocity[rows])
        out[rows][_rests(when, zero, 2 * longest + step)] = 0.0
    lost = np.isfinite(velocity) & ~np.isfinite(out)
    return out, float(lost.mean())


def _close(middle: Array, said: Array, most: float) -> Flags:
    """Tell which readings are close behind the one before, and of its sign."""
    apart = np.diff(middle)
    return np.asarray((apart > 0) & (apart < most) & (said[1:] * said[:-1] > 0))


def _ahead(when: Array, middle: Array, said: Array, own: Integers, at: Integers) -> Array:
    """Return readings as far ahead as they are late, along the way from the one before.

    The voltage may change in a reading's own row, so that what follows tells of another motion.
    """
    before = at[np.searchsorted(at, own) - 1]
    slope = (said[own] - said[before]) / (middle[own] - middle[before])
    return np.asarray(said[own] + (when[own] - middle[own]) * slope)


def _between(when: Array, middle: Array, said: Array, most: float) -> Array:
    """Return what readings say of rows: linear between two that are close, else of the nearest.

    In the nearest row a reading is off by up to half of one, in which a quick motor reverses.
    """
    out = np.full(when.size, np.nan)
    if middle.size < 2:
        return out
    middle = np.maximum.accumulate(middle)
    close = _close(middle, said, most)
    alone = ~(np.append(close, False) | np.append(False, close)) & (middle >= when[0])
    row = np.interp(middle[alone], when, np.arange(when.size))
    out[np.rint(row).astype(np.int64)] = said[alone]
    after = np.searchsorted(middle, when, side="right")
    inside = (after > 0) & (after < middle.size)
    inside[inside] = close[after[inside] - 1]
    out[inside] = np.interp(when[inside], middle, said)
    return out


def _rests(when: Array, zero: Flags, longest: float) -> Flags:
    """Return the rows of a rest: one that is over sooner may be a reversal, within two counts."""
    edges = np.flatnonzero(np.diff(zero.astype(np.int8), prepend=0, append=0))
    out = np.zeros(when.size, dtype=np.bool_)
    for first, after in zip(edges[::2], edges[1::2], strict=True):
        if first == 0 or after == when.size or when[after] - when[first] > longest:
            out[first:after] = True
    return out
