# SPDX-License-Identifier: Apache-2.0
"""Stop rule, and the holding voltage of a wheel at standstill.

``stop_time`` after a zero set-point the wheel is no longer driven.  Silence of set-points counts as
a zero set-point.  The reference normally reaches zero earlier; otherwise it is set to zero, and an
integral that still turns the wheel is dropped.

Integral action, quantisation and dry friction cause a limit cycle of one count.  The mean voltage
of the cycle replaces it; the voltage fades to zero unless the wheel moves without it.
Times are in seconds on a steady clock.
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


STANDSTILL_TIME_S = 0.3
"""Time within one count that counts as standstill: some cycles of the slowest loop; the mean is
taken over its second half."""


FADE_TIME_S = 0.5 * STANDSTILL_TIME_S
"""Time in which the voltage fades, shorter than the detection of a stall."""


class Standstill:
    """Find the holding voltage of a wheel while its reference is zero."""

    def __init__(self) -> None:
        self._needed = False  # whether the wheel ever moved when the voltage faded
        self.reset()

    def reset(self) -> None:
        """Restart, as at a non-zero set-point."""
        self._left = 1.0  # fraction of the mean voltage
        self._begin()

    def _begin(self) -> None:
        self._count: int | None = None
        self._time = self._mean_time = self._volt_seconds = 0.0

    def step(self, count: int, voltage: float, dt: float) -> None:
        """Add a count and the voltage commanded after it."""
        if self._moved(count):
            self._needed = self._needed or self._left < 1.0
            self._left = 1.0
            self._begin()
            self._count = count
        self._time += dt
        if self._time > 0.5 * STANDSTILL_TIME_S:
            self._mean_time += dt
            self._volt_seconds += voltage * dt

    def voltage(self, count: int, dt: float = 0.0) -> float | None:
        """Return the holding voltage [V] of a wheel that stands; None if it does not."""
        if self._time < STANDSTILL_TIME_S or self._moved(count):
            return None
        if not self._needed:
            self._left = max(self._left - dt / FADE_TIME_S, 0.0)
        return self._left * self._volt_seconds / self._mean_time

    def _moved(self, count: int) -> bool:
        return self._count is None or not -1 <= count - self._count <= 1
