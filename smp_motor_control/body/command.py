# SPDX-License-Identifier: Apache-2.0
"""The body's velocity command: its time-out, and its heading controlled by a measured yaw."""

import math
from dataclasses import dataclass
from enum import Enum

from smp_motor_control.errors import check_positive
from smp_motor_control.fields import described


class Verdict(Enum):
    """Result of receiving a command."""

    ACCEPTED = "accepted"
    ZERO_STAMP = "accepted; its stamp is zero, taken as now"
    STALE = "dropped: older than the time-out when it arrived"
    NOT_FINITE = "not finite: dropped"


class BodyCommand:
    """Hold the newest velocity command until it times out; a time-out of 0 disables this.

    The age is measured on a steady clock from arrival, plus the age by the stamp at arrival, so
    that clock jumps and stamps from the future cannot keep wheels turning.  A non-finite command
    does not restart the time-out (diff_drive_controller keeps driving on such messages).
    """

    def __init__(self, timeout: float = 0.5) -> None:
        self.configure(timeout)
        self.reset()

    def configure(self, timeout: float) -> None:
        """Change the time-out."""
        check_positive("timeout", timeout, "s", or_zero=True)
        self.timeout = timeout

    def reset(self) -> None:
        """Discard all commands."""
        self._velocity: tuple[float, float] | None = None
        self._issued_at = -math.inf

    def receive(
        self, linear: float, angular: float, age: float | None, steady_now: float
    ) -> Verdict:
        """Accept or drop a command."""
        if age is not None and self.timeout > 0.0 and not age < self.timeout:
            return Verdict.STALE
        if not (math.isfinite(linear) and math.isfinite(angular)):
            return Verdict.NOT_FINITE
        self._issued_at = steady_now - max(age or 0.0, 0.0)
        self._velocity = (linear, angular)
        return Verdict.ZERO_STAMP if age is None else Verdict.ACCEPTED

    def age(self, steady_now: float) -> float:
        """Return the age of the newest command [s]."""
        return steady_now - self._issued_at

    def timed_out(self, steady_now: float) -> bool:
        """Return whether the newest command has expired."""
        return self.timeout > 0.0 and self.age(steady_now) > self.timeout

    def at(self, steady_now: float) -> tuple[float, float] | None:
        """Return the commanded (linear, angular) velocity; None before the first command."""
        if self._velocity is None:
            return None
        return (0.0, 0.0) if self.timed_out(steady_now) else self._velocity


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
