# SPDX-License-Identifier: Apache-2.0
"""Kinematics of a skid-steered body.

``left = (v - w B/2) / (r m_left)``, ``right = (v + w B/2) / (r m_right)`` with the effective
separation ``B = wheel_separation * wheel_separation_multiplier``; angles counter-clockwise.
"""

import math
from dataclasses import MISSING, dataclass, fields
from typing import NamedTuple

from smp_motor_control.errors import ParameterError
from smp_motor_control.fields import described


class SideSpeeds(NamedTuple):
    """Speeds of the wheels of both sides [rad/s]."""

    # left, right: positive forward
    left: float
    right: float


@dataclass(frozen=True, kw_only=True)
class SkidSteer:
    """Geometry of the body and speed limit of its wheels."""

    wheel_separation: float = described(MISSING, "Distance between left and right wheels [m].")
    wheel_radius: float = described(MISSING, "Radius of the wheels [m].")
    wheel_separation_multiplier: float = described(
        1.0, "Above 1 for a body that turns less than ideal rolling predicts."
    )
    left_wheel_radius_multiplier: float = described(1.0, "Correction of the left radius.")
    right_wheel_radius_multiplier: float = described(1.0, "Correction of the right radius.")
    max_wheel_speed: float = described(
        math.inf, "Maximum speed of every wheel [rad/s]; commands beyond it are scaled.",
        minimum=0.0, name="max_wheel_velocity", zero_is_infinite=True,
    )  # fmt: skip

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not value > 0.0 or (math.isinf(value) and field.name != "max_wheel_speed"):
                raise ParameterError(f"{field.name} is {value}; it must be positive and finite")

    @property
    def effective_separation(self) -> float:
        """Separation [m] of ideally rolling wheels with the same yaw rate."""
        return self.wheel_separation * self.wheel_separation_multiplier

    @property
    def left_radius(self) -> float:
        """Effective radius of the left wheels [m]."""
        return self.wheel_radius * self.left_wheel_radius_multiplier

    @property
    def right_radius(self) -> float:
        """Effective radius of the right wheels [m]."""
        return self.wheel_radius * self.right_wheel_radius_multiplier

    def wheel_speeds(self, linear: float, angular: float) -> SideSpeeds:
        """Return the wheel speeds of a body velocity."""
        half = angular * self.effective_separation / 2.0
        return SideSpeeds((linear - half) / self.left_radius, (linear + half) / self.right_radius)

    def body_velocity(self, left: float, right: float) -> tuple[float, float]:
        """Return the body's (linear, angular) velocity at given wheel speeds."""
        left, right = left * self.left_radius, right * self.right_radius
        return (left + right) / 2.0, (right - left) / self.effective_separation

    def compute_speed_scale(self, linear: float, angular: float) -> float:
        """Return the factor, at most 1, that scales a command to the wheels' speed limit."""
        fastest = max(map(abs, self.wheel_speeds(linear, angular)))
        if math.isinf(fastest):  # overflow
            return 0.0
        return 1.0 if fastest <= self.max_wheel_speed else self.max_wheel_speed / fastest

    def limit_wheel_speeds(self, linear: float, angular: float) -> SideSpeeds:
        """Return the wheel speeds of a command, scaled to their limit."""
        share = self.compute_speed_scale(linear, angular)
        return self.wheel_speeds(linear * share, angular * share)
