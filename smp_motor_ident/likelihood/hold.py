"""The input as it was held: what means over intervals tell of switches inside them.

Derivation: docs/derivations.md, section 4.
"""

from __future__ import annotations

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.record import Record

EDGE = 0.02
"""Part of an interval next to its ends in which a switch counts as one at the sample."""

QUARTERS = np.array([7, 39, 51, 83]) / 90
"""Shares of a rise, held for a quarter of an interval each, whose moments up to the fourth are
those of the straight line."""


def held_intervals(record: Record, hold: str) -> tuple[Array, Array, Integers]:
    """Return the input as it was held, as far as the mean voltages tell.

    ``voltage[k]`` is a mean.  Where the intervals before and after are steady and differ, a
    two-level command switched inside, and the mean tells when.  A command that changes at
    every sample switches at the same fraction of the interval as its jumps did nearby; its
    levels before and after follow from the trend.
    """
    v, t = record.voltage, record.time
    index = np.arange(len(v), dtype=np.int64)
    if hold == "held":
        return t, v, index
    k, before = _jumps(record)
    first, second = v.copy(), v.copy()
    share: Array = np.full(len(v), 0.5 if hold == "middle" else 0.0)
    if k.size >= 4:
        # Two clocks drift past each other: the part runs through 1 to 0, not back.
        share = np.interp(index, k, np.unwrap(before, period=1.0)) % 1.0
    if k.size >= 4 or hold == "middle":
        step = _trend(v)
        step[[0, *record.starts]] = 0.0
        first -= step * (1 - share)
        second += step * share
    share[k] = before
    first[k], second[k] = v[k - 1], v[k + 1]
    split = np.flatnonzero((first != second) & (share > EDGE) & (share < 1 - EDGE))
    split = split[split > 0]
    switch = t[split - 1] + share[split] * (t[split] - t[split - 1])
    value = v.copy()
    value[split] = second[split]
    end = np.insert(t, split, switch)
    value = np.insert(value, split, first[split])
    shift = np.zeros(len(v), dtype=np.int64)
    shift[split] = 1
    return end, value, index + np.cumsum(shift)


def rerun(time: Array, voltage: Array, starts: Integers, how: str) -> tuple[int, Array, Array]:
    """Return sections a row, their ends and values, of a command that does not run up to its row.

    ``after`` it: zero-order hold from the row on.  ``interpolated``: straight from row to row.
    """
    before, start = np.roll(voltage, 1), np.roll(time, 1)
    before[starts], start[starts] = voltage[starts], time[starts]
    if how == "after":
        return 1, time.copy(), before
    value = before[:, None] + (voltage - before)[:, None] * QUARTERS
    end = start[:, None] + (time - start)[:, None] * np.array([0.25, 0.5, 0.75, 1.0])
    end[:, -1] = time
    return len(QUARTERS), end.ravel(), value.ravel()


def between_samples(record: Record) -> bool:
    """Tell whether the command switched between samples, on a clock of its own."""
    return bool(_jumps(record)[0].size >= 4)


def _jumps(record: Record) -> tuple[Integers, Array]:
    """Return intervals in which a two-level command switched, and after what part of each."""
    v = record.voltage
    none = np.zeros(0, dtype=np.int64), np.zeros(0)
    if len(v) < 6:
        return none
    k = np.flatnonzero(np.abs(v[3:-1] - v[1:-3]) > 0.2 * np.ptp(v)) + 2
    jump = np.abs(v[k + 1] - v[k - 1])
    inside = (v[k] - v[k - 1]) * (v[k + 1] - v[k]) > 0
    steady = np.maximum(np.abs(v[k - 1] - v[k - 2]), np.abs(v[k + 2] - v[k + 1])) < 0.1 * jump
    k = k[inside & steady]
    starts = np.array(record.starts)
    k = k[~np.isin(k, starts) & ~np.isin(k - 1, starts) & ~np.isin(k + 1, starts)]
    before = (v[k + 1] - v[k]) / (v[k + 1] - v[k - 1])
    # A level that wanders a little before it jumps at a sample has not jumped before.
    truly = (before > EDGE) & (before < 1 - EDGE)
    return (k[truly], before[truly]) if truly.any() else none


def _trend(v: Array) -> Array:
    """Return by how much a smooth command changes per sample, 0 where it is not smooth."""
    d = np.diff(v)
    back, ahead = np.concatenate([[0.0], d]), np.concatenate([d, [0.0]])
    mean = 0.5 * (back + ahead)
    limit = 2 * np.minimum(np.abs(back), np.abs(ahead))
    same = back * ahead > 0
    return np.where(same, np.sign(mean) * np.minimum(np.abs(mean), limit), 0.0)
