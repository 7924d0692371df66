# SPDX-License-Identifier: Apache-2.0
"""The body's velocity command and its time-out."""

import math
from enum import Enum

from smp_motor_control.errors import check_positive


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
