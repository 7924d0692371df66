# SPDX-License-Identifier: Apache-2.0
"""Records made ready for a fit: rows, outputs and where their segments begin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from smp_motor_control.arrays import Array, Flags, Integers
from smp_motor_ident.chain.component import Scales
from smp_motor_ident.fit.noise import find_runs
from smp_motor_ident.quality.resolution import (
    MIN_ENCODER_STEP,
    MIN_SENSOR_STEP_SHARE,
    mark_repeats,
    select_angle,
    speed_quantum,
)
from smp_motor_ident.quality.standstill import detect_rest_at_start
from smp_motor_ident.record import Record
from smp_motor_ident.simulate.rows import Rows

MIN_SEARCH_ROWS = 4000  # of the search; the chain is then fitted to all rows
MAX_MERGED_COMMAND_DIFFERENCE = 0.01  # over the largest, up to which thinning merges commands


@dataclass(frozen=True, eq=False)
class Data:
    """Recorded signals at the motor shaft."""

    rows: Rows
    motion: Array  # shape (n,): angle [rad] or speed [rad/s]; NaN where lost
    is_angle: bool
    quantum: float  # resolution of ``motion``, 0 where it has none
    current: Array | None  # shape (n,), [A]; NaN where lost
    initial: Array  # shape (segments, 4): first guess of q, speed, angle, and 0
    starts_at_rest: Flags  # shape (segments,): whether it begins at standstill
    full_duty: float
    sample: float  # interval between rows as recorded [s]
    huber: float = np.inf  # bound of a robust loss, in standard deviations

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.rows)

    @cached_property
    def outputs(self) -> tuple[Array, ...]:
        """Motion and, where it was recorded, current."""
        return (self.motion,) if self.current is None else (self.motion, self.current)

    @cached_property
    def known(self) -> tuple[Integers, ...]:
        """Measured rows of every output."""
        return tuple(np.flatnonzero(np.isfinite(y)) for y in self.outputs)

    @cached_property
    def row(self) -> Integers:
        """Row of every measured value, one output after the other."""
        return np.concatenate(self.known)

    @cached_property
    def output(self) -> Integers:
        """Place of the output of every measured value."""
        return np.repeat(np.arange(len(self.known)), [k.size for k in self.known])

    @cached_property
    def bounds(self) -> Integers:
        """First and end of segments among the values, shape (segments, outputs, 2)."""
        ends, offset = [], 0
        for known in self.known:
            ends.append(offset + np.searchsorted(known, self.rows.segment))
            offset += known.size
        at = np.array(ends)
        return np.stack([at[:, :-1].T, at[:, 1:].T], axis=2)

    @cached_property
    def runs(self) -> tuple[Integers, ...]:
        """Runs of measured rows without a gap: first and end, as places in `known`."""
        return tuple(find_runs(rows, self.rows.segment, 1) for rows in self.known)

    @cached_property
    def whole_runs(self) -> tuple[Integers, ...]:
        """Runs of measured rows, across gaps."""
        return tuple(find_runs(rows, self.rows.segment, len(self)) for rows in self.known)

    @cached_property
    def volts(self) -> float:
        """Largest command [V]."""
        return float(np.abs(self.rows.command).max(initial=0.0)) or 1.0

    @cached_property
    def speed(self) -> Array:
        """Speed [rad/s] as the output shows it: of an angle since the row measured before."""
        if not self.is_angle:
            return self.motion
        speed = np.full(len(self), np.nan)
        for first, end in self.whole_runs[0]:
            at = self.known[0][first:end]
            speed[at[1:]] = np.diff(self.motion[at]) / np.diff(self.rows.time[at])
        return speed

    def thin(self, min_rows: int) -> Data:
        """Keep ``min_rows`` to twice as many rows, evenly spaced, and the whole command."""
        every = len(self) // min_rows
        if every <= 1:
            return self
        rows = self.rows
        kept = [
            a + _thin_rows(np.isfinite(self.motion[a:b]), every) for a, b in pairwise(rows.segment)
        ]
        index = np.concatenate(kept)
        segment = np.concatenate([[0], np.cumsum([k.size for k in kept])])
        # Sections of about equal command are one, of their mean: 1, 1, 2, 4 ... before each row,
        # so that a current that follows fast keeps the latest command.
        before = [2**k for k in range((every - 1).bit_length())]
        ends = np.unique(np.maximum(index[:, None] - [0, *before], 0))
        same = np.zeros(rows.command.size, dtype=np.bool_)
        same[1:] = np.abs(np.diff(rows.command)) <= MAX_MERGED_COMMAND_DIFFERENCE * self.volts
        same[rows.section[:-1]] = False
        same &= ~np.isin(rows.begin, rows.time[ends])
        at = np.flatnonzero(~same)
        section = np.searchsorted(at, rows.section)
        length = np.maximum(np.diff(rows.begin, append=rows.time[-1]), 1e-12)
        length[rows.section[:-1]] = length[rows.section[1:] - 1] = rows.step
        command = np.add.reduceat(rows.command * length, at) / np.add.reduceat(length, at)
        thin = Rows(rows.time[index], segment, rows.begin[at], command, section)
        current = None if self.current is None else self.current[index]
        return replace(self, rows=thin, motion=self.motion[index], current=current)

    def scales(self, lag: float) -> Scales:
        """Return the sizes of the recording for a motor of a time constant [s]."""
        speed = np.abs(self.speed[np.isfinite(self.speed)])
        top = float(np.quantile(speed, 0.98)) if speed.size else 1.0
        current = self.current
        amperes = 1.0 if current is None else float(np.nanmax(np.abs(current), initial=0.0)) or 1.0
        duration = float(self.rows.interval.sum())
        return Scales(
            self.volts, max(self.full_duty, self.volts), self.rows.step, top or 1.0, duration, lag,
            amperes, self.sample,
        )  # fmt: skip


def _thin_rows(known: Flags, every: int) -> Integers:
    """Return one row of each ``every``, the first measured one if there is any."""
    row = np.arange(0, known.size, every)
    padded = np.zeros(row.size * every, dtype=np.bool_)
    padded[: known.size] = known
    first: Integers = row + padded.reshape(row.size, every).argmax(axis=1)
    first[0] = 0
    return first


def prepare(records: Sequence[Record], use_current: bool, huber: float = np.inf) -> Data:
    """Concatenate records; each segment keeps its own initial state."""
    angles = [select_angle(r) for r in records]
    is_angle = all(one is not None for one in angles)
    rng = np.random.default_rng(0)
    motions, quantum = [], 0.0
    for record, angle in zip(records, angles, strict=True):
        if is_angle:
            assert angle is not None
            motion, quantum = angle
            if quantum > 0 and np.isfinite(motion).all():
                count = np.rint(motion / quantum).astype(np.int64)
                motion = np.where(mark_repeats(count, record.starts), np.nan, motion)
        else:
            assert record.velocity is not None
            motion, quantum = record.velocity, speed_quantum(record.velocity)
        motions.append(motion if quantum else dither(motion, is_angle, rng))
    lengths = np.cumsum([0, *(len(r) for r in records)])
    starts = [n + s for n, r in zip(lengths, records) for s in r.starts]
    segment = np.array([*starts, lengths[-1]], dtype=np.int64)
    time = np.concatenate([r.time for r in records])
    voltage = np.concatenate([r.voltage for r in records])
    motion = np.concatenate(motions)
    at_rest = detect_rest_at_start(time, motion, voltage, segment, is_angle, quantum)
    begun = voltage.copy()
    begun[segment[:-1][at_rest]] = 0.0
    current = None
    if use_current:
        every = [np.full(len(r), np.nan) if r.current is None else r.current for r in records]
        current = np.concatenate([dither(i, False, rng) for i in every])
    initial = _guess_initial_states(time, motion, segment, is_angle)
    initial[at_rest, 1] = 0.0
    supply = max(r.hardware.supply_voltage or 0.0 for r in records)
    rows = Rows.held(time, begun, segment)
    return Data(
        rows, motion, is_angle, quantum, current, initial, at_rest, supply, rows.step, huber
    )


def _guess_initial_states(time: Array, motion: Array, segment: Integers, is_angle: bool) -> Array:
    """Return a first guess of q, speed, angle and load at the beginning of every segment."""
    initial = np.zeros((segment.size - 1, 4))
    for g, (a, b) in enumerate(pairwise(segment)):
        y, t = motion[a : min(b, a + 6)], time[a : min(b, a + 6)]
        y, t = y[np.isfinite(y)], t[np.isfinite(y)]
        if not y.size:
            continue
        if not is_angle:
            initial[g, 1] = y[0]
            continue
        initial[g, 2] = y[0]
        moved = int(np.argmax(y != y[0]))  # one that stands may be held by friction
        if moved:
            initial[g, 1] = (y[moved] - y[0]) / (t[moved] - t[0])
    return initial


def dither(values: Array, is_angle: bool, rng: np.random.Generator) -> Array:
    """Add the rounding of the finest real sensor to a signal.

    A simulator's noise-free signal would otherwise have unbounded weight relative to the others.
    """
    known = values[np.isfinite(values)]
    extent = float(np.ptp(known)) if known.size else 0.0
    step = MIN_ENCODER_STEP if is_angle else MIN_SENSOR_STEP_SHARE * extent
    return np.asarray(values + step * rng.uniform(-0.5, 0.5, values.size))
