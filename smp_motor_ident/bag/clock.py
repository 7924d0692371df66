"""Time done right: which clock, in what order, where gaps are, and inputs held over intervals."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from smp_motor_control.arrays import Array, Integers

_SECOND = 1_000_000_000
_BEATS = 32
SAME_CLOCK = 50_000_000
"""Clocks of two topics whose offsets differ by less [ns] are one clock: latency explains it."""


@dataclass(frozen=True)
class ClockFit:
    """Recorder's time against stamps: ``log = stamp + offset + drift (stamp - origin)``."""

    offset: float  # [ns] at ``origin``, without the latency that the fastest messages had too
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
    if span < 10 * _SECOND or stamp.size < 200:
        return ClockFit(float(base), 0.0, origin)
    part = np.minimum((since * (20 / span)).astype(np.int8), 19)
    parts = [inside for k in range(20) if (inside := np.flatnonzero(part == k)).size]
    drift = offset = 0.0
    for _ in range(3):  # the fastest message of a part is judged without the drift inside it
        rest = late - drift * since
        best = np.array([inside[np.argmin(rest[inside])] for inside in parts])
        drift, offset = np.polyfit(since[best], late[best], 1).tolist()
    return ClockFit(base + offset, drift, origin)


def judge_stamps(stamp: Integers | None, log: Integers) -> str:
    """Return why header stamps cannot be the samples' time; empty where they can."""
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


def epochs(time: Integers) -> list[tuple[int, int]]:
    """Split samples, in the order of logging, where their clock was set back.

    Single samples out of order are no reason to split, nor are shuffled ones: only long runs,
    each in order by itself, are parts of their own.
    """
    whole = [(0, time.size)]
    if time.size < 40:
        return whole
    steps = np.diff(time)
    usual = float(np.median(np.abs(steps)))
    back = np.flatnonzero(steps < -max(100 * usual, 0.5 * _SECOND)) + 1
    if not back.size or back.size > time.size / 40:
        return whole
    edges = [0, *back.tolist(), time.size]
    parts = list(pairwise(edges))
    ordered = all(b - a >= 20 and np.mean(np.diff(time[a:b]) > 0) > 0.9 for a, b in parts)
    return parts if ordered else whole


@dataclass(frozen=True)
class Rhythm:
    """How regularly samples come."""

    interval: float  # median interval [ns]
    regular: bool  # whether four of five intervals are within a quarter of it

    def missing(self, time: Integers) -> Integers:
        """Return how many samples are missing before each but the first.

        A late sample after which the others catch up is late, not preceded by a loss: the
        beat must stay behind by whole intervals.
        """
        steps = np.diff(time)
        number: Integers = np.zeros(steps.size, np.int64)
        if not self.regular or self.interval <= 0:
            return number
        number = np.maximum(np.rint(steps / self.interval).astype(np.int64) - 1, 0)
        late = np.flatnonzero(number)
        behind = (time - time[0]) - self.interval * np.arange(time.size)
        window = np.arange(_BEATS)
        before = np.median(behind[np.maximum(late[:, None] - window, 0)], axis=1)
        after = np.median(behind[np.minimum(late[:, None] + 1 + window, steps.size)], axis=1)
        lasting = np.rint((after - before) / self.interval).astype(np.int64)
        number[late] = np.clip(lasting, 0, number[late])
        return number

    def gap(self, averaged: bool = False) -> float:
        """Return the interval [ns] beyond which two samples have nothing in common.

        A log that is written on change is irregular and holds its voltage for long; but an
        ``averaged`` voltage does not tell when within a long interval it changed.
        """
        if self.regular or averaged:
            return max(20 * self.interval, 0.02 * _SECOND)
        return max(100 * self.interval, 1.0 * _SECOND)


def rhythm(time: Integers) -> Rhythm:
    """Return how regularly the samples come."""
    if time.size < 2:
        return Rhythm(0.0, False)
    steps = np.diff(time)
    median = float(np.median(steps))
    return Rhythm(median, bool(np.mean(np.abs(steps - median) <= 0.25 * median) >= 0.8))


def mean_held(time: Integers, value: Array, held: str, at: Integers) -> Array:
    """Average a held input over the intervals between output samples."""
    origin = int(time[0])
    seconds = (time - origin) * 1e-9
    wanted = (at - origin) * 1e-9
    level = value[:-1] if held == "after" else value[1:]
    integral = np.concatenate([[0.0], np.cumsum(level * np.diff(seconds))])
    # Beyond its last instant the input stays as it was last.
    whole = np.interp(wanted, seconds, integral) + np.maximum(wanted - seconds[-1], 0) * value[-1]
    mean = np.empty(at.size)
    mean[1:] = np.diff(whole) / np.diff(wanted)
    after = held == "after"
    side = int(np.searchsorted(time, at[0], "right" if after else "left")) - after
    mean[0] = value[min(max(side, 0), value.size - 1)]
    # Between these no input instant divides the interval between outputs.
    first, last = np.searchsorted(time, at[:-1], "right"), np.searchsorted(time, at[1:], "left")
    inside = first >= last
    # An interval without a change has exactly the level that holds there.
    index = first - 1 if after else np.minimum(last, value.size - 1)
    mean[1:][inside] = value[np.clip(index, 0, value.size - 1)][inside]
    return mean
