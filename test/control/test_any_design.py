# SPDX-License-Identifier: Apache-2.0
"""No motor, period or accepted setting ends a running loop."""

from __future__ import annotations

import math

import numpy as np
import pytest

from smp_motor_control.encoder import Encoder
from smp_motor_control.errors import ParameterError
from smp_motor_control.fields import settings_of
from smp_motor_control.motor import Gearbox, MotorParameters
from smp_motor_control.motor.file import MotorEntry
from smp_motor_control.motor.hardware import DrivenMotor, DriveSettings
from smp_motor_control.motor.model import MotorModel
from smp_motor_control.observer import ObserverNoise
from smp_motor_control.pid import STRATEGIES, PidGains
from smp_motor_control.reference.profile import Drive, ProfileLimits
from smp_motor_control.wheel.loop import LoopSettings, WheelLoop

GEARBOX, ENCODER = Gearbox(30.0), Encoder(500.0)
STEPS = 60  # 20 of them are the observer's learning of the interval


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
    """Gains that place a pole at the bandwidth, with the motor's own equation fed forward."""
    a0, tau = GEARBOX.ratio / model.dc_gain, model.time_constant
    gains = PidGains(
        p=a0 * tau * bandwidth,
        i=a0 * bandwidth,
        u_clamp_min=-supply,
        u_clamp_max=supply,
        antiwindup_strategy="back_calculation",
        feedforward_static=model.static_voltage,
        feedforward_velocity=a0,
        feedforward_acceleration=a0 * tau,
    )
    drive = Drive(
        top_speed=GEARBOX.to_wheel(0.9 * model.dc_gain * supply),
        time_constant=tau,
        time_constant_product=model.time_constant_product,
    )
    return LoopSettings(
        gains=gains,
        transition_time=0.05,
        speed_source="observer",
        model=model,
        reference_delay=1e-3,
        drive=drive,
    )


def drive_a_wheel(
    settings: LoopSettings, entry: MotorEntry, dt: float, setpoint: float, steps: int = STEPS
) -> float:
    """Run a loop on its motor; return the largest voltage that it asked for."""
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
    parameters = MotorParameters.from_combinations(
        dc_gain=model.dc_gain,
        time_constant=model.time_constant,
        time_constant_product=model.time_constant_product,
        static_voltage=model.static_voltage,
    )
    return MotorEntry(parameters, GEARBOX, ENCODER, supply, delay=model.delay)


def run_designs(count: int, seed: int) -> None:
    """Start the loop on so many random motors at random rates."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        electrical, dt = log_uniform(rng, 1e-5, 1e-2), log_uniform(rng, 2e-4, 5e-2)
        model = random_model(rng, log_uniform(rng, 5e-3, 1.0), electrical)
        supply = 12.0
        bandwidth = min(0.2 / dt, 3.0 / model.time_constant)
        settings = model_based_settings(model, supply, bandwidth)
        speed = GEARBOX.to_wheel(0.5 * model.dc_gain * supply)
        assert drive_a_wheel(settings, entry_of(model, supply), dt, speed) <= supply


def test_no_motor_at_any_rate_ends_its_loop() -> None:
    # 5,000 of them: python test/control/test_any_design.py 5000
    run_designs(60, seed=7)


EXTREMES = (1e-320, 1e-300, 1e-100, 1e-12, 1e-6, 1e-3, 1.0, 1e3, 1e6, 1e12, 1e100, 1e308)


def extreme(rng: np.random.Generator, usual: float, zero: bool = False) -> float:
    """Draw a number that is usual, or anything that a float can be."""
    if rng.random() < 0.6:
        return usual
    chosen = float(rng.choice((*EXTREMES, 0.0) if zero else EXTREMES))
    return chosen


def draw_settings(rng: np.random.Generator) -> LoopSettings:
    """Draw settings as a user may try them; raises ParameterError where they are refused."""
    x = lambda usual, zero=False: extreme(rng, usual, zero)  # noqa: E731
    model = MotorModel(
        dc_gain=x(20.0),
        time_constant=x(0.05),
        time_constant_product=x(1e-4, True),
        static_voltage=x(0.5, True),
        delay=x(1e-3, True),
    )
    gains = PidGains(
        p=x(1.0, True), i=x(5.0, True), d=x(0.01, True),
        antiwindup_strategy=str(rng.choice(STRATEGIES)),
        tracking_time_constant=x(0.0, True), error_deadband=x(0.0, True),
        setpoint_weight_p=x(1.0, True), setpoint_weight_d=x(0.0, True),
        derivative_filter_time_constant=x(0.0, True), feedforward_static=x(0.5, True),
        feedforward_velocity=x(1.5, True), feedforward_acceleration=x(0.1, True),
    )  # fmt: skip
    of_reference = ("max_velocity", "max_acceleration", "max_jerk")
    limits = settings_of(ProfileLimits, {name: x(0.0, True) for name in of_reference})
    drive = None
    if rng.random() < 0.5:
        drive = Drive(top_speed=x(8.0), time_constant=x(0.05), time_constant_product=x(1e-4, True))
    return LoopSettings(
        gains=gains,
        limits=limits,
        transition_time=x(0.1, True),
        speed_source=str(rng.choice(["measured", "difference", "observer"])),
        model=model,
        noise=ObserverNoise(load=x(1.0), voltage=x(0.005), count=x(0.3)),
        reference_delay=x(5e-3, True),
        reference_doubt=x(1e-3, True),
        drive=drive,
    )


def run_extremes(count: int, seed: int) -> int:
    """Run so many accepted settings; return how many drawn ones were refused."""
    rng = np.random.default_rng(seed)
    motor = MotorModel(dc_gain=20.0, time_constant=0.05, time_constant_product=1e-4)
    entry = entry_of(motor, 12.0)
    refused = accepted = 0
    while accepted < count:
        try:
            settings = draw_settings(rng)
        except ParameterError:
            refused += 1
            continue
        accepted += 1
        drive_a_wheel(settings, entry, float(rng.choice([1e-4, 5e-3, 0.05])), extreme(rng, 4.0))
    return refused


def test_accepted_settings_never_end_the_loop() -> None:
    assert run_extremes(60, seed=8) > 60  # most of the draws are absurd


@pytest.mark.parametrize("electrical", [1e-5, 1e-4, 1e-3])
def test_a_fast_electrical_pole_costs_the_observer_nothing(electrical: float) -> None:
    # At 20 Hz L/R of 10 us has decayed by exp(-5000) within a sample.
    rng = np.random.default_rng(9)
    model = random_model(rng, 0.1, electrical)
    settings = model_based_settings(model, 12.0, 4.0)
    speed = GEARBOX.to_wheel(0.5 * model.dc_gain * 12.0)
    assert drive_a_wheel(settings, entry_of(model, 12.0), 0.05, speed, steps=120) <= 12.0


if __name__ == "__main__":
    import sys
    import time

    number = int(sys.argv[1]) if len(sys.argv) > 1 else 5000
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else time.time_ns() % 2**32
    run_designs(number, seed)
    print(f"{number} designs with seed {seed}: none ended its loop")
    print(f"{number} extreme settings accepted, {run_extremes(number, seed)} refused, none ended")
