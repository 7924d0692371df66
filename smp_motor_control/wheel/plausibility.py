# SPDX-License-Identifier: Apache-2.0
"""Plausibility of speed readings by the motor's acceleration."""

import math

from smp_motor_control.pid import PidGains
from smp_motor_control.reference.profile import Drive

_DEFAULT_JUMP_SHARE = 0.5
"""Plausible jump as a fraction of the top speed, without a configured value."""


_UNKNOWN_MOTOR_JUMP, _UNKNOWN_MOTOR_SHARE = 10.0, 3.0
"""Plausible jump for an unknown motor: constant [rad/s] plus a multiple of actual or set speed."""

LOAD_SHARE = 0.25  # voltage of a load, as a fraction of the maximum

_MAX_QUIET_CHANGE = 0.2
"""Mean change between readings, relative to the plausible one, below which a jump is an outlier;
coarsely quantised readings exceed it."""

_MAX_QUIET_CHANGE_UNKNOWN = 0.6
"""The same for an unknown motor; one outlier in twenty readings gives 0.5."""

_RISE_WEIGHT, _FALL_WEIGHT = 0.05, 0.005
"""Weights of a larger and of a smaller change in that mean: coarse steps are learnt quickly, rare
outliers are not."""


class PlausibleSpeed:
    """Reject a reading that jumps, unless the next one confirms it or readings always jump."""

    def __init__(self) -> None:
        self.max_jump = self.rate = math.inf  # plausible jump [rad/s] and acceleration [rad/s^2]
        self._known = True
        self._usual = 0.0  # mean change, relative to the plausible one
        self._jump = self._inertia = self._load = self._back_emf = self._lag = 0.0
        self.reset()

    def configure(self, gains: PidGains, drive: Drive | None, jump: float, lag: float) -> None:
        """Set the motor's ability; for an unknown motor the limits are wide.

        ``jump`` [rad/s] is the plausible jump, 0 if unknown, and ``lag`` [s] that of the readings.
        """
        volts, inertia = gains.u_clamp_max, gains.feedforward_acceleration
        self._known = known = drive is not None and inertia > 0.0 and math.isfinite(volts)
        self.max_jump = (
            _DEFAULT_JUMP_SHARE * drive.top_speed if drive is not None and known else math.inf
        )
        # Full reverse voltage at full speed.
        self.rate = 2.0 * volts / inertia if known else math.inf
        self._jump, self._inertia = jump if known else 0.0, inertia
        self._load = gains.feedforward_static + LOAD_SHARE * volts
        self._back_emf, self._lag = gains.feedforward_velocity, lag

    def reset(self) -> None:
        """Discard past readings, as after lost feedback."""
        self._kept = self._last = math.nan
        self._drive = 0.0  # peak accelerating voltage, decaying with the lag [V]

    def _max_change(self, voltage: float, dt: float, count: float, asked: float) -> float:
        """Return the plausible change within one sample [rad/s]."""
        if not self._known:
            kept = self._kept if self._kept == self._kept else 0.0
            return _UNKNOWN_MOTOR_JUMP + _UNKNOWN_MOTOR_SHARE * max(abs(kept), abs(asked)) + count
        if not self._jump:
            return max(self.max_jump, self.rate * dt) + count
        drive = abs(voltage - self._back_emf * self._kept) + self._load
        faded = self._drive + dt / (2.0 * (self._lag + dt)) * (drive - self._drive)
        self._drive = drive if not drive < faded else faded  # NaN: first reading
        return self._jump + self._drive / self._inertia * dt

    def accepts(
        self,
        speed: float,
        dt: float,
        voltage: float = 0.0,
        count: float = 0.0,
        asked: float = 0.0,
    ) -> bool:
        """Return whether a speed [rad/s] is plausible at a voltage.

        ``count`` is the change of the speed by one count [rad/s], ``asked`` is the set-point.
        """
        most = self._max_change(voltage, dt, count, asked)
        last, self._last = self._last, speed
        change = abs(speed - last)  # NaN: first reading
        beyond = (change / most if change < most else 1.0) - self._usual
        self._usual += (_RISE_WEIGHT if beyond > 0.0 else _FALL_WEIGHT) * beyond
        jumps = abs(speed - self._kept) > most and not change <= most
        if jumps and (
            self._jump
            or self._usual < (_MAX_QUIET_CHANGE if self._known else _MAX_QUIET_CHANGE_UNKNOWN)
        ):
            return False
        self._kept = speed
        return True
