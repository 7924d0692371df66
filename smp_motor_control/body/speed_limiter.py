"""Limits of a body's speed, acceleration and jerk, as ros2_controllers computes them."""

from __future__ import annotations

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


class RateLimiter:
    """Limits of a value and its first two derivatives; None or NaN is no limit.

    Each maximum switches its pair on; a minimum that is not given is the negative maximum,
    and limits for slowing down that are not given are those for speeding up.

    Parameters
    ----------
    min_value, max_value : float or None
        Of the value.
    min_first_derivative_neg, max_first_derivative_pos : float or None
        While the value is negative and falls; while it is positive and rises.
    min_first_derivative_pos, max_first_derivative_neg : float or None
        While the value is positive and falls; while it is negative and rises.
    min_second_derivative, max_second_derivative : float or None
        Of the change of the first derivative.

    Raises
    ------
    ParameterError
        When a minimum is above its maximum.

    References
    ----------
    ros-controls/control_toolbox, ``rate_limiter``: order jerk, acceleration, value.
    """

    def __init__(
        self,
        min_value: float | None = None,
        max_value: float | None = None,
        min_first_derivative_neg: float | None = None,
        max_first_derivative_pos: float | None = None,
        min_first_derivative_pos: float | None = None,
        max_first_derivative_neg: float | None = None,
        min_second_derivative: float | None = None,
        max_second_derivative: float | None = None,
    ) -> None:
        self._value = _pair("value", min_value, max_value)
        self._speeding = _pair(
            "first derivative", min_first_derivative_neg, max_first_derivative_pos
        )
        self._second = _pair("second derivative", min_second_derivative, max_second_derivative)
        self._slowing = None
        if self._speeding is not None:
            falling, rising = self._speeding
            self._slowing = _pair(
                "first derivative while slowing down",
                falling if _absent(min_first_derivative_pos) else min_first_derivative_pos,
                rising if _absent(max_first_derivative_neg) else max_first_derivative_neg,
            )

    def limit(self, v: float, v0: float, v1: float, dt: float) -> Limited:
        """Apply jerk, then acceleration, then value limits.

        Parameters
        ----------
        v : float
            Asked for.
        v0, v1 : float
            Commanded one and two steps before.
        dt : float
            [s].

        Returns
        -------
        Limited
            What may be commanded.

        Raises
        ------
        ParameterError
            When an argument is not finite, or dt is negative.
        """
        value = self.limit_second_derivative(v, v0, v1, dt).value
        value = self.limit_first_derivative(value, v0, dt).value
        value = self.limit_value(value).value
        return _share(value, v)

    def limit_value(self, v: float) -> Limited:
        """Apply the limits of the value alone."""
        _require_finite(v)
        return _share(v if self._value is None else _clamp(v, *self._value), v)

    def limit_first_derivative(self, v: float, v0: float, dt: float) -> Limited:
        """Apply the limits of the first derivative alone."""
        _require_finite(v, v0, dt)
        if self._speeding is None or self._slowing is None:
            return _share(v, v)
        falling = self._slowing[0] if v0 > 0.0 else self._speeding[0]
        rising = self._slowing[1] if v0 < 0.0 else self._speeding[1]
        return _share(v0 + _clamp(v - v0, falling * dt, rising * dt), v)

    def limit_second_derivative(self, v: float, v0: float, v1: float, dt: float) -> Limited:
        """Apply the limits of the second derivative alone, and not while easing off."""
        _require_finite(v, v0, dt, v1)
        change, before = v - v0, v0 - v1
        if self._second is None or (change - before) * change <= 0.0:
            return _share(v, v)
        lower, upper = (bound * dt * dt for bound in self._second)
        return _share(v0 + before + _clamp(change - before, lower, upper), v)


@dataclass(eq=False)
class SpeedLimiter(RateLimiter):
    """A :class:`RateLimiter` with the parameters of a diff_drive_controller; NaN is None.

    Accelerations in reverse and decelerations forward are negative there, as they are here.

    Raises
    ------
    ParameterError
        When a minimum is above its maximum.

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
        super().__init__(*vars(self).values())


def _absent(limit: float | None) -> bool:
    return limit is None or math.isnan(limit)


def _pair(name: str, lower: float | None, upper: float | None) -> tuple[float, float] | None:
    """Return both limits, or None where the upper one is not given."""
    if upper is None or math.isnan(upper):
        return None
    if lower is None or math.isnan(lower):
        lower = -upper
    if lower > upper:
        raise ParameterError(f"minimum of the {name} is {lower}, above its maximum {upper}")
    # Infinity times a time step of 0 would be NaN.
    return max(lower, -sys.float_info.max), min(upper, sys.float_info.max)


def _share(value: float, asked: float) -> Limited:
    return Limited(value, value / asked if asked != 0.0 else 1.0)


def _require_finite(v: float, v0: float = 0.0, dt: float = 0.0, v1: float = 0.0) -> None:
    if not (math.isfinite(v) and math.isfinite(v0) and math.isfinite(v1)):
        raise ParameterError(f"speeds {v}, {v0}, {v1} must be finite")
    if not 0.0 <= dt < math.inf:
        raise ParameterError(f"dt is {dt} s: must be finite and not negative")
