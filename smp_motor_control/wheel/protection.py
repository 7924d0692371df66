"""What ends a test of a motor: too fast, too much current, a winding that became too hot.

The temperature of a winding shows in its resistance.  Over blocks, so that nothing is
differentiated,

    int v dt = R int i dt + K dtheta + L di,

and least squares that forget follow R; with copper's coefficient a,

    dT = (R / R_cold - 1) / a.

References
----------
IEC 60034-1, section 8.6.2.1 (rise in temperature by resistance).
L. Ljung, System Identification, 2nd ed., section 11.2 (least squares that forget).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

COPPER = 0.00393
"""Temperature coefficient of copper's resistance [1/K]."""

PERSISTENCE = 0.05
"""A limit must be exceeded for so long [s]: one bad sample stops nothing."""

BLOCK = 0.25
"""Length of what is summed [s]: shorter, noise of the current weighs more."""

GAP = 0.1
"""Interval between samples after which the motion between them is not known [s]."""

MEMORY = 0.95
"""Weight of a block in the next: of some five seconds, in which copper warms by a few kelvin."""

FEWEST = 8
"""Blocks for three unknowns and their scatter."""

SURE = 2.0
"""Standard deviations by which a rise must exceed its limit."""

KNOWN = 0.03
"""Relative standard deviation of a resistance that others are compared with: 8 K."""


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """What a wheel under test may reach."""

    speed: float = math.inf  # of the wheel, either way [rad/s]
    current: float = math.inf  # either way [A]
    rise: float = math.inf  # of the winding's temperature since it was cold [K]


class Resistance(NamedTuple):
    """A winding's resistance [ohm] and its standard deviation."""

    value: float
    std: float


class Winding:
    """Follows the resistance of one winding.

    Parameters
    ----------
    cold : Resistance, optional
        Before anything warmed it; what the first seconds show, where it is not given.
    """

    def __init__(self, cold: Resistance | None = None) -> None:
        self.cold = cold
        self._last: tuple[float, ...] | None = None
        self._open = [0.0, 0.0, 0.0, 0.0]  # int i dt, dtheta, di, int v dt
        self._length = 0.0
        self._normal = np.zeros((4, 4))
        self._weight = 0.0

    def add(self, time: float, voltage: float, current: float, angle: float) -> bool:
        """Take a sample, as in ``MotorState``; return whether it completed a block."""
        now = (time, current, angle)
        last, self._last = self._last, now if math.isfinite(voltage + sum(now)) else None
        if last is None or self._last is None or not 0.0 < time - last[0] <= GAP:
            self._open, self._length = [0.0, 0.0, 0.0, 0.0], 0.0
            return False
        step = time - last[0]
        amps = 0.5 * (current + last[1])
        new = (amps * step, angle - last[2], current - last[1], voltage * step)
        self._open = [a + b for a, b in zip(self._open, new)]
        self._length += step
        if self._length < BLOCK:
            return False
        self._normal = MEMORY * self._normal + np.outer(self._open, self._open)
        self._weight = MEMORY * self._weight + 1.0
        self._open, self._length = [0.0, 0.0, 0.0, 0.0], 0.0
        if self.cold is None and (found := self.resistance()).std < KNOWN * found.value:
            self.cold = found
        return True

    def resistance(self) -> Resistance:
        """Return what the last seconds show; an infinite deviation where they show nothing."""
        least = (1.0 - MEMORY**FEWEST) / (1.0 - MEMORY)
        if self._weight < least:
            return Resistance(math.nan, math.inf)
        scale = np.sqrt(np.diag(self._normal)[:3])
        scale[scale == 0.0] = 1.0  # a wheel that stands shows no K, and its R all the better
        matrix = self._normal[:3, :3] / np.outer(scale, scale)
        matrix[np.diag_indices(3)] += 1e-9
        inverse = np.linalg.inv(matrix) / np.outer(scale, scale)
        values = inverse @ self._normal[:3, 3]
        left = max(float(self._normal[3, 3] - values @ self._normal[:3, 3]), 0.0)
        variance = left / max(self._weight - 3.0, 1.0) * float(inverse[0, 0])
        return Resistance(float(values[0]), math.sqrt(variance))

    def rise(self) -> tuple[float, float]:
        """Return by how much the winding is warmer than when it was cold, and the deviation [K]."""
        now, cold = self.resistance(), self.cold
        if cold is None or not math.isfinite(now.value):
            return 0.0, math.inf
        unit = COPPER * cold.value
        return (now.value - cold.value) / unit, math.hypot(now.std, cold.std) / unit


class Protection:
    """Watches the samples of one wheel under test.

    Parameters
    ----------
    bounds : Bounds
        What it may reach.
    cold : Resistance, optional
        Of its winding.

    Examples
    --------
    >>> watched = Protection(Bounds(speed=10.0))
    >>> [watched.add(0.02 * k, 6.0, 0.1, 12.0, 0.24 * k) for k in range(4)][-1]
    'it turns at 12 rad/s, the limit is 10 rad/s'
    """

    def __init__(self, bounds: Bounds, cold: Resistance | None = None) -> None:
        self._bounds = bounds
        self.winding = Winding(cold)
        self._since: dict[str, float] = {}

    def add(self, time: float, voltage: float, current: float, speed: float, angle: float) -> str:
        """Take a sample, as in ``MotorState``; return why the test must end, or nothing."""
        bounds = self._bounds
        if self._exceeds("speed", time, abs(speed) > bounds.speed):
            return f"it turns at {abs(speed):.3g} rad/s, the limit is {bounds.speed:.3g} rad/s"
        if self._exceeds("current", time, abs(current) > bounds.current):
            return f"its current is {abs(current):.3g} A, the limit is {bounds.current:.3g} A"
        if self.winding.add(time, voltage, current, angle):
            rise, deviation = self.winding.rise()
            if rise - SURE * deviation > bounds.rise:
                return (
                    f"its winding is {rise:.0f} K warmer than it was cold, by its resistance; the "
                    f"limit is {bounds.rise:.0f} K: let it cool"
                )
        return ""

    def _exceeds(self, what: str, time: float, beyond: bool) -> bool:
        if not beyond:
            self._since.pop(what, None)
            return False
        return time - self._since.setdefault(what, time) >= PERSISTENCE
