# SPDX-License-Identifier: Apache-2.0
"""Determine clocks, order and gaps of samples; average held inputs over intervals."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.bag.mapping import Signal
from smp_motor_ident.bag.storage import Table, note
from smp_motor_ident.bag.units import UNITS
from smp_motor_ident.errors import BagError
from smp_motor_ident.limits import MIN_CLOCK_LEAP_S, MIN_RESTART_ROWS

Parts = list[tuple[int, int]]
"""Begin and end of runs of rows."""

MISSING_TIME = -(2**62)  # time of a row without one

_RUN_ROWS = round(MIN_RESTART_ROWS)
_MIN_EARLIER_ROWS = 1000  # smallest number of earlier rows examined

_SECOND_NS = 1_000_000_000
BEAT_SAMPLES = 32  # samples that determine a beat
MAX_CLOCK_OFFSET_NS = 50_000_000
"""Topics whose offsets differ by less [ns] share a clock; latency explains the difference."""

MIN_SET_CLOCK_NS = 1_000_000_000_000_000_000
"""Smallest time [ns] of a clock that was set, in 2001; smaller ones count from some start."""


def find_first_time(logs: Iterable[Integers]) -> float | None:
    """Return the first log time of a clock that was set [s since 1970], or None."""
    dated = [log[log >= MIN_SET_CLOCK_NS] for log in logs]
    first = [int(log.min()) for log in dated if log.size]
    return 1e-9 * min(first) if first else None


def nanoseconds(column: NDArray[Any], signal: Signal, unit: str) -> Integers:
    """Return a column of times [ns], `MISSING_TIME` for missing cells; the default unit is seconds.

    Integers stay integers, since a float cannot hold nanoseconds since 1970 exactly.
    """
    second = UNITS["time"][unit or "s"].factor * 1e9
    factor, offset = second * signal.scale, second * signal.offset
    if column.dtype.kind in "iu" and factor == round(factor):
        return column.astype(np.int64) * round(factor) + round(offset)
    values = column.astype(np.float64) * factor + offset
    sound = np.isfinite(values) & (np.abs(values) < -float(MISSING_TIME))
    time = np.full(values.size, MISSING_TIME, np.int64)
    time[sound] = np.rint(values[sound]).astype(np.int64)
    return time


@dataclass(frozen=True)
class ClockFit:
    """Conversion from stamps to log times: ``log = stamp + offset + drift (stamp - origin)``."""

    offset: float  # [ns] at ``origin``, including the latency of the fastest messages
    drift: float  # seconds per second
    origin: int  # stamp [ns]

    def to_log(self, stamp: Integers) -> Integers:
        """Return stamps on the recorder's clock."""
        since = (stamp - self.origin).astype(np.float64)
        shift = np.rint(self.offset + self.drift * since).astype(np.int64)
        return stamp + shift


def fit_clock(stamp: Integers, log: Integers) -> ClockFit:
    """Fit offset and drift between header stamps and log times.

    A message is logged some latency after its stamp, and latency is never negative and has
    a tail: the line goes through the fastest messages of each part of the recording.
    """
    origin = int(np.min(stamp))
    since = (stamp - origin).astype(np.float64)
    base = int(np.min(log - stamp))
    late = (log - stamp - base).astype(np.float64)
    span = float(since.max())
    if span < 10 * _SECOND_NS or stamp.size < 200:
        return ClockFit(float(base), 0.0, origin)
    part = np.minimum((since * (20 / span)).astype(np.int8), 19)
    parts = [inside for k in range(20) if (inside := np.flatnonzero(part == k)).size]
    drift = offset = 0.0
    for _ in range(3):  # neglect the drift within a part
        rest = late - drift * since
        best = np.array([inside[np.argmin(rest[inside])] for inside in parts])
        drift, offset = np.polyfit(since[best], late[best], 1).tolist()
    return ClockFit(base + offset, drift, origin)


def judge_stamps(stamp: Integers | None, log: Integers) -> str:
    """Return why header stamps are not the times of the samples; empty if they are usable."""
    if stamp is None:
        return "the messages carry no stamp"
    if stamp.size < 2:
        return ""
    set_ones = stamp[stamp > 0]
    if set_ones.size < 0.5 * stamp.size:
        return "the header stamps are not set"
    distinct = np.unique(set_ones).size
    if distinct < 0.5 * np.unique(log).size and distinct < 0.5 * set_ones.size:
        return f"the header stamps repeat ({distinct} values in {stamp.size} messages)"
    return ""


