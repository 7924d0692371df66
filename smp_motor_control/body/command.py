"""What the body is asked to do, and for how long that holds."""

import math
from enum import Enum

from smp_motor_control.errors import check_positive


class Verdict(Enum):
    """What became of a command that arrived."""

    ACCEPTED = "accepted"
    ZERO_STAMP = "accepted; its stamp is zero, taken as now"
    STALE = "dropped: older than the time-out when it arrived"
    NOT_FINITE = "not finite: dropped"


class BodyCommand:
    """The newest velocity command, which brakes when it is not renewed in time; 0: it never does.

    Age is counted on a steady clock from the arrival, plus the age that the command had then
    by its stamp, so that a jump of the wall clock or a stamp from the future cannot keep
    wheels turning.  A command that is not finite is no sign of life: the body brakes after the
    ordinary time-out (diff_drive_controller drives on for as long as such messages come).
    """

    def __init__(self, timeout: float = 0.5) -> None:
        self.configure(timeout)
        self.reset()

    def configure(self, timeout: float) -> None:
        """Change the time-out."""
        check_positive("timeout", timeout, "s", or_zero=True)
        self.timeout = timeout

    def reset(self) -> None:
        """Forget every command: nothing is asked until the next one."""
        self._velocity: tuple[float, float] | None = None
        self._born = -math.inf

    def receive(
        self, linear: float, angular: float, age: float | None, steady_now: float
    ) -> Verdict:
        """Take in a command."""
        if age is not None and self.timeout > 0.0 and not age < self.timeout:
            return Verdict.STALE
        if not (math.isfinite(linear) and math.isfinite(angular)):
            return Verdict.NOT_FINITE
        self._born = steady_now - max(age or 0.0, 0.0)
        self._velocity = (linear, angular)
        return Verdict.ZERO_STAMP if age is None else Verdict.ACCEPTED

    def age(self, steady_now: float) -> float:
        """Return how old the newest command is."""
        return steady_now - self._born

    def timed_out(self, steady_now: float) -> bool:
        """Tell whether the command is too old to be followed."""
        return self.timeout > 0.0 and self.age(steady_now) > self.timeout

    def at(self, steady_now: float) -> tuple[float, float] | None:
        """Return the velocity that is asked for."""
        if self._velocity is None:
            return None
        return (0.0, 0.0) if self.timed_out(steady_now) else self._velocity
