"""What the body is asked to do, and for how long that holds."""

from __future__ import annotations

import math
from enum import Enum

from smp_motor_control.errors import ParameterError


class Verdict(Enum):
    """What became of a command that arrived."""

    ACCEPTED = "accepted"
    ZERO_STAMP = "accepted; its stamp is zero, taken as now"
    STALE = "dropped: older than the time-out when it arrived"
    NOT_FINITE = "not finite: dropped"


class BodyCommand:
    """The newest velocity command, which brakes when it is not renewed.

    Parameters
    ----------
    timeout : float
        [s]; 0 lets a command hold for ever.

    Notes
    -----
    Age is counted on a steady clock from the arrival, plus the age that the command had then
    by its stamp, so that a jump of the wall clock or a stamp from the future cannot keep
    wheels turning.  A command that is not finite is no sign of life: the body brakes after the
    ordinary time-out (diff_drive_controller drives on for as long as such messages come).
    """

    def __init__(self, timeout: float = 0.5) -> None:
        self.configure(timeout)
        self.reset()

    def configure(self, timeout: float) -> None:
        """Change the time-out.

        Parameters
        ----------
        timeout : float
            [s]; 0 for none.

        Raises
        ------
        ParameterError
            When it is negative or not finite.
        """
        if not 0.0 <= timeout < math.inf:
            raise ParameterError(f"timeout is {timeout} s: must be finite and not negative")
        self.timeout = timeout

    def reset(self) -> None:
        """Forget every command: nothing is asked until the next one."""
        self._velocity: tuple[float, float] | None = None
        self._born = -math.inf

    def receive(
        self, linear: float, angular: float, age: float | None, steady_now: float
    ) -> Verdict:
        """Take in a command.

        Parameters
        ----------
        linear, angular : float
            Velocity of the body [m/s], [rad/s].
        age : float or None
            Time since its stamp [s]; None where it has none, or a zero one.
        steady_now : float
            Time of arrival on a clock that never jumps [s].

        Returns
        -------
        Verdict
            Whether it holds now.
        """
        if age is not None and self.timeout > 0.0 and not age < self.timeout:
            return Verdict.STALE
        if not (math.isfinite(linear) and math.isfinite(angular)):
            return Verdict.NOT_FINITE
        self._born = steady_now - max(age or 0.0, 0.0)
        self._velocity = (linear, angular)
        return Verdict.ZERO_STAMP if age is None else Verdict.ACCEPTED

    def age(self, steady_now: float) -> float:
        """Return how old the newest command is.

        Parameters
        ----------
        steady_now : float
            [s].

        Returns
        -------
        float
            [s]; infinite before the first.
        """
        return steady_now - self._born

    def timed_out(self, steady_now: float) -> bool:
        """Tell whether the command is too old to be followed.

        Parameters
        ----------
        steady_now : float
            [s].

        Returns
        -------
        bool
            Never with a time-out of 0.
        """
        return self.timeout > 0.0 and self.age(steady_now) > self.timeout

    def at(self, steady_now: float) -> tuple[float, float] | None:
        """Return the velocity that is asked for.

        Parameters
        ----------
        steady_now : float
            [s].

        Returns
        -------
        tuple of float or None
            Linear and angular velocity [m/s], [rad/s]; zero after the time-out; None before
            the first command.
        """
        if self._velocity is None:
            return None
        return (0.0, 0.0) if self.timed_out(steady_now) else self._velocity
