# SPDX-License-Identifier: Apache-2.0
"""The loop's output stays finite for random motors and sample intervals."""

import math

import numpy as np
import pytest
from paper_motors import combinations_of

from smp_motor_control.encoder import Encoder
from smp_motor_control.motor import Gearbox, MotorParameters
from smp_motor_control.motor.file import MotorEntry
from smp_motor_control.motor.hardware import DrivenMotor, DriveSettings
from smp_motor_control.motor.parameters import MotorModel
from smp_motor_control.pid import PidGains
from smp_motor_control.reference.profile import Drive
from smp_motor_control.wheel.loop import LoopSettings, WheelLoop

GEARBOX, ENCODER = Gearbox(30.0), Encoder(500.0)
STEPS = 60  # the observer learns the interval in the first 20


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(10.0 ** rng.uniform(math.log10(low), math.log10(high)))


def random_model(rng: np.random.Generator, tau: float, electrical: float) -> MotorModel:
    return MotorModel(
        dc_gain=log_uniform(rng, 1.0, 200.0),
        time_constant=tau + electrical,
        time_constant_product=tau * electrical,
        static_voltage=rng.choice([0.0, 0.5]),
        delay=rng.choice([0.0, 1.5e-3]),
    )


def model_based_settings(model: MotorModel, supply: float, bandwidth: float) -> LoopSettings:
    """Return gains that place a pole at the bandwidth, with model-based feed-forward."""
    a0, tau = GEARBOX.ratio / model.dc_gain, model.time_constant
    gains = PidGains(
        p=a0 * tau * bandwidth, i=a0 * bandwidth, u_clamp_min=-supply, u_clamp_max=supply,
        antiwindup_strategy="back_calculation", feedforward_static=model.static_voltage,
        feedforward_velocity=a0, feedforward_acceleration=a0 * tau,
    )  # fmt: skip
    drive = Drive(
        top_speed=GEARBOX.to_wheel(0.9 * model.dc_gain * supply),
        time_constant=tau,
        time_constant_product=model.time_constant_product,
    )
    return LoopSettings(gains=gains, transition_time=0.05, speed_source="observer", model=model,
                        reference_delay=1e-3, drive=drive)  # fmt: skip


def drive_a_wheel(settings, entry, dt, setpoint, steps=STEPS):
    """Run a loop on its motor; return the largest commanded voltage."""
    plant = DrivenMotor(entry, DriveSettings(command_timeout=math.inf))
    loop = WheelLoop(
        settings.clamp_to_supply(entry.supply_voltage), entry.gearbox, entry.encoder, 18.0
    )
    largest, time = 0.0, 0.0
    for k in range(steps):
        time += dt
        sample = plant.sample(time)
        speed = loop.speed(dt, sample.velocity, sample.encoder_count, sample.voltage)
        if math.isnan(speed):
            continue
        target = setpoint if k < 2 * steps // 3 else -setpoint
        output = loop.step(target, speed, dt).output
        assert math.isfinite(output)
        largest = max(largest, abs(output))
        plant.command(time, output)
    return largest


def entry_of(model: MotorModel, supply: float) -> MotorEntry:
    parameters = MotorParameters.from_combinations(**combinations_of(model))
    return MotorEntry(parameters, GEARBOX, ENCODER, supply, delay=model.delay)


def test_loop_output_stays_finite_for_random_motors_and_rates():
    rng, supply = np.random.default_rng(7), 12.0
    for _ in range(60):
        electrical, dt = log_uniform(rng, 1e-5, 1e-2), log_uniform(rng, 2e-4, 5e-2)
        model = random_model(rng, log_uniform(rng, 5e-3, 1.0), electrical)
        bandwidth = min(0.2 / dt, 3.0 / model.time_constant)
        settings = model_based_settings(model, supply, bandwidth)
        speed = GEARBOX.to_wheel(0.5 * model.dc_gain * supply)
        assert drive_a_wheel(settings, entry_of(model, supply), dt, speed) <= supply


@pytest.mark.parametrize("electrical", [1e-5, 1e-4, 1e-3])
def test_observer_loop_stays_finite_with_fast_electrical_pole(electrical):
    # At 20 Hz L/R of 10 us has decayed by exp(-5000) within a sample.
    rng = np.random.default_rng(9)
    model = random_model(rng, 0.1, electrical)
    settings = model_based_settings(model, 12.0, 4.0)
    speed = GEARBOX.to_wheel(0.5 * model.dc_gain * 12.0)
    assert drive_a_wheel(settings, entry_of(model, 12.0), 0.05, speed, steps=120) <= 12.0
