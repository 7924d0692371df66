"""Is this feedback new, and how long is it since the sample before.

Pure logic on numbers; times are seconds on a steady clock unless they are stamps.
"""

import math
from enum import Enum

CLOCK_JUMP = 1.0
"""Stamps that are off by more than this [s] tell of a clock that jumped, not of a delay: unless
they go on from the sample before, which those of a clock that was set back do not."""

_CLOCKS_AGREE = 0.1
"""Between readings of one instant on two clocks of a computer no more than this passes [s]."""


class Verdict(Enum):
    """What a feedback sample is, by its stamp."""

    FRESH = "fresh"
    FIRST = "first after a start, a gap or a clock jump"
    DUPLICATE = "duplicate"
    REORDERED = "older than the one before"
    LATE = "late"


class FeedbackClock:
    """Tells the interval between feedback samples, and which of them to leave out.

    The stamps' clock and the computer's may differ by a constant: an offset beyond
    :data:`CLOCK_JUMP` is learnt at the start and after every jump, and ages are counted
    from there.
    """

    def __init__(self, max_age: float, max_gap: float) -> None:
        self.max_age = max_age
        self.max_gap = max_gap
        self.counts = dict.fromkeys(Verdict, 0)
        self.jumps = 0  # of the stamps' clock
        self.unstamped = False  # whether the last sample had no stamp
        self.offset = 0.0  # learnt difference of the clocks [s]
        self.dt = 0.0  # interval that ends with the last fresh sample [s]
        self.gap = 0.0  # interval that was too long, where the last sample came after one [s]
        self.age = 0.0  # from stamp to arrival of the last sample, less the offset [s]
        self._last: int | None = None
        self._heard = -math.inf

    def reset(self) -> None:
        """Take the next sample as a first one."""
        self._last = None

    def accept(self, stamp: int, now: int, steady: float | None = None) -> Verdict:
        """Judge a sample by its stamp and its arrival [ns]; a stamp of 0 stands for the arrival.

        ``steady`` is the arrival on a clock that nobody sets [s].
        """
        self.unstamped = not stamp
        verdict = self._judge(stamp or now, now, now * 1e-9 if steady is None else steady)
        self.counts[verdict] += 1
        return verdict

    def _judge(self, stamp: int, now: int, steady: float) -> Verdict:
        raw_age = (now - stamp) * 1e-9
        age = raw_age - self.offset
        last = self._last
        step = 0.0 if last is None else (stamp - last) * 1e-9
        # No sample ages by more than the time that has passed: else our own clock was set.
        aged = age - self.age <= steady - self._heard + _CLOCKS_AGREE
        self._heard = steady
        delayed = age >= CLOCK_JUMP and 0.0 < step <= self.max_gap and aged
        if step < -CLOCK_JUMP or not (-CLOCK_JUMP < age < CLOCK_JUMP or delayed):
            self.jumps += last is not None
            self.offset = raw_age if abs(raw_age) > CLOCK_JUMP else 0.0
            self.age = raw_age - self.offset
            self._last = stamp
            return Verdict.FIRST
        self.age = age
        if last is not None and step <= 0.0:
            return Verdict.DUPLICATE if step == 0.0 else Verdict.REORDERED
        self._last = stamp
        if age > self.max_age:
            return Verdict.LATE
        self.gap = step if step > self.max_gap else 0.0
        if last is None or self.gap:
            return Verdict.FIRST
        self.dt = step
        return Verdict.FRESH
