"""Which readings of a speed no motor can have reached since the one before."""

import math

from smp_motor_control.wheel.loop import LoopSettings

_SPARE = 2.0
"""Times the acceleration of the motor at full voltage that something else may add to it."""

_GROSS = 0.5
"""Share of the top speed by which readings may differ for whatever reason."""


_QUIET = 0.2
"""Mean change from reading to reading, of the largest that is believed, below which one that jumps
is none of its kind: readings in coarse steps jump all the time."""

_RISE, _FALL = 0.05, 0.005
"""Weights of the newest change in that mean where it is larger, and smaller: coarse steps are known
after a few, outliers in one of a hundred readings are none."""


class PlausibleSpeed:
    """Leaves out a reading that jumps where others do not, unless the next one is there, too.

    Examples
    --------
    >>> speed = PlausibleSpeed()
    >>> speed.gross, speed.rate = 1.0, 10.0
    >>> [speed.accepts(one, 0.01) for one in (0.0, 0.1, 5.0, 0.1)]
    [True, True, False, True]
    """

    def __init__(self) -> None:
        self.gross = self.rate = math.inf  # [rad/s], [rad/s^2]: what a change may be of
        self._usual = 0.0  # mean change, of the largest that is believed
        self.reset()

    def configure(self, settings: LoopSettings, supply: float) -> None:
        """Learn what the motor can do; nothing jumps where that is not known."""
        inertia, drive = settings.gains.feedforward_acceleration, settings.drive
        volts = min(supply, settings.gains.u_clamp_max)
        known = drive is not None and inertia > 0.0 and math.isfinite(volts)
        self.gross = _GROSS * drive.top_speed if drive is not None and known else math.inf
        self.rate = _SPARE * 2.0 * volts / inertia if known else math.inf

    def reset(self) -> None:
        """Forget what was read, as after lost feedback."""
        self._kept = self._last = math.nan

    def accepts(self, speed: float, dt: float) -> bool:
        """Tell whether a speed [rad/s] is to be believed."""
        most = max(self.gross, self.rate * dt)
        last, self._last = self._last, speed
        change = abs(speed - last)  # NaN: the first
        beyond = (change / most if change < most else 1.0) - self._usual
        self._usual += (_RISE if beyond > 0.0 else _FALL) * beyond
        jumps = abs(speed - self._kept) > most and not change <= most
        if jumps and self._usual < _QUIET:
            return False
        self._kept = speed
        return True
