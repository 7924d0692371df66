"""Tables whose clock starts again: runs written one below another, or a logger that was reset."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_control.arrays import Integers
from smp_motor_ident.bag.clock import rhythm
from smp_motor_ident.bag.limits import SET_BACK
from smp_motor_ident.bag.storage import Table, found
from smp_motor_ident.errors import BagError

Parts = list[tuple[int, int]]

_ROWS = round(SET_BACK.value)
_BEFORE = 1000
"""Rows before that are looked at in any case; all since the last fall, so that many cost little."""
_SECOND = 1_000_000_000


def runs(time: NDArray[Any], columns: Mapping[str, NDArray[Any]]) -> Parts:
    """Split a table's rows, in the order in which they were written, where its clock starts again.

    It does where the time goes back by more than jitter, the rows go on from there, and they cover
    again what the rows before have covered.  Single rows out of order, a block that was
    flushed late and rows that are there twice are no new run; they are sorted.
    """
    parts = _parts(time, columns)
    if len(parts) > 1 and columns:
        there = [np.isfinite(column) for column in columns.values()]
        if np.mean(np.all(there, axis=0)) < 0.5:  # rows of several kinds, written in turn
            alone = [_parts(time[rows], {}) for rows in there]
            if all(len(own) == 1 for own in alone):
                return [(0, time.size)]
    return parts


def _parts(time: NDArray[Any], columns: Mapping[str, NDArray[Any]]) -> Parts:
    steps = np.abs(np.diff(time))
    moved = steps[steps > 0]
    if not moved.size:
        return [(0, time.size)]
    back = np.flatnonzero(np.diff(time) < -SET_BACK.value * np.median(moved)) + 1
    if back.size * 2 * _ROWS > time.size:  # shuffled, not restarted
        return [(0, time.size)]
    # Not a single row that came early or late: most rows that follow are earlier than those before
    falls = [
        k
        for k in back.tolist()
        if np.median(time[k : k + _ROWS]) < np.median(time[max(0, k - _ROWS) : k])
    ]
    edges, fell = [0], 0
    for k, end in pairwise([*falls, time.size]):
        begin = max(edges[-1], min(fell, k - _BEFORE))
        if _covers_again(time, columns, slice(begin, k), slice(k, end)):
            edges.append(k)
        fell = k
    return list(pairwise([*edges, time.size]))


def _covers_again(
    time: NDArray[Any], columns: Mapping[str, NDArray[Any]], old: slice, new: slice
) -> bool:
    """Return whether rows lie among earlier ones, as sampled anew and not as written late."""
    earlier, later = np.sort(time[old]), time[new]
    inside = later[(later >= earlier[0]) & (later <= earlier[-1])]
    holes = np.unique(np.searchsorted(earlier, inside, "right"))
    # A block that came late fills one hole, a few late rows one each; a last run may be short.
    least = _ROWS if later.size > 2 * _ROWS else max(1, min(_ROWS, inside.size - 1))
    if holes.size <= least:
        return False
    _, first, second = np.intersect1d(time[old], later, return_indices=True)
    twice = bool(columns) and all(
        np.array_equal(column[old][first], column[new][second], equal_nan=column.dtype.kind == "f")
        for column in columns.values()
    )
    return not (twice and first.size >= 0.5 * inside.size)


def one_after_another(
    times: Sequence[Integers], parts: Sequence[Parts], pauses: Sequence[int]
) -> list[Integers]:
    """Return times [ns] on one clock that runs on, with a pause before each part but the first.

    Those of several tables keep what they are apart within each part.
    """
    moved = [time.copy() for time in times]
    for k, pause in enumerate(pauses, 1):
        last = max(int(m[: part[k][0]].max()) for m, part in zip(moved, parts))
        first = min(int(t[slice(*part[k])].min()) for t, part in zip(times, parts))
        for m, part in zip(moved, parts):
            m[slice(*part[k])] += last + pause - first
    return moved


def pause_between(time: Integers, parts: Parts, gap: float) -> int:
    """Return a time [ns] that surely begins a new segment; ``gap`` [s] is what the user asked."""
    longest = max(parts, key=lambda part: part[1] - part[0])
    usual = rhythm(np.sort(time[slice(*longest)])).gap()
    return 3 * round(max(usual, gap * _SECOND)) + _SECOND


def laid_out(tables: Mapping[str, Table], gap: float, where: str) -> dict[str, Table]:
    """Return tables of one clock with their runs one after another; BagError where they differ."""
    every = {topic: runs(table.logged, table.columns) for topic, table in tables.items()}
    numbers = {topic: len(parts) - 1 for topic, parts in every.items()}
    if not any(numbers.values()):
        return dict(tables)
    if len(set(numbers.values())) > 1:
        times_in = ", ".join(f"{number} times in {topic}" for topic, number in numbers.items())
        raise BagError(
            f"{where}: the time goes back {times_in}, and which run belongs to which is not known; "
            "give each run files of its own"
        )
    times = [table.logged for table in tables.values()]
    pause = max(pause_between(t, parts, gap) for t, parts in zip(times, every.values()))
    count = next(iter(numbers.values()))
    moved = one_after_another(times, list(every.values()), [pause] * count)
    text = f"{where}: the time starts again {count} times, as of runs written one below another"
    warning = found("clock_set_back", f"{text}; a new segment each", "warning", times=count)
    return {
        topic: replace(table, log=time, findings=[*table.findings, warning])
        for (topic, table), time in zip(tables.items(), moved)
    }
