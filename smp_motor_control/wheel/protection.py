"""What ends a test of a motor: too fast, too much current."""

from dataclasses import dataclass

PERSISTENCE = 0.05
"""A limit must be exceeded for so long [s]: one bad sample stops nothing."""


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """What a wheel under test may reach; 0 for anything."""

    speed: float = 0.0  # of the wheel, either way [rad/s]
    current: float = 0.0  # either way [A]


class Protection:
    """Watches the samples of one wheel under test.

    Examples
    --------
    >>> watched = Protection(Bounds(speed=10.0))
    >>> [watched.add(0.02 * k, 0.1, 12.0) for k in range(4)][-1]
    'it turns at 12 rad/s, the limit is 10 rad/s'
    """

    def __init__(self, bounds: Bounds) -> None:
        self._bounds = bounds
        self._since: dict[str, float] = {}

    def add(self, time: float, current: float, speed: float) -> str:
        """Take a sample, as in ``MotorState``; return why the test must end, or nothing."""
        bounds = self._bounds
        if self._exceeds("speed", time, abs(speed) > bounds.speed > 0.0):
            return f"it turns at {abs(speed):.3g} rad/s, the limit is {bounds.speed:.3g} rad/s"
        if self._exceeds("current", time, abs(current) > bounds.current > 0.0):
            return f"its current is {abs(current):.3g} A, the limit is {bounds.current:.3g} A"
        return ""

    def _exceeds(self, what: str, time: float, beyond: bool) -> bool:
        if not beyond:
            self._since.pop(what, None)
            return False
        return time - self._since.setdefault(what, time) >= PERSISTENCE
