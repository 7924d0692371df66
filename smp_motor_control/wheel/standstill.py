"""A wheel that is asked to stand, and does: the voltage that it stands with.

Around one edge of the encoder the integral, the load that an observer sees and dry friction make a
relay, which rocks the wheel by a count for ever.  The mean voltage of such a cycle holds it too.
Friction may hold the wheel without: the voltage fades, until it turns out to be needed.
"""

STANDS = 0.3
"""Time [s] for which a wheel has moved by no more than a count when it is taken to stand: some
cycles of the slowest loop, of which the second half makes the mean."""


FADES = 0.5 * STANDS
"""Time [s] in which the voltage fades: before a wheel that stands would be taken for a stall."""


class Standstill:
    """Follows counts and voltage of a wheel while its reference is zero."""

    def __init__(self) -> None:
        self._needed = False  # whether the wheel moved when the voltage faded, at any stop
        self.reset()

    def reset(self) -> None:
        """Forget what was, as when the wheel is asked to turn."""
        self._left = 1.0  # of the mean voltage
        self._begin()

    def _begin(self) -> None:
        self._count: int | None = None
        self._time = self._mean_time = self._volt_seconds = 0.0

    def step(self, count: int, voltage: float, dt: float) -> None:
        """Take in a sample and the voltage that it is answered with."""
        if self._moved(count):
            self._needed = self._needed or self._left < 1.0
            self._left = 1.0
            self._begin()
            self._count = count
        self._time += dt
        if self._time > 0.5 * STANDS:
            self._mean_time += dt
            self._volt_seconds += voltage * dt

    def voltage(self, count: int, dt: float = 0.0) -> float | None:
        """Return the voltage [V] of a wheel that stands at a count, None where it does not."""
        if self._time < STANDS or self._moved(count):
            return None
        if not self._needed:
            self._left = max(self._left - dt / FADES, 0.0)
        return self._left * self._volt_seconds / self._mean_time

    def _moved(self, count: int) -> bool:
        return self._count is None or not -1 <= count - self._count <= 1
