# SPDX-License-Identifier: Apache-2.0
"""Holding voltage of a wheel at standstill.

Integral action, quantisation and dry friction cause a limit cycle of one count.  The mean voltage
of the cycle replaces it; the voltage fades to zero unless the wheel moves without it.
"""

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
