# SPDX-License-Identifier: Apache-2.0
"""Speed and current limits of a motor under test."""

from dataclasses import dataclass

PERSISTENCE_S = 0.05  # time above a limit that ends the test; a single bad sample does not


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """Limits of a wheel under test; 0 means no limit."""

    speed: float = 0.0  # absolute, of the wheel [rad/s]
    current: float = 0.0  # absolute [A]


class Protection:
    """Check the samples of one wheel under test."""

    def __init__(self, bounds: Bounds) -> None:
        self._bounds = bounds
        self._since: dict[str, float] = {}

    def add(self, time: float, current: float, speed: float) -> str:
        """Add a sample of ``MotorState``; return why the test must end, or nothing."""
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
        return time - self._since.setdefault(what, time) >= PERSISTENCE_S
