"""The stop rule: ``stop_time`` after it is asked to stand, nothing drives a wheel any more.

It is asked to by a set-point of zero, or by set-points that cease.  The reference generator brings
the wheel to rest before that; where it does not, its reference ends at zero then.  An integral that
still turns the wheel, as one does that winds down slowly, is dropped.

Pure logic on numbers; times are seconds on a steady clock.
"""

import math

STANDING = 1e-3
"""Set-points up to this ask for a standstill [rad/s]: what is left of a joystick in its middle."""

AT_REST = 0.05
"""Speed up to which a wheel stands [rad/s]."""

LONGEST_STOP = 10.0
"""Largest time in which a wheel is to stand [s]."""

WINDOW = 0.5
"""Time over which voltage and speed are averaged to tell who turns a wheel [s]: a few counts of a
coarse encoder at the speed at which a wheel stands."""


class StopRule:
    """Knows since when a wheel is asked to stand, and whether its controller still drives it.

    Examples
    --------
    >>> rule = StopRule()
    >>> rule.ask(1.0, now=10.0), rule.ask(0.0, now=12.0)
    (None, None)
    >>> rule.overdue(12.9, stop_time=1.0), rule.overdue(13.1, stop_time=1.0)
    (False, True)
    """

    def __init__(self) -> None:
        self._since = math.inf
        self.watch()

    def watch(self, driven: bool = False) -> None:
        """Begin a window, after one in which the wheel was driven or not."""
        self._driven = driven
        self._time = self._turned = self._volt_seconds = 0.0

    @property
    def asked(self) -> bool:
        """Whether the wheel is asked to stand."""
        return self._since < math.inf

    def ask(self, setpoint: float, now: float) -> None:
        """Take in a set-point [rad/s]."""
        if abs(setpoint) > STANDING:
            self._since = math.inf
            self.watch()
        else:
            self._since = min(self._since, now)

    def overdue(self, now: float, stop_time: float) -> bool:
        """Tell whether the wheel was asked to stand longer ago than ``stop_time``."""
        return now - self._since > stop_time

    def is_driven(self, dt: float, voltage: float, velocity: float) -> bool:
        """Tell whether a voltage turned the wheel [rad/s] in its direction over the last window.

        What pushes a wheel, or a slope, turns it against the voltage.
        """
        self._time += dt
        self._turned += velocity * dt
        self._volt_seconds += voltage * dt
        if self._time >= WINDOW:
            forward = self._turned * self._volt_seconds > 0.0
            self.watch(driven=forward and abs(self._turned) > AT_REST * self._time)
        return self._driven
