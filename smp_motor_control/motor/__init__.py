# SPDX-License-Identifier: Apache-2.0
"""The DC motor: parameters, response and simulated hardware."""

from smp_motor_control.motor.friction import Motor
from smp_motor_control.motor.parameters import Gearbox, MotorParameters

__all__ = ["Gearbox", "Motor", "MotorParameters"]
