# SPDX-License-Identifier: Apache-2.0
"""Limits of speed, acceleration and jerk, computed as in ros2_controllers."""

import math
import sys
from dataclasses import dataclass
from typing import NamedTuple

from smp_motor_control.errors import ParameterError
from smp_motor_control.fields import described


class LimitedSpeed(NamedTuple):
    """A limited command."""

    value: float  # the limited value, in the unit of the command
    factor: float  # limited over requested value; 1 for a request of 0


def _clamp(value: float, lower: float, upper: float) -> float:
    return min(max(value, lower), upper)


@dataclass(eq=False)
class SpeedLimiter:
    """Limit a speed, its acceleration and its jerk; NaN or None means no limit.

    A maximum enables its limit; the minimum defaults to the negative maximum, and the limits of
    deceleration to those of acceleration.  Signs are those of diff_drive_controller: acceleration
    in reverse and deceleration from forward are negative.

    References
    ----------
    ros-controls/control_toolbox, ``rate_limiter``: order jerk, acceleration, value.
    """

    min_velocity: float | None = described(
        math.nan, "Minimum velocity; NaN: the negative of max_velocity."
    )
    max_velocity: float | None = described(
        math.nan, "Maximum velocity [m/s] or [rad/s]; NaN: no limit."
    )
    max_acceleration_reverse: float | None = described(
        math.nan, "Acceleration in reverse, not positive; NaN: as forward."
    )
    max_acceleration: float | None = described(
        math.nan, "Acceleration forward [m/s^2] or [rad/s^2]; NaN: no limit."
    )
    max_deceleration: float | None = described(
        math.nan, "Deceleration from forward, not positive; NaN: as acceleration."
    )
    max_deceleration_reverse: float | None = described(
        math.nan, "Deceleration from reverse, not negative; NaN: as acceleration."
    )
    min_jerk: float | None = described(math.nan, "Minimum jerk; NaN: the negative of max_jerk.")
    max_jerk: float | None = described(
        math.nan, "Maximum jerk [m/s^3] or [rad/s^3]; NaN: no limit."
    )

    def __post_init__(self) -> None:
        self._velocity = _limit_pair("velocity", self.min_velocity, self.max_velocity)
        self._jerk = _limit_pair("jerk", self.min_jerk, self.max_jerk)
        self._speeding = self._slowing = _limit_pair(
            "acceleration", self.max_acceleration_reverse, self.max_acceleration
        )
        if self._speeding is not None:
            falling, rising = self.max_deceleration, self.max_deceleration_reverse
            self._slowing = _limit_pair(
                "acceleration while slowing down",
                self._speeding[0] if _is_unset(falling) else falling,
                self._speeding[1] if _is_unset(rising) else rising,
            )

    def limit(self, v: float, v0: float, v1: float, dt: float) -> LimitedSpeed:
        """Limit a speed by jerk, then acceleration, then velocity, given its last two values."""
        value = self.limit_jerk(v, v0, v1, dt).value
        value = self.limit_acceleration(value, v0, dt).value
        return _limited(self.limit_velocity(value).value, v)

    def limit_velocity(self, v: float) -> LimitedSpeed:
        """Limit the velocity only."""
        _require_finite(v)
        return _limited(v if self._velocity is None else _clamp(v, *self._velocity), v)

    def limit_acceleration(self, v: float, v0: float, dt: float) -> LimitedSpeed:
        """Limit the acceleration only."""
        _require_finite(v, v0, dt)
        if self._speeding is None or self._slowing is None:
            return _limited(v, v)
        falling = self._slowing[0] if v0 > 0.0 else self._speeding[0]
        rising = self._slowing[1] if v0 < 0.0 else self._speeding[1]
        return _limited(v0 + _clamp(v - v0, falling * dt, rising * dt), v)

    def limit_jerk(self, v: float, v0: float, v1: float, dt: float) -> LimitedSpeed:
        """Limit the jerk only, except while the acceleration decreases."""
        _require_finite(v, v0, dt, v1)
        change, before = v - v0, v0 - v1
        if self._jerk is None or (change - before) * change <= 0.0:
            return _limited(v, v)
        lower, upper = (bound * dt * dt for bound in self._jerk)
        return _limited(v0 + before + _clamp(change - before, lower, upper), v)


def _is_unset(limit: float | None) -> bool:
    return limit is None or math.isnan(limit)


def _limit_pair(name: str, lower: float | None, upper: float | None) -> tuple[float, float] | None:
    """Return both limits, or None where the upper one is not given."""
    if upper is None or math.isnan(upper):
        return None
    if lower is None or math.isnan(lower):
        lower = -upper
    if not lower <= 0.0 <= upper:
        raise ParameterError(
            f"minimum of the {name} is {lower} and its maximum {upper}; they must enclose zero, or "
            "the body cannot stop"
        )
    # Infinity times a time step of 0 would be NaN.
    return max(lower, -sys.float_info.max), min(upper, sys.float_info.max)


def _limited(value: float, requested: float) -> LimitedSpeed:
    return LimitedSpeed(value, value / requested if requested != 0.0 else 1.0)


def _require_finite(v: float, v0: float = 0.0, dt: float = 0.0, v1: float = 0.0) -> None:
    if not (math.isfinite(v) and math.isfinite(v0) and math.isfinite(v1)):
        raise ParameterError(f"speeds {v}, {v0}, {v1} must be finite")
    if not 0.0 <= dt < math.inf:
        raise ParameterError(f"dt is {dt} s; it must be finite and not negative")
