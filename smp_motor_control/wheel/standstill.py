"""A wheel that is asked to stand, and does: the voltage that it stands with.

Around one edge of the encoder the integral, the load that an observer sees and dry friction make a
relay, which rocks the wheel by a count for ever.  The mean voltage of such a cycle holds it too.
"""

STANDS = 0.3
"""Time [s] for which a wheel has moved by no more than a count when it is taken to stand: some
cycles of the slowest loop, of which the second half makes the mean."""


class Standstill:
    """Follows counts and voltage of a wheel while its reference is zero."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget what was, as when the wheel is asked to turn."""
        self._count: int | None = None
        self._time = self._mean_time = self._volt_seconds = 0.0

    def step(self, count: int, voltage: float, dt: float) -> None:
        """Take in a sample and the voltage that it is answered with."""
        if self._moved(count):
            self.reset()
            self._count = count
        self._time += dt
        if self._time > 0.5 * STANDS:
            self._mean_time += dt
            self._volt_seconds += voltage * dt

    def voltage(self, count: int) -> float | None:
        """Return the mean voltage [V] of a wheel that stands at a count, None where it does not."""
        if self._time < STANDS or self._moved(count):
            return None
        return self._volt_seconds / self._mean_time

    def _moved(self, count: int) -> bool:
        return self._count is None or not -1 <= count - self._count <= 1
