# SPDX-License-Identifier: Apache-2.0
"""Stop rule: ``stop_time`` after a zero set-point the wheel is no longer driven.

Silence of set-points counts as a zero set-point.  The reference normally reaches zero earlier;
otherwise it is set to zero, and an integral that still turns the wheel is dropped.  Times are in
seconds on a steady clock.
"""

import math

STANDSTILL_SETPOINT = 1e-3
"""Set-points up to this count as zero [rad/s], such as those of a joystick at rest."""

REST_SPEED = 0.05  # speeds up to this count as standstill [rad/s]

MAX_STOP_TIME_S = 10.0  # maximum of ``stop_time``

AVERAGING_WINDOW_S = 0.5
"""Averaging time of voltage and speed: a few counts of a coarse encoder at ``REST_SPEED``."""


class StopRule:
    """Track the time of a zero set-point and whether the controller still drives the wheel."""

    def __init__(self) -> None:
        self._since = math.inf
        self.watch()

    def watch(self, driven: bool = False) -> None:
        """Start an averaging window; ``driven`` is the result of the previous one."""
        self._driven = driven
        self._time = self._turned = self._volt_seconds = 0.0

    @property
    def is_zero(self) -> bool:
        """Whether the set-point is zero."""
        return self._since < math.inf

    def note_setpoint(self, setpoint: float, now: float) -> None:
        """Note a set-point [rad/s]."""
        if abs(setpoint) > STANDSTILL_SETPOINT:
            self._since = math.inf
            self.watch()
        else:
            self._since = min(self._since, now)

    def is_overdue(self, now: float, stop_time: float) -> bool:
        """Return whether the set-point has been zero for longer than ``stop_time``."""
        return now - self._since > stop_time

    def is_driven(self, dt: float, voltage: float, velocity: float) -> bool:
        """Return whether the wheel turned in the direction of the voltage over the last window.

        A wheel that is pushed, or on a slope, turns against the voltage.
        """
        self._time += dt
        self._turned += velocity * dt
        self._volt_seconds += voltage * dt
        if self._time >= AVERAGING_WINDOW_S:
            forward = self._turned * self._volt_seconds > 0.0
            self.watch(driven=forward and abs(self._turned) > REST_SPEED * self._time)
        return self._driven
