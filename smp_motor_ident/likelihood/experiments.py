"""Records made ready for the recursion: one output, its kind, the input as it was held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from smp_motor_control.arrays import Array, Flags, Integers
from smp_motor_ident.likelihood.hold import held_intervals, rerun
from smp_motor_ident.likelihood.standstill import stands
from smp_motor_ident.model.measurement import ANGLE, MEAN_SPEED, SPEED, Measurement
from smp_motor_ident.record import Record

HELD = 0.1
"""Of the largest voltage, what the friction of a geared motor holds as a rule."""
REST = 10
"""Samples after which an unchanged count is a standstill."""
JITTER = 2_000
"""Samples that tell whether the stamps jitter."""
FINEST_ENCODER = 2 * np.pi / 2**17
"""Resolution [rad] of the encoders of servos, finer than those of any wheel."""
FINEST_SENSOR = 1e-4
"""Of its range: what shunt amplifiers and tachometers are linear to at best."""
FEW = 2_000
"""Samples that tell whether a speed repeats its values."""
MANY = 30
"""Levels of moves that tell a step by being near whole ones on the mean, each off by a part of it
as a log of seven digits makes them: five deviations from chance."""
UNIFORM = 0.25
"""Of a step, what a move of any size is off a whole number of steps on the mean."""


@dataclass(frozen=True, eq=False)
class Experiments:
    """Arrays as `recursion.run` takes them."""

    # time, output, current: as in `recursion.run`; ``current`` of shape (0,) where there is none
    time: Array
    output: Array
    current: Array
    starts: Integers  # shape (g + 1,): segment boundaries
    # hold_end, hold_value, hold_start: the input
    hold_end: Array
    hold_value: Array
    hold_start: Integers
    kind: Measurement  # what the output shows
    step: float  # median sampling interval [s]
    quantum: float  # resolution of the output [rad or rad/s]; 0 where it has none
    # shape (g, 5), of each segment: first guess of q (0), speed, angle, load, and of what the
    # current was more [V] before the segment than at its beginning
    initial: Array
    voltage: Array  # as it was recorded, by the row
    stood: Flags  # shape (g,): segments that begin with a standstill, no voltage before them
    how: str = "before"  # how a row's command ran, as in `Structure.held`
    current_quantum: float = 0.0  # resolution of the current [A]; 0 where it has none

    @property
    def plain(self) -> bool:
        """Whether the input changes at the samples, one value for each."""
        where = [a.__array_interface__["data"][0] for a in (self.hold_end, self.time)]
        return bool(where[0] == where[1])

    @cached_property
    def jittered(self) -> float:
        """The usual interval [s] where the stamps jitter around it, else 0."""
        steps = np.diff(self.time[:JITTER])
        off = np.abs(steps - self.step) > 1e-6 * self.step
        return self.step if np.mean(off) > 0.2 else 0.0

    @property
    def levels(self) -> Array:
        """The command's levels [V]: as it was held, or the rows between which it ran straight."""
        return self.voltage if self.how == "interpolated" else self.hold_value

    @property
    def one_way(self) -> bool:
        """Whether the command drives the motor in one direction only."""
        return not self.hold_value.min() < 0 < self.hold_value.max()

    @cached_property
    def known_initial(self) -> Array:
        """What is known of each segment's initial state beforehand: precisions around zero.

        Over a winding there is no more than the largest voltage and as much of back-EMF, and in
        a motor that stands no more than what its friction holds; a load of a segment's own takes
        no more than that voltage either.  Shape (g, 5).
        """
        known = np.zeros(self.initial.shape)
        largest = max(float(np.abs(self.voltage).max(initial=0.0)), 1e-150)
        known[:, 0] = 1 / np.square(np.where(self.stood, HELD, 2.0) * largest)
        known[:, 3] = 1 / largest**2
        return known

    @property
    def size(self) -> int:
        """Number of samples."""
        return int(self.time.size)

    def held_like(self, other: Experiments) -> bool:
        """Tell whether the input of others was held at the same values for the same times."""
        return np.array_equal(self.hold_end, other.hold_end) and np.array_equal(
            self.hold_value, other.hold_value
        )

    def measured_as(self, speed: Measurement) -> Experiments:
        """Return the same experiments, a recorded speed taken for what a sensor shows of it."""
        return self if self.kind in (ANGLE, speed) else replace(self, kind=speed)

    def held(self, how: str) -> Experiments:
        """Return the same experiments, a row's command taken to run before it (as they are), after
        it, or straight from row to row.
        """
        if how in ("before", self.how):
            return self
        sections, end, value = rerun(self.time, self.voltage, self.starts[:-1], how)
        first = sections * self.starts
        for begin in first[:-1][self.stood]:
            value[begin : begin + sections] = 0.0
        return replace(self, hold_end=end, hold_value=value, hold_start=first, how=how)

    def data_window(self, duration: float) -> Experiments:
        """Return all up to ``duration`` seconds after the first voltage, of all segments together.

        A standstill before the first voltage teaches nothing, so it does not count.
        """
        left = duration + self._lead
        for g in range(len(self.starts) - 1):
            a, b = int(self.starts[g]), int(self.starts[g + 1])
            span = self.time[b - 1] - self.time[a]
            if span >= left:
                end = a + int(np.searchsorted(self.time[a:b], self.time[a] + left)) + 1
                end = min(max(end, a + 2), b)
                return self._cut(g + 1, end)
            left -= span
        return self

    def first(self, samples: int) -> Experiments:
        """Return the first so many samples, of all segments together."""
        if samples >= self.size:
            return self
        return self._cut(int(np.searchsorted(self.starts, samples)), samples)

    @cached_property
    def _lead(self) -> float:
        """Return how long [s] it takes until a twentieth of the largest voltage is exceeded."""
        level = np.abs(self.hold_value)
        first = int(np.argmax(level > 0.05 * level.max()))
        before = 0.0
        for g in range(len(self.starts) - 1):
            begin, last = self.time[self.starts[g]], self.time[self.starts[g + 1] - 1]
            if g + 2 == len(self.starts) or first < self.hold_start[g + 1]:
                return before + max(float(self.hold_end[first] - begin), 0.0)
            before += float(last - begin)
        return before

    def _cut(self, segments: int, end: int) -> Experiments:
        starts = self.starts[: segments + 1].copy()
        starts[-1] = end
        return Experiments(
            self.time[:end],
            self.output[:end],
            self.current[:end],
            starts,
            self.hold_end,
            self.hold_value,
            self.hold_start[: segments + 1],
            self.kind,
            self.step,
            self.quantum,
            self.initial[:segments],
            self.voltage[:end],
            self.stood[:segments],
            self.how,
            self.current_quantum,
        )


