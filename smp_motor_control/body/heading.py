"""Holding the heading of the body against uneven ground, with a yaw from outside."""

import math

from smp_motor_control.errors import check_positive


def wrapped(angle: float) -> float:
    """Return an angle in [-pi, pi]."""
    return math.remainder(angle, 2.0 * math.pi)


class HeadingHold:
    """PI controller of the yaw whose reference is the integral of the commanded yaw rate.

    ``w_out = w_cmd + clamp(p e + i integral(e))`` with ``e = wrap(integral(w_cmd) - yaw)``, p [1/s]
    and i [1/s^2].  Beyond ``max_error`` [rad] the body was turned by something stronger: the
    present yaw is the new reference.

    Examples
    --------
    >>> hold = HeadingHold(p=2.0, i=0.0)
    >>> hold.step(0.0, yaw=0.3, dt=0.02), round(hold.step(0.0, yaw=0.2, dt=0.02), 6)
    (0.0, 0.2)
    """

    def __init__(
        self, p: float = 2.0, i: float = 0.5, max_correction: float = 0.5, max_error: float = 0.7
    ) -> None:
        check_positive("heading p", p, "1/s", or_zero=True)
        check_positive("heading i", i, "1/s^2", or_zero=True)
        check_positive("heading max_correction", max_correction, "rad/s")
        check_positive("heading max_error", max_error, "rad")
        self._p, self._i = p, i
        self._max_correction, self._max_error = max_correction, max_error
        self.reset()

    def reset(self) -> None:
        """Take the next yaw as the reference; for a body at rest, or without a yaw."""
        self._reference: float | None = None
        self._integral = 0.0

    def step(self, angular: float, yaw: float, dt: float) -> float:
        """Return the yaw rate to command so that the heading follows the one asked for."""
        if not math.isfinite(yaw):
            self.reset()
            return angular
        if self._reference is None:
            self._reference = yaw
            return angular
        self._reference = wrapped(self._reference + angular * dt)
        error = wrapped(self._reference - yaw)
        if abs(error) > self._max_error:
            self._reference, self._integral = yaw, 0.0
            return angular
        correction = self._p * error + self._integral
        limit = self._max_correction
        if abs(correction) < limit or correction * error < 0.0:
            self._integral += self._i * error * dt
        return angular + min(max(correction, -limit), limit)
