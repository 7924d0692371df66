"""How far the wheels have turned since last asked, from samples that may be lost or wrong."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from smp_motor_control.odometry import LEAST_STEP


class WheelSample(NamedTuple):
    """One wheel at one instant.

    Attributes
    ----------
    stamp : float
        Instant of sampling [s].
    position, velocity : float
        [rad], [rad/s].
    """

    stamp: float
    position: float
    velocity: float


class SideTravel(NamedTuple):
    """How both sides turned over a time.

    Attributes
    ----------
    left, right : float
        Mean speed of the side's wheels [rad/s].
    dt : float
        [s].
    """

    left: float
    right: float
    dt: float


@dataclass
class _Wheel:
    latest: WheelSample
    taken: WheelSample | None
    arrived: float


class WheelFeedback:
    """The newest sample of each wheel, and what came of it since it was last taken.

    Parameters
    ----------
    left, right : sequence of str
        Names of the wheels of each side.
    max_speed : float
        Positions that would need a faster wheel are a counter that was reset, or a wheel
        that was replaced, not motion [rad/s].
    """

    def __init__(
        self, left: Sequence[str], right: Sequence[str], max_speed: float = math.inf
    ) -> None:
        self.left, self.right, self.max_speed = tuple(left), tuple(right), max_speed
        self._wheels: dict[str, _Wheel] = {}

    def receive(self, wheel: str, sample: WheelSample, steady_now: float) -> None:
        """Take in a sample; one that is not finite in position and velocity says nothing.

        Parameters
        ----------
        wheel : str
            Of one of the sides.
        sample : WheelSample
            What it says.
        steady_now : float
            Time of arrival on a clock that never jumps [s].
        """
        if not (math.isfinite(sample.position) or math.isfinite(sample.velocity)):
            return
        known = self._wheels.get(wheel)
        if known is None:
            self._wheels[wheel] = _Wheel(sample, None, steady_now)
        elif sample.stamp != known.latest.stamp:  # a duplicate is no sign of life
            known.latest, known.arrived = sample, steady_now

    def silent(self, steady_now: float, timeout: float) -> dict[str, float]:
        """Return the wheels that have not been heard for too long.

        Parameters
        ----------
        steady_now : float
            [s].
        timeout : float
            [s].

        Returns
        -------
        dict of str to float
            Age of the wheel's last sample [s]; infinite where there was none.
        """
        ages = {
            wheel: steady_now - self._wheels[wheel].arrived if wheel in self._wheels else math.inf
            for wheel in (*self.left, *self.right)
        }
        return {wheel: age for wheel, age in ages.items() if age > timeout}

    @property
    def latest(self) -> Mapping[str, WheelSample]:
        """The newest sample of every wheel that was ever heard."""
        return {wheel: known.latest for wheel, known in self._wheels.items()}

    def take(self) -> SideTravel | None:
        """Return how the sides turned since the last call.

        Returns
        -------
        SideTravel or None
            None while a side has no wheel that tells anything new; what its wheels tell later
            covers the whole time.
        """
        moved = {wheel: self._moved(known) for wheel, known in self._wheels.items()}
        sides = [
            [step for wheel in side if (step := moved.get(wheel)) is not None]
            for side in (self.left, self.right)
        ]
        if not all(sides):
            return None
        for wheel, step in moved.items():
            if step is not None:
                self._wheels[wheel].taken = self._wheels[wheel].latest
        left, right = (sum(speed for speed, _ in side) / len(side) for side in sides)
        times = [dt for side in sides for _, dt in side]
        return SideTravel(left, right, sum(times) / len(times))

    def _moved(self, known: _Wheel) -> tuple[float, float] | None:
        """Return a wheel's mean speed since it was taken and the time since, if it tells."""
        latest, taken = known.latest, known.taken
        if taken is None or latest.stamp < taken.stamp:
            known.taken = latest  # the first reading, or one after time jumped, is no motion
            return None
        dt = latest.stamp - taken.stamp
        if dt < LEAST_STEP:
            return None
        speed = (latest.position - taken.position) / dt
        if not math.isfinite(speed):
            speed = latest.velocity
        if not abs(speed) <= self.max_speed:
            known.taken = latest
            return None
        return speed, dt
