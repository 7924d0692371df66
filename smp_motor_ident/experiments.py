"""Records made ready for the recursion: one output, its kind, the input as it was held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident import recursion as rc
from smp_motor_ident.record import Record

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Experiments:
    """Arrays as `recursion.run` takes them.

    Attributes
    ----------
    time, output, current : ndarray
        As in `recursion.run`; ``current`` of shape (0,) where there is none.
    starts : ndarray of int, shape (g + 1,)
        Segment boundaries.
    section_end, section_value, section_start : ndarray
        The input.
    kind : int
        SPEED, ANGLE or MEAN_SPEED.
    step : float
        Median sampling interval [s].
    quantum : float
        Resolution of the output [rad or rad/s]; 0 where it has none.
    initial : ndarray, shape (g, 4)
        First guess of q (0), speed, angle and load of each segment.
    """

    time: Array
    output: Array
    current: Array
    starts: Integers
    section_end: Array
    section_value: Array
    section_start: Integers
    kind: int
    step: float
    quantum: float
    initial: Array

    @property
    def size(self) -> int:
        """Number of samples."""
        return int(self.time.size)

    def as_mean_speed(self) -> Experiments:
        """Return the same experiments, the speed taken for a mean over a trailing window."""
        return replace(self, kind=rc.MEAN_SPEED)

    def head(self, duration: float) -> Experiments:
        """Return the first ``duration`` seconds (of all segments together, in order).

        Parameters
        ----------
        duration : float
            [s].

        Returns
        -------
        Experiments
            Views of the same arrays.
        """
        left = duration
        for g in range(len(self.starts) - 1):
            a, b = int(self.starts[g]), int(self.starts[g + 1])
            span = self.time[b - 1] - self.time[a]
            if span >= left:
                end = a + int(np.searchsorted(self.time[a:b], self.time[a] + left)) + 1
                end = min(max(end, a + 2), b)
                return self._cut(g + 1, end)
            left -= span
        return self

    def _cut(self, segments: int, end: int) -> Experiments:
        starts = self.starts[: segments + 1].copy()
        starts[-1] = end
        return Experiments(
            self.time[:end],
            self.output[:end],
            self.current[:end],
            starts,
            self.section_end,
            self.section_value,
            self.section_start[: segments + 1],
            self.kind,
            self.step,
            self.quantum,
            self.initial[:segments],
        )


def output_of(record: Record, kind: str = "auto") -> tuple[Array, int, float]:
    """Choose the mechanical output of a record: counts before angle before speed.

    Parameters
    ----------
    record : Record
        One motor's signals.
    kind : {'auto', 'speed', 'angle'}
        Force one.

    Returns
    -------
    output : ndarray, shape (n,)
        [rad] or [rad/s].
    kind : int
        ANGLE, SPEED or MEAN_SPEED.
    quantum : float
        Its resolution.
    """
    per_turn = record.hardware.counts_per_revolution
    if kind != "speed":
        if record.count is not None and per_turn:
            quantum = 2 * np.pi / per_turn
            return (record.count - record.count[0]) * quantum, rc.ANGLE, quantum
        if record.position is not None and np.isfinite(record.position).sum() > 2:
            first = record.position[np.isfinite(record.position)][0]
            return record.position - first, rc.ANGLE, 0.0
    if record.velocity is None:
        raise ValueError("record has no velocity")
    window = record.velocity_window
    return record.velocity, rc.MEAN_SPEED if window > 0 else rc.SPEED, 0.0


def prepare(records: Sequence[Record], use_current: bool, kind: str = "auto") -> Experiments:
    """Put records one after the other; segments keep their own state.

    Parameters
    ----------
    records : sequence of Record
        Of one motor.
    use_current : bool
        Whether current is an output.
    kind : {'auto', 'speed', 'angle'}
        Which mechanical output.

    Returns
    -------
    Experiments
        Views where there is one record whose input needs no splitting.
    """
    outputs = [output_of(r, kind) for r in records]
    if len({k for _, k, _ in outputs}) > 1:
        outputs = [output_of(r, "speed") for r in records]
    starts, ends, values, section_start = [], [], [], []
    offset = sections = 0
    for record in records:
        end, value, index = _sections(record)
        starts += [offset + s for s in record.starts]
        section_start += [sections + int(index[s]) for s in record.starts]
        ends.append(end)
        values.append(value)
        offset += len(record)
        sections += len(end)
    starts.append(offset)
    section_start.append(sections)
    time = _join([r.time for r in records])
    output = _join([o for o, _, _ in outputs])
    current = (
        _join([r.current if r.current is not None else np.full(len(r), np.nan) for r in records])
        if use_current
        else np.zeros(0)
    )
    bounds = np.array(starts, dtype=np.int64)
    steps = np.concatenate([np.diff(r.time[:200_000]) for r in records])
    return Experiments(
        time,
        output,
        current,
        bounds,
        _join(ends),
        _join(values),
        np.array(section_start, dtype=np.int64),
        outputs[0][1],
        float(np.median(steps)),
        outputs[0][2],
        _initial(time, output, bounds, outputs[0][1]),
    )


def _join(arrays: Sequence[Array]) -> Array:
    return np.ascontiguousarray(arrays[0]) if len(arrays) == 1 else np.concatenate(arrays)


def _sections(record: Record) -> tuple[Array, Array, Integers]:
    """Return the held input, with a single switch inside an interval put where it was.

    ``voltage[k]`` is a mean.  Where the intervals before and after are steady and differ,
    the mean between tells the instant at which a two-level command switched.
    """
    v, t = record.voltage, record.time
    index = np.arange(len(v), dtype=np.int64)
    if len(v) < 6:
        return t, v, index
    jump = v[3:-1] - v[1:-3]
    inside = (v[2:-2] - v[1:-3]) * (v[3:-1] - v[2:-2]) > 0
    steady = np.maximum(np.abs(v[1:-3] - v[:-4]), np.abs(v[4:] - v[3:-1])) < 0.1 * np.abs(jump)
    k = np.flatnonzero(inside & steady) + 2
    if k.size == 0:
        return t, v, index
    k = k[~np.isin(k, np.array(record.starts)) & ~np.isin(k + 1, np.array(record.starts))]
    before = (v[k + 1] - v[k]) / (v[k + 1] - v[k - 1])
    switch = t[k - 1] + before * (t[k] - t[k - 1])
    value = v.copy()
    value[k] = v[k + 1]
    end = np.insert(t, k, switch)
    value = np.insert(value, k, v[k - 1])
    shift = np.zeros(len(v), dtype=np.int64)
    shift[k] = 1
    return end, value, index + np.cumsum(shift)


def _initial(time: Array, output: Array, starts: Integers, kind: int) -> Array:
    initial = np.zeros((len(starts) - 1, 4))
    for g in range(len(starts) - 1):
        a, b = int(starts[g]), int(min(starts[g + 1], starts[g] + 6))
        y, t = output[a:b], time[a:b]
        ok = np.isfinite(y)
        if not ok.any():
            continue
        y, t = y[ok], t[ok]
        if kind == rc.ANGLE:
            initial[g, 2] = y[0]
            if y.size > 1 and y.max() != y.min():
                initial[g, 1] = (y[1] - y[0]) / (t[1] - t[0])
        else:
            initial[g, 1] = y[0]
    return initial
