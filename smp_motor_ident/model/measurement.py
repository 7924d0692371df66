"""What a sensor shows of the motor's motion."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Measurement:
    """A mechanical output: what is predicted of the motion, and compared."""

    name: str
    code: int  # by which the compiled pass calls it
    integrals: int = 0  # how often the speed is integrated to it

    @property
    def low_passed(self) -> bool:
        """Whether it is a low-pass of the speed."""
        return self.code >= LOW_PASSED.code


SPEED = Measurement("speed", 0)
"""The speed at the stamp [rad/s]."""
ANGLE = Measurement("angle", 1, 1)
"""The angle, or counts times their resolution [rad]."""
MEAN_SPEED = Measurement("mean speed", 2)
"""The mean of the speed over a trailing window [rad/s]."""
LATE_SPEED = Measurement("late speed", 3)
"""The speed that was, as long ago as the mean over a window is late [rad/s]."""
LOW_PASSED = Measurement("low-passed speed", 4)
"""A first-order low-pass of the speed that is as late as the mean over a window [rad/s]."""


MEANS = 100
"""Added to the samples a row of a low-pass: each is the mean since the one before."""


def smoothed(ticks: int, means: bool = False) -> Measurement:
    """Return a low-pass that takes so many samples of the speed a row; continuous for none.

    ``means``: whether each is the mean since the one before, as a difference of counts is.
    """
    return Measurement(LOW_PASSED.name, LOW_PASSED.code + ticks + MEANS * means)
