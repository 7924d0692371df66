"""How far the wheels have turned since last asked, from samples that may be lost or wrong."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

LONGEST_GUESS = 0.1
"""For so long [s] a wheel without a position is taken to have kept its velocity."""


class WheelSample(NamedTuple):
    """One wheel at one instant."""

    stamp: float  # instant of sampling [s]
    # position, velocity: [rad], [rad/s]
    position: float
    velocity: float


class SideTravel(NamedTuple):
    """How far the wheels of both sides turned, and how fast they turn."""

    # left, right: mean over the side's wheels since it was last asked for [rad]
    left: float
    right: float
    # left_speed, right_speed: mean over the side's wheels [rad/s]; of each its travel over a
    # window, over the time between the stamps of the window's ends
    left_speed: float
    right_speed: float


@dataclass
class _Wheel:
    latest: WheelSample
    arrived: float
    taken: WheelSample | None = None
    past: deque[WheelSample] = field(default_factory=deque)

    def speed(self, window: float) -> float:
        """Return the mean speed since the last sample that is a window old, or the oldest."""
        past, latest = self.past, self.latest
        while len(past) > 1 and past[1].stamp <= latest.stamp - window:
            past.popleft()
        span = latest.stamp - past[0].stamp if past else 0.0
        angle = latest.position - past[0].position if past else math.nan
        return angle / span if span > 0.0 and math.isfinite(angle) else latest.velocity


class WheelFeedback:
    """The newest sample of each wheel, and what came of it since it was last taken.

    Positions that would need a wheel faster than ``max_speed`` [rad/s] are a counter that was
    reset, or a wheel that was replaced, not motion; speeds are averaged over ``window`` [s].
    """

    def __init__(
        self,
        left: Sequence[str],
        right: Sequence[str],
        max_speed: float = math.inf,
        window: float = 0.2,
    ) -> None:
        self.left, self.right, self.max_speed = tuple(left), tuple(right), max_speed
        self.window = window
        self._wheels: dict[str, _Wheel] = {}

    def receive(self, wheel: str, sample: WheelSample, steady_now: float) -> None:
        """Take in a sample; one that is not finite in position and velocity says nothing."""
        if not (math.isfinite(sample.position) or math.isfinite(sample.velocity)):
            return
        known = self._wheels.get(wheel)
        if known is None:
            self._wheels[wheel] = _Wheel(sample, steady_now)
        elif sample.stamp != known.latest.stamp:  # a duplicate is no sign of life
            known.latest, known.arrived = sample, steady_now

    def silent(self, steady_now: float, timeout: float) -> dict[str, float]:
        """Return the wheels that have not been heard for too long."""
        ages = {
            wheel: steady_now - self._wheels[wheel].arrived if wheel in self._wheels else math.inf
            for wheel in (*self.left, *self.right)
        }
        return {wheel: age for wheel, age in ages.items() if age > timeout}

    @property
    def latest(self) -> Mapping[str, WheelSample]:
        """The newest sample of every wheel that was ever heard."""
        return {wheel: known.latest for wheel, known in self._wheels.items()}

    def take(self, steady_now: float, timeout: float) -> SideTravel | None:
        """Return how far the sides turned since the last call.

        A wheel that is silent for longer than the time-out no longer counts for its side's
        mean; when it is back, it counts from there on.
        """
        moved = {wheel: self._moved(known) for wheel, known in self._wheels.items()}
        silent = self.silent(steady_now, timeout)
        alive = [[w for w in side if w not in silent] for side in (self.left, self.right)]
        for wheel in silent:
            if wheel in self._wheels:
                self._wheels[wheel].taken = None
                self._wheels[wheel].past.clear()
        if not all(alive) or all(angle is None for angle in moved.values()):
            return None
        travel = (sum(moved[wheel] or 0.0 for wheel in side) / len(side) for side in alive)
        speeds = (
            sum(self._wheels[wheel].speed(self.window) for wheel in side) / len(side)
            for side in alive
        )
        return SideTravel(*travel, *speeds)

    def _moved(self, known: _Wheel) -> float | None:
        """Return the angle that a wheel turned since it was last asked, if it tells."""
        latest, taken = known.latest, known.taken
        known.taken = latest
        if taken is None or latest.stamp <= taken.stamp:
            if taken is None or latest.stamp < taken.stamp:
                known.past = deque([latest])
            return None  # the first reading, or one after time jumped, is no motion
        dt = latest.stamp - taken.stamp
        angle = latest.position - taken.position
        if not math.isfinite(angle):
            angle = latest.velocity * min(dt, LONGEST_GUESS)
        if abs(angle) > self.max_speed * dt:
            known.past = deque([latest])
            return None
        known.past.append(latest)
        return angle
