"""Kinematics of a skid-steered body, by the names that scripts rely on."""

from smp_motor_control.body.kinematics import SkidSteer
from smp_motor_control.body.odometry import Odometry
from smp_motor_control.body.speed_limiter import SpeedLimiter

__all__ = ["Odometry", "SkidSteer", "SpeedLimiter"]
