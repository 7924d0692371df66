"""What a sensor shows of the motor's motion."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Measurement:
    """A mechanical output: what is predicted of the motion, and compared."""

    name: str
    code: int  # by which the compiled pass calls it
    integrals: int = 0  # how often the speed is integrated to it


SPEED = Measurement("speed", 0)
"""The speed at the stamp [rad/s]."""
ANGLE = Measurement("angle", 1, 1)
"""The angle, or counts times their resolution [rad]."""
MEAN_SPEED = Measurement("mean speed", 2)
"""The mean of the speed over a trailing window [rad/s]."""
LOW_PASSED = Measurement("low-passed speed", 3)
"""A first-order low-pass of the speed that is as late as the mean over a window [rad/s]."""
