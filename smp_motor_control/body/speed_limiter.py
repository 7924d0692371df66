"""Limits of a body's speed, acceleration and jerk, as ros2_controllers computes them."""

import math
import sys
from dataclasses import dataclass
from typing import NamedTuple

from smp_motor_control.errors import ParameterError
from smp_motor_control.fields import described


class Limited(NamedTuple):
    """A limited command."""

    value: float  # what may be commanded, in the unit of the command
    factor: float  # its share of what was asked; 1 where nothing was asked


def _clamp(value: float, lower: float, upper: float) -> float:
    return min(max(value, lower), upper)


@dataclass(eq=False)
class SpeedLimiter:
    """Limits of a speed, its acceleration and its jerk; NaN or None is no limit.

    Each maximum switches its pair on; a minimum that is not given is the negative maximum, and
    limits for slowing down that are not given are those for speeding up.  Accelerations in reverse
    and decelerations forward are negative, as in diff_drive_controller.

    Raises
    ------
    ParameterError
        When a pair does not enclose zero: a body with such limits cannot be stopped.

    References
    ----------
    ros-controls/control_toolbox, ``rate_limiter``: order jerk, acceleration, value.

    Examples
    --------
    >>> SpeedLimiter(max_velocity=1.0, max_acceleration=2.0).limit(3.0, 0.0, 0.0, 0.1).value
    0.2
    """

    min_velocity: float | None = described(
        math.nan, "Lowest velocity; NaN takes the negative of max_velocity."
    )
    max_velocity: float | None = described(
        math.nan, "Highest velocity [m/s] or [rad/s]; NaN for no limit."
    )
    max_acceleration_reverse: float | None = described(
        math.nan, "Speeding up in reverse, not positive; NaN as forward."
    )
    max_acceleration: float | None = described(
        math.nan, "Speeding up forward [m/s^2] or [rad/s^2]; NaN for no limit."
    )
    max_deceleration: float | None = described(
        math.nan, "Slowing down from forward, not positive; NaN as speeding up."
    )
    max_deceleration_reverse: float | None = described(
        math.nan, "Slowing down from reverse, not negative; NaN as speeding up."
    )
    min_jerk: float | None = described(math.nan, "Lowest jerk; NaN takes the negative of max_jerk.")
    max_jerk: float | None = described(
        math.nan, "Highest jerk [m/s^3] or [rad/s^3]; NaN for no limit."
    )

    def __post_init__(self) -> None:
        self._velocity = _pair("velocity", self.min_velocity, self.max_velocity)
        self._jerk = _pair("jerk", self.min_jerk, self.max_jerk)
        self._speeding = self._slowing = _pair(
            "acceleration", self.max_acceleration_reverse, self.max_acceleration
        )
        if self._speeding is not None:
            falling, rising = self.max_deceleration, self.max_deceleration_reverse
            self._slowing = _pair(
                "acceleration while slowing down",
                self._speeding[0] if _absent(falling) else falling,
                self._speeding[1] if _absent(rising) else rising,
            )

    def limit(self, v: float, v0: float, v1: float, dt: float) -> Limited:
        """Limit a speed by jerk, then acceleration, then velocity, after its last two."""
        value = self.limit_jerk(v, v0, v1, dt).value
        value = self.limit_acceleration(value, v0, dt).value
        return _share(self.limit_velocity(value).value, v)

    def limit_velocity(self, v: float) -> Limited:
        """Apply the limits of the velocity alone."""
        _require_finite(v)
        return _share(v if self._velocity is None else _clamp(v, *self._velocity), v)

    def limit_acceleration(self, v: float, v0: float, dt: float) -> Limited:
        """Apply the limits of the acceleration alone."""
        _require_finite(v, v0, dt)
        if self._speeding is None or self._slowing is None:
            return _share(v, v)
        falling = self._slowing[0] if v0 > 0.0 else self._speeding[0]
        rising = self._slowing[1] if v0 < 0.0 else self._speeding[1]
        return _share(v0 + _clamp(v - v0, falling * dt, rising * dt), v)

    def limit_jerk(self, v: float, v0: float, v1: float, dt: float) -> Limited:
        """Apply the limits of the jerk alone, and not while easing off."""
        _require_finite(v, v0, dt, v1)
        change, before = v - v0, v0 - v1
        if self._jerk is None or (change - before) * change <= 0.0:
            return _share(v, v)
        lower, upper = (bound * dt * dt for bound in self._jerk)
        return _share(v0 + before + _clamp(change - before, lower, upper), v)


def _absent(limit: float | None) -> bool:
    return limit is None or math.isnan(limit)


def _pair(name: str, lower: float | None, upper: float | None) -> tuple[float, float] | None:
    """Return both limits, or None where the upper one is not given."""
    if upper is None or math.isnan(upper):
        return None
    if lower is None or math.isnan(lower):
        lower = -upper
    if not lower <= 0.0 <= upper:
        raise ParameterError(
            f"minimum of the {name} is {lower} and its maximum {upper}; they must enclose zero, or "
            "the body could not stand"
        )
    # Infinity times a time step of 0 would be NaN.
    return max(lower, -sys.float_info.max), min(upper, sys.float_info.max)


def _share(value: float, asked: float) -> Limited:
    return Limited(value, value / asked if asked != 0.0 else 1.0)


def _require_finite(v: float, v0: float = 0.0, dt: float = 0.0, v1: float = 0.0) -> None:
    if not (math.isfinite(v) and math.isfinite(v0) and math.isfinite(v1)):
        raise ParameterError(f"speeds {v}, {v0}, {v1} must be finite")
    if not 0.0 <= dt < math.inf:
        raise ParameterError(f"dt is {dt} s: must be finite and not negative")
