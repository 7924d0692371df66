"""A speed from the time between two edges of an encoder: held until the next, and its mean since.

A reading that comes ``T`` after the one before says ``count / T``: until then that one was held.
So the time for which a reading is held, times the next reading, is one count, whatever the motor
does; of a speed that is read at regular times, or rounded, it is any number.  Where a count takes
longer than the samples between, what is held is late by up to that time, and says of a motor that
comes to rest how fast it was: friction seems to be none, and a dead zone takes its place.
"""

from dataclasses import replace

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.limits import HALF_EXPLAINED
from smp_motor_ident.diagnosis.sample_limits import EDGE_SPEED, EDGES, HELD
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import speed_quantum
from smp_motor_ident.record import Record

ROWS = 2.05  # for which a reading is held at least where that tells how long
ALIKE = 1.05  # rows by which that is known
TRIED = np.arange(1.0, 100.0)  # percentiles of what a count may be
TICK, NEAR = 1e-6, 0.05  # of a timer [s], and the share of it that a published speed is rounded by
QUICK = 0.25  # rows of a count: a motor that is as fast does not come to rest between two rows


def between_edges(record: Record) -> Record:
    """Return a record whose speed is timed between edges without what is held; others as they are.

    A reading of a count that took longer than the rows between is put in the middle of that time.
    """
    velocity = record.velocity
    if velocity is None or record.count is not None or record.position is not None:
        return record
    count = _count_of(record, velocity)
    if count == 0.0:
        return record
    known, share = _centred(record, velocity, count)
    found = Finding(
        "edge_timer",
        "warning",
        f"the speed is one count of {count:.3g} rad over the time that it took, held until the "
        f"next: at low speed that is late, and {share:.0%} of the readings were left out",
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
    if at.size < EDGES.value:
        return 0.0
    held, after = np.diff(when[at]), np.abs(speed[at[1:]])
    held, after = held[after > 0], after[after > 0]
    per_turn = record.hardware.counts_per_revolution
    if per_turn and _ticks(2 * np.pi / per_turn / after) and not speed_quantum(velocity):
        return 2 * np.pi / per_turn
    step = record.sample_time
    tells = held > ROWS * step
    best, most = 0.0, EDGES.value - 1
    least = EDGE_SPEED.value * ROWS * step * float(np.abs(speed).max())
    for count in np.percentile((held * after)[tells], TRIED) if tells.any() else ():
        slow = count / after > ROWS * step
        alike = np.abs(held - count / after)[slow] < ALIKE * step
        if count < least or np.unique(after[slow]).size < HALF_EXPLAINED.value * alike.size:
            continue  # levels of a rounded speed
        if alike.sum() > most and alike.mean() > HELD.value:
            best, most = float(count), int(alike.sum())
    return best


def _ticks(period: Array) -> bool:
    """Tell whether times of a count are whole microseconds, of which all timers' ticks are some."""
    rest = period / TICK - np.rint(period / TICK)
    return bool(np.mean(np.abs(rest) < NEAR) > HELD.value)


def _centred(record: Record, velocity: Array, count: float) -> tuple[Array, float]:
    """Return readings in the middles of the times that they are of, and the share of none."""
    speed = np.nan_to_num(velocity)
    before = np.append(np.nan, speed[:-1])
    before[list(record.starts)] = np.nan
    with np.errstate(divide="ignore"):
        took = count / np.abs(speed) / record.sample_time  # rows
    # After a rest, or back over the same edge, that time is not one of a count.
    fresh = (speed * before > 0) & ((speed != before) | (took < QUICK))
    rows = np.flatnonzero(fresh)
    to = rows - np.rint(took[rows] / 2).astype(np.int64)
    first = np.array(record.starts)[np.searchsorted(record.starts, rows, side="right") - 1]
    out = np.where((speed == 0) & np.isfinite(velocity), 0.0, np.nan)
    out[to[to >= first]] = speed[rows[to >= first]]
    lost = np.isfinite(velocity) & ~np.isfinite(out)
    return out, float(lost.mean())