def split_at_resets(time: Integers) -> Parts:
    """Split samples, in the order of logging, where their clock was set back.

    Only long runs, each in order, are parts; single samples out of order and shuffled samples do
    not split a recording.
    """
    whole = [(0, time.size)]
    if time.size < 40:
        return whole
    steps = np.diff(time)
    usual = float(np.median(np.abs(steps)))
    back = np.flatnonzero(steps < -max(100 * usual, 0.5 * _SECOND_NS)) + 1
    if not back.size or back.size > time.size / 40:
        return whole
    edges = [0, *back.tolist(), time.size]
    parts = list(pairwise(edges))
    ordered = all(b - a >= 20 and np.mean(np.diff(time[a:b]) > 0) > 0.9 for a, b in parts)
    return parts if ordered else whole


@dataclass(frozen=True)
class Sampling:
    """Regularity of a sampling interval."""

    interval: float  # median interval, in the unit of the times
    regular: bool  # whether four of five intervals are within a quarter of it

    def missing(self, time: Integers) -> Integers:
        """Return the number of missing samples before each but the first.

        A loss delays all later samples by whole intervals; a single late sample does not.
        """
        steps = np.diff(time)
        number: Integers = np.zeros(steps.size, np.int64)
        if not self.regular or self.interval <= 0:
            return number
        number = np.maximum(np.rint(steps / self.interval).astype(np.int64) - 1, 0)
        late = np.flatnonzero(number)
        behind = (time - time[0]) - self.interval * np.arange(time.size)
        window = np.arange(BEAT_SAMPLES)
        before = np.median(behind[np.maximum(late[:, None] - window, 0)], axis=1)
        after = np.median(behind[np.minimum(late[:, None] + 1 + window, steps.size)], axis=1)
        lasting = np.rint((after - before) / self.interval).astype(np.int64)
        number[late] = np.clip(lasting, 0, number[late])
        return number

    def gap(self, averaged: bool = False) -> float:
        """Return the interval [ns] that separates two segments.

        A log written on change is irregular and holds its voltage for long; an ``averaged``
        voltage leaves open when it changed within a long interval.
        """
        if self.regular or averaged:
            return max(20 * self.interval, 0.02 * _SECOND_NS)
        return max(100 * self.interval, 1.0 * _SECOND_NS)


def measure_sampling(time: Integers | Array) -> Sampling:
    """Return the regularity of sampling."""
    if time.size < 2:
        return Sampling(0.0, False)
    steps = np.diff(time)
    median = float(np.median(steps))
    return Sampling(median, bool(np.mean(np.abs(steps - median) <= 0.25 * median) >= 0.8))


def average_held_input(time: Integers, value: Array, held: str, at: Integers) -> Array:
    """Average a held input over the intervals between output samples."""
    origin = int(time[0])
    seconds = (time - origin) * 1e-9
    wanted = (at - origin) * 1e-9
    level = value[:-1] if held == "after" else value[1:]
    integral = np.concatenate([[0.0], np.cumsum(level * np.diff(seconds))])
    # After its last instant the input keeps its value.
    whole = np.interp(wanted, seconds, integral) + np.maximum(wanted - seconds[-1], 0) * value[-1]
    mean = np.empty(at.size)
    mean[1:] = np.diff(whole) / np.diff(wanted)
    after = held == "after"
    side = int(np.searchsorted(time, at[0], "right" if after else "left")) - after
    mean[0] = value[min(max(side, 0), value.size - 1)]
    # Intervals between outputs without an input instant inside
    first, last = np.searchsorted(time, at[:-1], "right"), np.searchsorted(time, at[1:], "left")
    inside = first >= last
    # An interval without a change has exactly its level.
    index = first - 1 if after else np.minimum(last, value.size - 1)
    mean[1:][inside] = value[np.clip(index, 0, value.size - 1)][inside]
    return mean


def split_into_runs(time: NDArray[Any], columns: Mapping[str, NDArray[Any]]) -> Parts:
    """Split a table's rows, in the order in which they were written, where its clock starts again.

    A run begins where the time goes back by more than jitter, continues from there and overlaps
    the rows before.  Single rows out of order, a block that was flushed late and duplicates
    start no run; they are sorted.
    """
    parts = _split_at_restarts(time, columns)
    if len(parts) > 1 and columns:
        there = [np.isfinite(column) for column in columns.values()]
        if np.mean(np.all(there, axis=0)) < 0.5:  # rows of several kinds, written in turn
            alone = [_split_at_restarts(time[rows], {}) for rows in there]
            if all(len(own) == 1 for own in alone):
                return [(0, time.size)]
    return parts


