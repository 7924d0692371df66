# SPDX-License-Identifier: Apache-2.0
"""Freshness and sampling interval of feedback.

Times other than stamps are in seconds on a steady clock.
"""

import math
from enum import Enum

CLOCK_JUMP_S = 1.0
"""An age beyond this is a clock jump rather than a delay, unless the stamps are continuous."""

_MAX_CLOCK_SKEW_S = 0.1  # maximum time between readings of two clocks at one instant


class Verdict(Enum):
    """Assessment of a feedback sample by its stamp."""

    FRESH = "fresh"
    FIRST = "first after a start, a gap or a clock jump"
    DUPLICATE = "duplicate"
    REORDERED = "out of order"
    LATE = "late"


class FeedbackClock:
    """Measure the interval between feedback samples and reject outdated ones.

    The clock of the stamps may have a constant offset: one beyond :data:`CLOCK_JUMP_S` is learnt at
    the start and after every jump, and subtracted from ages.
    """

    def __init__(self, max_age: float, max_gap: float) -> None:
        self.max_age = max_age
        self.max_gap = max_gap
        self.counts = dict.fromkeys(Verdict, 0)
        self.jumps = 0  # of the stamps' clock
        self.unstamped = False  # whether the last sample had no stamp
        self.offset = 0.0  # learnt clock offset [s]
        self.dt = 0.0  # interval before the last fresh sample [s]
        self.gap = 0.0  # interval before the last sample, if it was too long [s]
        self.age = 0.0  # of the last sample at arrival, without the offset [s]
        self._last: int | None = None
        self._heard = -math.inf

    def reset(self) -> None:
        """Treat the next sample as the first."""
        self._last = None

    def accept(self, stamp: int, now: int, steady: float | None = None) -> Verdict:
        """Assess a sample by its stamp and arrival [ns]; a stamp of 0 means the arrival.

        ``steady`` is the arrival on a steady clock [s].
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
        # If the age grows by more than the elapsed time, this computer's clock was set.
        aged = age - self.age <= steady - self._heard + _MAX_CLOCK_SKEW_S
        self._heard = steady
        delayed = age >= CLOCK_JUMP_S and 0.0 < step <= self.max_gap and aged
        if step < -CLOCK_JUMP_S or not (-CLOCK_JUMP_S < age < CLOCK_JUMP_S or delayed):
            self.jumps += last is not None
            self.offset = raw_age if abs(raw_age) > CLOCK_JUMP_S else 0.0
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
