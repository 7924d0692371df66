# SPDX-License-Identifier: Apache-2.0
"""Public names of the skid-steered body."""

from smp_motor_control.body.kinematics import SkidSteer
from smp_motor_control.body.odometry import Odometry
from smp_motor_control.body.speed_limiter import SpeedLimiter

__all__ = ["Odometry", "SkidSteer", "SpeedLimiter"]
