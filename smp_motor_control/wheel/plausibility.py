"""Which readings of a speed no motor can have reached since the one before."""

import math

from smp_motor_control.pid import PidGains
from smp_motor_control.reference.profile import Drive

_GROSS = 0.5
"""Share of the top speed by which readings may differ for whatever reason, if none is known."""


_BLIND, _BLIND_SHARE = 10.0, 3.0
"""By which readings may differ where the motor is not known: so much [rad/s], and so many times the
speed that is, or that is asked for."""

LOAD = 0.25
"""Share of the voltage by which a load changes a speed whose noise is known."""

_QUIET = 0.2
"""Mean change from reading to reading, of the largest that is believed, below which one that jumps
is none of its kind: readings in coarse steps jump all the time."""

_BLIND_QUIET = 0.6
"""The same where the motor is not known: an outlier in twenty readings makes it 0.5."""

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
        self._known = True
        self._usual = 0.0  # mean change, of the largest that is believed
        self._jump = self._inertia = self._load = self._back_emf = self._lag = 0.0
        self.reset()

    def configure(self, gains: PidGains, drive: Drive | None, jump: float, lag: float) -> None:
        """Learn what the motor can do; where that is not known, only what nothing could do jumps.

        ``jump`` [rad/s] is what readings differ by for another reason, 0 where nobody knows it,
        ``lag`` [s] by what they are late.
        """
        volts, inertia = gains.u_clamp_max, gains.feedforward_acceleration
        self._known = known = drive is not None and inertia > 0.0 and math.isfinite(volts)
        self.gross = _GROSS * drive.top_speed if drive is not None and known else math.inf
        # At full voltage, reversed at full speed.
        self.rate = 2.0 * volts / inertia if known else math.inf
        self._jump, self._inertia = jump if known else 0.0, inertia
        self._load = gains.feedforward_static + LOAD * volts
        self._back_emf, self._lag = gains.feedforward_velocity, lag

    def reset(self) -> None:
        """Forget what was read, as after lost feedback."""
        self._kept = self._last = math.nan
        self._drive = 0.0  # most voltage that accelerated the motor, fading with what it lags by

    def _most(self, voltage: float, dt: float, count: float, asked: float) -> float:
        """Return the largest change within a sample that is believed."""
        if not self._known:
            kept = self._kept if self._kept == self._kept else 0.0
            return _BLIND + _BLIND_SHARE * max(abs(kept), abs(asked)) + count
        if not self._jump:
            return max(self.gross, self.rate * dt) + count
        drive = abs(voltage - self._back_emf * self._kept) + self._load
        faded = self._drive + dt / (2.0 * (self._lag + dt)) * (drive - self._drive)
        self._drive = drive if not drive < faded else faded  # NaN: the first
        return self._jump + self._drive / self._inertia * dt

    def accepts(
        self,
        speed: float,
        dt: float,
        voltage: float = 0.0,
        count: float = 0.0,
        asked: float = 0.0,
    ) -> bool:
        """Tell whether a speed [rad/s] is to be believed under a voltage.

        ``count`` [rad/s] is what one count more adds to it, ``asked`` the reference.
        """
        most = self._most(voltage, dt, count, asked)
        last, self._last = self._last, speed
        change = abs(speed - last)  # NaN: the first
        beyond = (change / most if change < most else 1.0) - self._usual
        self._usual += (_RISE if beyond > 0.0 else _FALL) * beyond
        jumps = abs(speed - self._kept) > most and not change <= most
        if jumps and (self._jump or self._usual < (_QUIET if self._known else _BLIND_QUIET)):
            return False
        self._kept = speed
        return True
