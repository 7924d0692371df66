"""The DC motor: what it is, how it answers, and how its hardware shows it."""

from smp_motor_control.motor.friction import Motor
from smp_motor_control.motor.parameters import Gearbox, MotorParameters

__all__ = ["Gearbox", "Motor", "MotorParameters"]
