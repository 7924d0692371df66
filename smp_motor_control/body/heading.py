# SPDX-License-Identifier: Apache-2.0
"""Heading control of the body by a measured yaw."""

import math
from dataclasses import dataclass

from smp_motor_control.errors import check_positive
from smp_motor_control.fields import described


def wrap_angle(angle: float) -> float:
    """Return an angle in [-pi, pi]."""
    return math.remainder(angle, 2.0 * math.pi)


@dataclass(eq=False)
class HeadingHold:
    """PI controller of the yaw; its reference is the integral of the commanded yaw rate.

    ``w_out = w_cmd + clamp(p e + i integral(e))`` with ``e = wrap(integral(w_cmd) - yaw)``.  An
    error beyond ``max_error`` resets the reference to the measured yaw.
    """

    p: float = described(
        2.0, "Proportional gain of the heading [1/s].", minimum=0.0, name="heading_p"
    )
    i: float = described(
        0.5, "Integral gain of the heading [1/s^2].", minimum=0.0, name="heading_i"
    )
    max_correction: float = described(
        0.5, "Maximum correction of the yaw rate [rad/s].", name="heading_max_correction"
    )
    max_error: float = described(
        0.7, "Error that resets the reference to the measured yaw [rad].",
        name="heading_max_error",
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_positive("heading p", self.p, "1/s", or_zero=True)
        check_positive("heading i", self.i, "1/s^2", or_zero=True)
        check_positive("heading max_correction", self.max_correction, "rad/s")
        check_positive("heading max_error", self.max_error, "rad")
        self.reset()

    def reset(self) -> None:
        """Restart from the next yaw; for a body at rest or without a yaw."""
        self._reference: float | None = None
        self._integral = 0.0

    def step(self, angular: float, yaw: float, dt: float) -> float:
        """Return the corrected yaw rate [rad/s]."""
        if not math.isfinite(yaw):
            self.reset()
            return angular
        if self._reference is None:
            self._reference = yaw
            return angular
        self._reference = wrap_angle(self._reference + angular * dt)
        error = wrap_angle(self._reference - yaw)
        if abs(error) > self.max_error:
            self._reference, self._integral = yaw, 0.0
            return angular
        correction = self.p * error + self._integral
        limit = self.max_correction
        if abs(correction) < limit or correction * error < 0.0:
            self._integral += self.i * error * dt
        return angular + min(max(correction, -limit), limit)
