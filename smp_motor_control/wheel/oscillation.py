"""A wheel that swings around its set-point for ever, model or not.

Gains that are too high for the interval of the feedback end in such a cycle, in which the voltage
goes from clamp to clamp and the mean speed is right.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

LEAST = 0.3
"""Amplitude that is none [rad/s], as the error that is never a fault."""

SHARE = 0.25
"""Amplitude that is none, in references: what a load that changes with the angle may do."""

COUNTS = 3.0
"""Least way of half a swing, in counts of the encoder: what it rounds away swings by one."""

LEAST_WAY = 0.01
"""The same where the encoder is not known [rad]."""

HALVES = 10
"""Half swings in succession that are an oscillation."""

ALIKE = 0.3
"""Standard deviation of its periods, in their mean, that a cycle has at most: noise has more."""

SMOOTH = 0.75
"""Least ratio of error to second difference: 0.41 of white noise, 1 of a cycle of six samples."""

MEMORY = 0.5
"""Time over which that ratio is averaged [s]."""

OFFSET = 1.0
"""Time over which an error is averaged that does not swing, as without integral action [s]."""

LASTS = 1.0
"""Time that it must last [s]: changes of the set-point ring for less."""

OVER = 3.0
"""Time without a turn after which it is over [s]."""

STEADY = 0.1
"""Share by which a reference may change that counts as steady; and that in rad/s."""


class Swing(NamedTuple):
    """An oscillation of a wheel's speed."""

    amplitude: float  # [rad/s]
    frequency: float  # [Hz]


class Oscillation:
    """Watches the error of a speed at a steady reference; ``found`` is what it swings by."""

    def __init__(self) -> None:
        self.least_way = LEAST_WAY
        self.found: Swing | None = None
        self._begin(math.nan)

    def reset(self) -> None:
        """Forget what was seen, as where the loop begins anew."""
        self.found = None
        self._begin(math.nan)

    def set_count(self, angle: float) -> None:
        """Learn what one count of the encoder is, at the wheel [rad]."""
        self.least_way = COUNTS * angle

    def _begin(self, reference: float) -> None:
        self._reference = reference
        self._halves: deque[tuple[float, float]] = deque(maxlen=HALVES)  # instant, peak
        self._offset = self._before = self._slope = self._power = self._bend = 0.0
        self._side = self._time = self._turned_at = self._peak = self._way = 0.0

    def add(self, dt: float, reference: float, speed: float) -> None:
        """Take in a sample."""
        off = abs(reference - self._reference)
        if not off <= STEADY * (1.0 + abs(self._reference)):
            self._begin(reference)
        self._time += dt
        error = speed - reference
        self._offset += min(dt / OFFSET, 1.0) * (error - self._offset)
        error -= self._offset
        slope = error - self._before
        share, bend = min(dt / MEMORY, 1.0), slope - self._slope
        self._power += share * (error * error - self._power)
        self._bend += share * (bend * bend - self._bend)
        self._before, self._slope = error, slope
        least = max(LEAST, SHARE * abs(reference))
        side = math.copysign(1.0, error) if abs(error) > least else 0.0
        if side and side != self._side:
            self._turn(side)
        elif self._time - self._turned_at > OVER:
            self.found = None
            self._begin(reference)
        if error * self._side > 0.0:
            self._way += abs(error) * dt
            self._peak = max(self._peak, abs(error))

    def _turn(self, side: float) -> None:
        """End half a swing, and look whether enough of them followed on each other."""
        halves = self._halves
        if self._side and self._way < self.least_way:
            halves.clear()
        elif self._side:
            halves.append((self._time, self._peak))
        self._side, self._turned_at, self._peak, self._way = side, self._time, 0.0, 0.0
        if len(halves) == HALVES and self._time > LASTS:
            smooth = self._power > SMOOTH * SMOOTH * self._bend
            self.found = _swing(halves) if smooth else None


def _swing(halves: Sequence[tuple[float, float]]) -> Swing | None:
    """Return the cycle that half swings make; None where their periods are not alike."""
    instants, peaks = zip(*halves)
    periods = [after - before for before, after in zip(instants, instants[2:])]
    period = sum(periods) / len(periods)
    scatter = math.sqrt(sum((one - period) ** 2 for one in periods) / len(periods))
    return Swing(sum(peaks) / len(peaks), 1.0 / period) if scatter < ALIKE * period else None