def angle_of(record: Record) -> tuple[Array, float] | None:
    """Return a record's angle from its first one [rad] and the step it comes in, if it has one."""
    per_turn = record.hardware.counts_per_revolution
    if record.count is not None and per_turn:
        quantum = 2 * np.pi / per_turn
        return (record.count - record.count[0]) * quantum, quantum
    if record.position is not None and np.isfinite(record.position).sum() > 2:
        angle = record.position - record.position[np.isfinite(record.position)][0]
        return angle, angle_quantum(angle)
    return None


def output_of(record: Record, kind: str = "auto") -> tuple[Array, Measurement, float]:
    """Choose the mechanical output of a record: counts before angle before speed."""
    there = None if kind == "speed" else angle_of(record)
    if there is not None:
        angle, quantum = there
        if quantum > 0 and np.all(np.isfinite(angle)):
            count = np.rint(angle / quantum).astype(np.int64)
            angle[_repeats(count, record.starts)] = np.nan
        return angle, ANGLE, quantum
    if record.velocity is None:
        raise ValueError("record has no velocity")
    mean = MEAN_SPEED if record.velocity_window > 0 else SPEED
    return record.velocity, mean, speed_quantum(record.velocity)


def _repeats(count: Integers, starts: Sequence[int]) -> Flags:
    """Mark what a standing encoder only says again: its error is the same every time.

    Taken for so many independent readings, a standstill would fix the angle far better than
    to the fraction of a count that is unknown.  Of a long run the sample in the middle stays,
    which is late in neither direction, and of one that begins a segment the first.
    """
    first = np.zeros(count.size, dtype=np.bool_)  # of each segment
    first[[0, *starts]] = True
    begins = first.copy()
    begins[1:] |= count[1:] != count[:-1]
    begin = np.flatnonzero(begins)
    length = np.diff(np.append(begin, count.size))
    rests = length >= REST
    if not rests.any():
        return np.zeros(count.size, dtype=np.bool_)
    repeats = np.repeat(rests, length)
    stays = begin[rests]
    repeats[stays + np.where(first[stays], 0, length[rests] // 2)] = False
    return repeats


def angle_quantum(angle: Array) -> float:
    """Return the step [rad] in which an angle comes, as counts or rounding make it; 0 for none."""
    every = np.abs(np.diff(angle))
    # A slow motor moves once in a hundred rows; lost samples compare as smaller.
    moves = np.sort(every[every > FINEST_ENCODER][:20_000])
    rests = moves.size < 0.5 * every.size
    if moves.size < 50:
        return 0.0
    moves = moves[:: -(-moves.size // FEW)]
    for parts in (1, 2, 3):  # a motor that is fast in every sample may show no single step
        quantum = float(moves[0]) / parts
        for reach in (4.0, 20.0, 100.0, np.inf):  # the longer moves tell it better
            near = moves[moves < reach * quantum]
            whole = np.round(near / quantum)
            quantum = float(near @ whole / (whole @ whole))
        whole = np.round(moves / quantum)
        levels = np.unique(whole).size
        off = np.abs(moves / quantum - whole)
        single = levels == 2 or (levels == 1 and rests)
        if (levels > 2 and np.mean(off < 0.05) > 0.95) or (single and off.max() < 0.005):
            return quantum
        if levels > MANY and _mean_of_each(whole, off) < 0.5 * UNIFORM:
            return quantum
    return 0.0


def _mean_of_each(level: Array, off: Array) -> float:
    """Return the mean over levels of the mean at each: a speed that stays counts once."""
    _, which, often = np.unique(level, return_inverse=True, return_counts=True)
    return float(np.mean(np.bincount(which, off) / often))


def speed_quantum(velocity: Array) -> float:
    """Return the step in which a speed comes, 0 where it comes in none.

    A coarse step means that the speed is a difference of counts, so a mean over a window.
    """
    x = velocity[:20_000]
    x = x[np.isfinite(x)]
    if x.size < 50:
        return 0.0
    span = float(np.ptp(x))
    # Steps of a five-hundredth of the span or more repeat; a speed without steps hardly does.
    few = np.sort(x[:: -(-x.size // FEW)])
    if few.size > FEW // 2 and np.mean(np.diff(few) <= 1e-6 * span) < 0.2:
        return 0.0
    levels = np.unique(x)
    steps = np.diff(levels)
    steps = steps[steps > 1e-6 * max(span, 1e-300)]
    if steps.size == 0:
        return 0.0
    # Published logs round: a twentieth of a step is allowed, and what a single step is out by
    # must not add up over many: a line through all levels tells the step.
    count = np.concatenate([[0.0], np.cumsum(np.round(steps / np.median(steps)))])
    levels = levels[0] + np.concatenate([[0.0], np.cumsum(steps)])
    if np.ptp(count) == 0:
        return 0.0
    quantum, first = (float(x) for x in np.polyfit(count, levels, 1))
    whole = (levels - first) / quantum
    regular = np.mean(np.abs(whole - np.round(whole)) < 0.05)
    return quantum if regular > 0.95 and quantum > 2e-3 * span else 0.0


def prepare(
    records: Sequence[Record], use_current: bool, kind: str = "auto", hold: str = "held"
) -> Experiments:
    """Put records one after the other; segments keep their own state."""
    outputs = [output_of(r, kind) for r in records]
    if len({k for _, k, _ in outputs}) > 1:
        outputs = [output_of(r, "speed") for r in records]
    starts, ends, values, hold_start = [], [], [], []
    offset = sections = 0
    rng = np.random.default_rng(0)
    for record in records:
        end, value, index = held_intervals(record, hold)
        starts += [offset + s for s in record.starts]
        hold_start += [sections + int(index[s]) for s in record.starts]
        ends.append(end)
        values.append(value)
        offset += len(record)
        sections += len(end)
    starts.append(offset)
    hold_start.append(sections)
    time = _join([r.time for r in records])
    output = _join([o if quantum else dithered(o, k, rng) for o, k, quantum in outputs])
    currents = [r.current if r.current is not None else np.full(len(r), np.nan) for r in records]
    current = _join([dithered(i, None, rng) for i in currents]) if use_current else np.zeros(0)
    voltage, bounds = _join([r.voltage for r in records]), np.array(starts, dtype=np.int64)
    stood = stands(time, output, voltage, bounds, outputs[0][1], outputs[0][2])
    value = _join(values)
    if stood.any():
        value = value.copy()
        value[np.array(hold_start[:-1])[stood]] = 0.0
    steps = np.concatenate([np.diff(r.time[:200_000]) for r in records])
    return Experiments(
        time,
        output,
        current,
        bounds,
        _join(ends),
        value,
        np.array(hold_start, dtype=np.int64),
        outputs[0][1],
        float(np.median(steps)),
        outputs[0][2],
        _initial(time, output, bounds, outputs[0][1]),
        voltage,
        stood,
        current_quantum=speed_quantum(_join(currents)) if use_current else 0.0,
    )


def dithered(values: Array, kind: Measurement | None, rng: np.random.Generator) -> Array:
    """Return an angle, a speed or a current as the finest sensor of it reads.

    A signal without any noise, as simulators write it, would weigh without bound beside another,
    and its least deviation from the model, of rounding alone, would count as torque noise.
    """
    known = values[np.isfinite(values)]
    range_ = float(np.ptp(known)) if known.size else 0.0
    step = FINEST_ENCODER if kind == ANGLE else FINEST_SENSOR * range_
    return np.asarray(values + step * rng.uniform(-0.5, 0.5, values.size))


def _join(arrays: Sequence[Array]) -> Array:
    return np.ascontiguousarray(arrays[0]) if len(arrays) == 1 else np.concatenate(arrays)


def _initial(time: Array, output: Array, starts: Integers, kind: Measurement) -> Array:
    initial = np.zeros((len(starts) - 1, 5))
    for g in range(len(starts) - 1):
        a, b = int(starts[g]), int(min(starts[g + 1], starts[g] + 6))
        y, t = output[a:b], time[a:b]
        ok = np.isfinite(y)
        if not ok.any():
            continue
        y, t = y[ok], t[ok]
        if kind == ANGLE:
            initial[g, 2] = y[0]
            moved = int(np.argmax(y != y[0]))  # one that is taken to stand may be held by friction
            if moved:
                initial[g, 1] = (y[moved] - y[0]) / (t[moved] - t[0])
        else:
            initial[g, 1] = y[0]
    return initial