def _split_at_restarts(time: NDArray[Any], columns: Mapping[str, NDArray[Any]]) -> Parts:
    steps = np.abs(np.diff(time))
    moved = steps[steps > 0]
    if not moved.size:
        return [(0, time.size)]
    back = np.flatnonzero(np.diff(time) < -MIN_RESTART_ROWS * np.median(moved)) + 1
    if back.size * 2 * _RUN_ROWS > time.size:  # shuffled, not restarted
        return [(0, time.size)]
    # After a restart, unlike after one early or late row, most rows are earlier than those before
    falls = [
        k
        for k in back.tolist()
        if np.median(time[k : k + _RUN_ROWS]) < np.median(time[max(0, k - _RUN_ROWS) : k])
    ]
    edges, fell = [0], 0
    for k, end in pairwise([*falls, time.size]):
        begin = max(edges[-1], min(fell, k - _MIN_EARLIER_ROWS))
        if _overlaps(time, columns, slice(begin, k), slice(k, end)):
            edges.append(k)
        fell = k
    return list(pairwise([*edges, time.size]))


def _overlaps(
    time: NDArray[Any], columns: Mapping[str, NDArray[Any]], old: slice, new: slice
) -> bool:
    """Return whether rows overlap earlier ones as a new run, rather than a late block."""
    earlier, later = np.sort(time[old]), time[new]
    inside = later[(later >= earlier[0]) & (later <= earlier[-1])]
    holes = np.unique(np.searchsorted(earlier, inside, "right"))
    # A late block fills one hole, each late row another one; the last run may be short.
    least = _RUN_ROWS if later.size > 2 * _RUN_ROWS else max(1, min(_RUN_ROWS, inside.size - 1))
    if holes.size <= least:
        return False
    _, first, second = np.intersect1d(time[old], later, return_indices=True)
    twice = bool(columns) and all(
        np.array_equal(column[old][first], column[new][second], equal_nan=column.dtype.kind == "f")
        for column in columns.values()
    )
    return not (twice and first.size >= 0.5 * inside.size)


def concatenate_parts(
    times: Sequence[Integers], parts: Sequence[Parts], pauses: Sequence[int]
) -> list[Integers]:
    """Return times [ns] on one continuous clock, with a pause between parts of all tables."""
    moved = [time.copy() for time in times]
    for k, pause in enumerate(pauses, 1):
        last = max(int(m[: part[k][0]].max()) for m, part in zip(moved, parts))
        first = min(int(t[slice(*part[k])].min()) for t, part in zip(times, parts))
        for m, part in zip(moved, parts):
            m[slice(*part[k])] += last + pause - first
    return moved


def remove_leaps(
    times: Mapping[str, Integers], gap: float
) -> tuple[dict[str, Integers], list[float]]:
    """Return times [ns] with forward leaps of the clock removed, and the leaps [s].

    A leap is an interval in which no topic has a sample; a pause that begins a segment replaces it.
    """
    every = np.sort(np.concatenate(list(times.values())))
    steps = np.diff(every.view(np.uint64))  # the farthest two have no signed distance
    last = np.flatnonzero(steps > MIN_CLOCK_LEAP_S * _SECOND_NS)
    if not last.size:
        return dict(times), []
    leaps = steps[last]
    pause = pause_between(every, [*pairwise([0, *(last + 1).tolist(), every.size])], gap)
    shift = np.concatenate([[0], np.cumsum(leaps - np.uint64(pause))]).astype(np.int64)
    moved = {
        topic: time - shift[np.searchsorted(every[last], time)] for topic, time in times.items()
    }
    return moved, (1e-9 * leaps).tolist()


def pause_between(time: Integers, parts: Parts, gap: float) -> int:
    """Return a pause [ns] that begins a new segment; ``gap`` [s] is the user's limit."""
    longest = max(parts, key=lambda part: part[1] - part[0])
    usual = measure_sampling(np.sort(time[slice(*longest)])).gap()
    return 3 * round(max(usual, gap * _SECOND_NS)) + _SECOND_NS


def concatenate_runs(tables: Mapping[str, Table], gap: float, where: str) -> dict[str, Table]:
    """Return tables of one clock with their runs in sequence; BagError if the runs differ."""
    every = {topic: split_into_runs(table.logged, table.columns) for topic, table in tables.items()}
    numbers = {topic: len(parts) - 1 for topic, parts in every.items()}
    if not any(numbers.values()):
        return dict(tables)
    if len(set(numbers.values())) > 1:
        times_in = ", ".join(f"{number} times in {topic}" for topic, number in numbers.items())
        raise BagError(
            f"{where}: the time goes back {times_in}, so the runs of the tables cannot be matched; "
            "give each run files of its own"
        )
    times = [table.logged for table in tables.values()]
    pause = max(pause_between(t, parts, gap) for t, parts in zip(times, every.values()))
    count = next(iter(numbers.values()))
    moved = concatenate_parts(times, list(every.values()), [pause] * count)
    text = f"{where}: the time starts again {count} times, as if runs were appended"
    warning = note("clock_set_back", f"{text}; a new segment at each", "warning", times=count)
    return {
        topic: replace(table, log=time, findings=[*table.findings, warning])
        for (topic, table), time in zip(tables.items(), moved)
    }
