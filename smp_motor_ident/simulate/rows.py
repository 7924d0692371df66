# SPDX-License-Identifier: Apache-2.0
"""Rows of records for the simulation: instants, segments and pieces of constant input."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from smp_motor_control.arrays import Array, Integers, Places
from smp_motor_ident._compile import compiled

MAX_CACHED_CUTS = 4
MAX_LENGTH_GROUPS = 48  # of pieces whose transitions are tabulated
LENGTH_TOLERANCE = 1e-9  # relative, of equal lengths
MIN_PERIOD_LIKENESS = 0.99  # correlation of a command with itself a period later
MAX_VARIED_LIKENESS = 0.9  # correlation of a command that varies within a period


@dataclass(frozen=True, eq=False)
class Pieces:
    """Intervals of constant input, row by row; see `simulate.kernel.simulate_rows`.

    Places are unsigned: compiled code need not ask whether they count from the end.
    """

    first: Integers  # shape (n + 1,)
    length: Array
    edges: Integers
    row: Places
    group: Places  # beyond the groups where its transition is not tabulated
    section: Places
    grouped: Array  # shape (groups,): length of each group [s]
    grouped_edges: Integers


@dataclass(frozen=True, eq=False)
class Rows:
    """Instants of records, one after the other, and the command between them.

    A section is an interval of constant command; it acts until the next one of its segment begins.
    """

    time: Array  # shape (n,), [s]: increasing within a segment
    segment: Integers  # shape (g + 1,): first row of every segment, and n
    begin: Array  # shape (s,), [s]: when each section begins; ignored of the first of a segment
    command: Array  # shape (s,), [V]
    section: Integers  # shape (g + 1,): first section of every segment, and s
    _cache: dict[tuple[float, float, bool], Pieces] = field(default_factory=dict)

    @classmethod
    def held(cls, time: Array, voltage: Array, segment: Integers) -> Rows:
        """Return rows whose voltage was held over the interval that ends at each of them."""
        return cls(time, segment, np.concatenate([[0.0], time[:-1]]), voltage, segment)

    def __len__(self) -> int:
        """Return the number of rows."""
        return int(self.time.size)

    @cached_property
    def plain(self) -> bool:
        """Whether every row is one section."""
        same = self.begin.size == self.time.size and np.array_equal(self.section, self.segment)
        return bool(same and np.array_equal(self.begin[1:], self.time[:-1]))

    @cached_property
    def interval(self) -> Array:
        """Interval that ends at each row [s]; 0 at the first of a segment."""
        gone = np.diff(self.time, prepend=self.time[0])
        gone[self.segment[:-1]] = 0.0
        return gone

    @cached_property
    def step(self) -> float:
        """Median interval between rows [s]."""
        return float(np.median(self.interval[self.interval > 0]))

    @cached_property
    def age(self) -> Array:
        """Share of all time that has passed at every row, from 0 to 1."""
        gone = np.cumsum(self.interval)
        return gone / (gone[-1] or 1.0)

    @cached_property
    def mean_command(self) -> Array:
        """Mean command over the interval that ends at each row [V]."""
        pieces = self.pieces(0.0)
        put = pieces.length * self.command[pieces.section]
        total = np.add.reduceat(put, pieces.first[:-1])
        some = self.interval > 0
        last = self.command[pieces.section[pieces.first[1:] - 1]]
        return np.where(some, total / np.where(some, self.interval, 1.0), last)

    @cached_property
    def is_periodic(self) -> bool:
        """Whether the command varies and repeats itself row by row."""
        n, u = len(self), self.mean_command
        lags = np.arange(1, n // 2)
        length = 2 ** (2 * n).bit_length()
        product = np.fft.irfft(np.abs(np.fft.rfft(u, length)) ** 2, length)[lags]
        power = np.cumsum(u**2)
        norm = np.sqrt(power[n - 1 - lags] * (power[-1] - power[lags - 1]))
        likeness = product / np.maximum(norm, 1e-300)
        varies = np.maximum.accumulate(likeness < MAX_VARIED_LIKENESS)
        return bool((varies & (likeness > MIN_PERIOD_LIKENESS)).any())

    def pieces(self, delay: float, longest: float = np.inf, moving: bool = False) -> Pieces:
        """Cut the rows where a command that acts ``delay`` [s] late switches.

        ``longest``: length [s] of a piece at most.  ``moving``: whether delays differ by lane.
        """
        key = delay, longest, moving
        if key not in self._cache:
            if len(self._cache) >= MAX_CACHED_CUTS:
                self._cache.pop(next(iter(self._cache)))
            self._cache[key] = self._pieces(delay, longest, moving)
        return self._cache[key]

    def _pieces(self, delay: float, longest: float, moving: bool) -> Pieces:
        n = len(self)
        cut = not self.plain or delay != 0.0 or moving
        section, length, edges, count = self._cut(delay, moving) if cut else self._uncut()
        if np.isfinite(longest):
            parts = np.maximum(np.ceil(length / longest - LENGTH_TOLERANCE), 1).astype(np.int64)
            if parts.max() > 1:
                row = np.repeat(np.repeat(np.arange(n), count), parts)
                # The shift of a lane belongs to the part next to the switch.
                end = np.cumsum(parts)
                whole, edges = edges, np.zeros(row.size, dtype=np.int64)
                edges[np.where(whole > 0, end - 1, end - parts)] = whole
                section, length = np.repeat(section, parts), np.repeat(length / parts, parts)
                count = np.bincount(row, minlength=n)
        first = np.concatenate([[0], np.cumsum(count)])
        group, of = _group_pieces(length, edges, 10 * LENGTH_TOLERANCE * self.step)
        row = np.repeat(np.arange(n, dtype=np.uint32), count)
        places = section.astype(np.uint32)
        return Pieces(first, length, edges, row, group, places, length[of], edges[of])

    def _uncut(self) -> tuple[Integers, Array, Integers, Integers]:
        """Return what `_cut` does where every row is one section."""
        n = len(self)
        return np.arange(n), self.interval, np.zeros(n, np.int64), np.ones(n, np.int64)

    def _cut(self, delay: float, moving: bool) -> tuple[Integers, Array, Integers, Integers]:
        """Return section, length and edges of every piece, and the pieces of every row."""
        most = len(self) + self.begin.size
        section, length = np.empty(most, dtype=np.int64), np.empty(most)
        edges, count = np.empty(most, dtype=np.int64), np.empty(len(self), dtype=np.int64)
        pieces = _cut_rows(
            self.time, self.interval, self.segment, self.begin, self.section, delay, moving,
            section, length, edges, count,
        )  # fmt: skip
        return section[:pieces], length[:pieces], edges[:pieces], count


@compiled
def _cut_rows(
    time: Array, interval: Array, segment: Integers, begin: Array, first_section: Integers,
    delay: float, moving: bool, section: Integers, length: Array, edges: Integers,
    count: Integers,
) -> int:  # fmt: skip
    """Fill in section, length and edges of every piece, and the pieces of every row."""
    made = 0
    for g in range(segment.shape[0] - 1):
        at = first_section[g]  # of the command that acts
        for row in range(segment[g], segment[g + 1]):
            gone = time[row] - interval[row]
            slack = LENGTH_TOLERANCE * interval[row]  # a switch at a row belongs to the next
            begun = gone - slack if moving else gone + slack  # a later one delays it into the row
            while at + 1 < first_section[g + 1] and begin[at + 1] + delay < begun:
                at += 1
            before = made
            while (
                row > segment[g]
                and at + 1 < first_section[g + 1]
                and begin[at + 1] + delay < time[row] - slack
            ):
                switch = begin[at + 1] + delay
                section[made], length[made] = at, max(switch - gone, 0.0)
                edges[made] = 1 if made == before else 0
                gone, at, made = switch, at + 1, made + 1
            section[made], length[made] = at, max(time[row] - gone, 0.0)
            edges[made] = 0 if made == before else -1
            made += 1
            count[row] = made - before
    return made


@compiled
def _group_pieces(length: Array, edges: Integers, quantum: float) -> tuple[Places, Integers]:
    """Return the group of every piece, and the first piece of every group."""
    group = np.full(length.size, MAX_LENGTH_GROUPS, dtype=np.uint32)
    kinds, first = np.empty(MAX_LENGTH_GROUPS), np.empty(MAX_LENGTH_GROUPS, dtype=np.int64)
    made = 0
    for j in range(length.size):
        kind = 4.0 * np.rint(length[j] / quantum) + edges[j]
        g = 0
        while g < made and kinds[g] != kind:
            g += 1
        if g == MAX_LENGTH_GROUPS:
            continue
        if g == made:
            kinds[g], first[g] = kind, j
            made += 1
        group[j] = g
    return group, first[:made]
