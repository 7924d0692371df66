# SPDX-License-Identifier: Apache-2.0
"""Slow gains, or gains on a slow speed, are tested in equally slow loops."""

from dataclasses import replace

import pytest

from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.parameters import Gearbox, MotorModel
from smp_motor_control.pid import PidGains
from smp_motor_control.wheel.acceptance import OperatingConditions, check
from smp_motor_control.wheel.loop import LoopSettings


def test_a_slow_integral_overshoots_for_long_and_is_stable():
    """A crossover of 5 rad/s, so that the motor's own four time constants end in the overshoot."""
    motor = MotorModel(dc_gain=0.2766, time_constant=0.0702, static_voltage=0.76)
    gains = PidGains(
        p=0.535, i=19.8, u_clamp_min=-24.0, u_clamp_max=24.0, feedforward_static=0.76,
        antiwindup_strategy="back_calculation", tracking_time_constant=0.027,
        feedforward_velocity=3.616, feedforward_acceleration=0.254,
    )  # fmt: skip
    slow = LoopSettings(gains=gains, model=motor, reference_delay=0.0015)
    circumstances = OperatingConditions(sample_time=1e-3, supply=24.0, gearbox=Gearbox(1.0))
    check(slow, circumstances)
    with pytest.raises(ParameterError, match="unstable"):
        check(replace(slow, gains=replace(gains, i=2e4)), circumstances)


def test_gains_for_a_filtered_speed_are_tried_behind_its_filter():
    motor = MotorModel(dc_gain=0.906, time_constant=0.059, static_voltage=0.16)
    gains = PidGains(
        p=3.545, i=33.2, d=0.188, u_clamp_min=-12.0, u_clamp_max=12.0,
        feedforward_velocity=1.104, feedforward_acceleration=0.0653,
    )  # fmt: skip
    circumstances = OperatingConditions(sample_time=0.01, supply=12.0, gearbox=Gearbox(1.0))
    check(LoopSettings(gains=gains, model=motor, reference_delay=0.205), circumstances)
    with pytest.raises(ParameterError, match="unstable"):
        check(LoopSettings(gains=gains, model=motor, reference_delay=0.01), circumstances)
