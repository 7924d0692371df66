# SPDX-License-Identifier: Apache-2.0
"""Transitions between two speeds, limited in rate or with minimum jerk.

Both start from the present velocity, acceleration and jerk and end with acceleration 0.

*Rate limited*: the fastest transition within acceleration and jerk limits.  The acceleration
rises at maximum jerk, is held, and falls at maximum jerk.

*Minimum jerk*: the fifth-order polynomial in velocity that is determined by

    v(0) = v0, v'(0) = a0, v''(0) = j0,   v(T) = v1, v'(T) = 0, v''(T) = 0,

for a chosen duration T.  From rest it is ``v0 + D (10 s^3 - 15 s^4 + 6 s^5)`` with ``s = t/T``,
``D = v1 - v0``; its peak acceleration is ``15/8 |D|/T`` at ``s = 1/2`` and its peak jerk
``10/sqrt(3) |D|/T^2`` at ``s = (1 -+ 1/sqrt(3))/2``.  Wheels with the same T arrive together.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

from smp_motor_control.errors import check_positive, check_range
from smp_motor_control.fields import described

PEAK_ACCELERATION = 15.0 / 8.0
"""Peak acceleration of the minimum-jerk transition from rest, in units of ``|D|/T``."""

PEAK_JERK = 10.0 / math.sqrt(3.0)
"""Peak jerk of the minimum-jerk transition from rest, in units of ``|D|/T^2``."""


class Reference(NamedTuple):
    """Reference at one instant."""

    velocity: float  # [rad/s]
    acceleration: float  # [rad/s^2]
    jerk: float  # [rad/s^3]


def _limit(name: str, unit: str) -> Any:
    text = f"Maximum {name} of the reference [{unit}]."
    return described(math.inf, text, minimum=0.0, name=f"max_{name}", zero_is_infinite=True)


@dataclass(frozen=True, kw_only=True)
class ProfileLimits:
    """Limits of a reference; infinite means no limit."""

    velocity: float = _limit("velocity", "rad/s")
    acceleration: float = _limit("acceleration", "rad/s^2")
    jerk: float = _limit("jerk", "rad/s^3")

    def __post_init__(self) -> None:
        for name, unit in (("velocity", ""), ("acceleration", "^2"), ("jerk", "^3")):
            value = getattr(self, name)
            if value != math.inf:
                check_range(f"limit of {name}", value, 1e-6, 1e12, f"rad/s{unit}")


class MinimumJerk:
    """Fifth-order polynomial from a moving start to a constant target.

    References
    ----------
    T. Flash and N. Hogan, "The coordination of arm movements", J. Neuroscience 5 (1985),
    equations 5 and 6: the same polynomial in position.
    """

    __slots__ = ("_c", "duration", "start", "target")

    def __init__(self, start: Reference, target: float, duration: float) -> None:
        check_positive("duration of a transition", duration, "s")
        self.start, self.target, self.duration = start, target, duration
        step = target - start.velocity
        slope = start.acceleration * duration
        bend = start.jerk * duration * duration
        self._c = (
            start.velocity,
            slope,
            bend / 2.0,
            10.0 * step - 6.0 * slope - 1.5 * bend,
            -15.0 * step + 8.0 * slope + 1.5 * bend,
            6.0 * step - 3.0 * slope - 0.5 * bend,
        )

    def at(self, t: float) -> Reference:
        """Return the reference at time ``t`` [s]."""
        if t >= self.duration:
            return Reference(self.target, 0.0, 0.0)
        if t <= 0.0:
            return self.start
        c0, c1, c2, c3, c4, c5 = self._c
        s = t / self.duration
        return Reference(
            c0 + s * (c1 + s * (c2 + s * (c3 + s * (c4 + s * c5)))),
            (c1 + s * (2.0 * c2 + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))) / self.duration,
            (2.0 * c2 + s * (6.0 * c3 + s * (12.0 * c4 + s * 20.0 * c5))) / self.duration**2,
        )


class RateLimited:
    """Fastest transition within limits of acceleration and jerk; without limits, a jump."""

    __slots__ = ("_legs", "duration", "target")

    def __init__(self, start: Reference, target: float, limits: ProfileLimits) -> None:
        self.target = target
        self._legs: list[tuple[float, float, float, float]] = []  # (end time, v, a, j) at its start
        self.duration = 0.0
        largest, jerk = limits.acceleration, limits.jerk
        v, a = start.velocity, start.acceleration
        if math.isinf(jerk):
            if math.isfinite(largest):
                self._append(abs(target - v) / largest, v, math.copysign(largest, target - v), 0.0)
            return
        # Compare with the velocity reached when the acceleration is reduced to zero from now on.
        sign = math.copysign(1.0, target - (v + a * abs(a) / (2.0 * jerk)))
        a *= sign
        step = sign * (target - v)
        peak = min(math.sqrt(max(jerk * step + a * a / 2.0, 0.0)), largest)
        rise = math.copysign(jerk, peak - a)
        gained = (peak * peak - a * a) / (2.0 * rise) + peak * peak / (2.0 * jerk)
        v, a, _ = self._append((peak - a) / rise, v, sign * a, sign * rise)
        hold = (step - gained) / peak if peak > 0.0 else 0.0
        if hold > 0.0:
            v, a, _ = self._append(hold, v, sign * peak, 0.0)
        self._append(peak / jerk, v, sign * peak, -sign * jerk)

    def _append(self, length: float, v: float, a: float, j: float) -> Reference:
        self.duration += length
        self._legs.append((self.duration, v, a, j))
        return Reference(v + length * (a + length * j / 2.0), a + length * j, j)

    def at(self, t: float) -> Reference:
        """Return the reference at time ``t`` [s]."""
        begin = 0.0
        for end, v, a, j in self._legs:
            if t < end:
                t -= begin
                return Reference(v + t * (a + t * j / 2.0), a + t * j, j)
            begin = end
        return Reference(self.target, 0.0, 0.0)


def minimum_jerk_duration(step: float, limits: ProfileLimits, least: float = 0.0) -> float:
    """Return the shortest duration of a minimum-jerk transition from rest within limits [s]."""
    size = abs(step)
    return max(
        least,
        PEAK_ACCELERATION * size / limits.acceleration,
        math.sqrt(PEAK_JERK * size / limits.jerk),
    )
