# SPDX-License-Identifier: Apache-2.0
"""Simulated wheel loops: speed sources, references, limits, and random motors and intervals."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from paper_motors import combinations_of
from wheel_simulation import Timing, simulate_closed_loop, simulate_open_loop

from smp_motor_control import WHEELS
from smp_motor_control.encoder import Encoder
from smp_motor_control.excitation import Fourier
from smp_motor_control.motor import Gearbox, MotorParameters
from smp_motor_control.motor.file import MotorEntry, load_motors
from smp_motor_control.motor.hardware import DrivenMotor, DriveSettings
from smp_motor_control.motor.parameters import MotorModel
from smp_motor_control.pid import PidGains
from smp_motor_control.reference.profile import Drive
from smp_motor_control.wheel.loop import LoopSettings, WheelLoop

MOTORS = load_motors(Path(__file__).parents[2] / "config" / "motors_paper.yaml")
GAINS = PidGains(p=2.5, i=80.0, d=0.05, derivative_filter_time_constant=0.005)


def settings_of(wheel: str, **changes) -> LoopSettings:
    ratio, p = MOTORS[wheel].gearbox.ratio, MOTORS[wheel].parameters
    gains = replace(
        GAINS,
        setpoint_weight_p=0.4,
        antiwindup_strategy="conditional_integration",
        feedforward_static=p.static_voltage,
        feedforward_velocity=ratio * p.a0,
        feedforward_acceleration=ratio * p.a1,
    )
    model = MotorModel(**combinations_of(p))
    return LoopSettings(**{"gains": gains, "transition_time": 0.2, "model": model, **changes})


def test_open_loop_speed_matches_dc_gain():
    entry = MOTORS["rear_left"]
    run = simulate_open_loop(entry, lambda t: 8.0, 3.0)
    p = entry.parameters
    expected = entry.gearbox.to_wheel(p.dc_gain * (8.0 - p.static_voltage))
    assert run.velocity[-1] == pytest.approx(expected, rel=1e-6)


def test_recorded_voltage_reproduces_motion_under_jitter_and_delay():
    from smp_motor_control.motor.friction import Motor

    entry = MOTORS["rear_left"]
    signal = Fourier(amplitude=10.0)
    for timing in (Timing(), Timing(delay=0.005), Timing(jitter=0.001)):
        run = simulate_open_loop(entry, signal, 5.0, timing=timing, seed=2)
        motor = Motor(entry.parameters)
        for dt, voltage in zip(np.diff(run.time), run.voltage[1:]):
            motor.step(float(voltage), float(dt))
        # Exact if a command holds for a whole interval; a delay averages two of them.
        exact = timing.delay in (0.0, timing.sample_time) and timing.jitter == 0.0
        tolerance = 1e-6 if exact else 0.05
        assert entry.gearbox.to_wheel(motor.speed) == pytest.approx(run.velocity[-1], abs=tolerance)


@pytest.mark.parametrize("wheel", WHEELS)
@pytest.mark.parametrize("source", ["measured", "difference", "observer"])
def test_step_overshoot_is_below_2_percent_with_every_speed_source(wheel, source):
    run = simulate_closed_loop(
        MOTORS[wheel],
        settings_of(wheel, speed_source=source, difference_window=2),
        lambda t: 2.0 if t >= 0.5 else 0.0,
        2.5,
        timing=Timing(delay=0.001),
    )
    assert np.max(run.velocity) < 2.0 * 1.02
    late = run.velocity[run.time > 1.0]
    assert np.all(np.abs(late - 2.0) < 0.02 * 2.0)


def test_integral_rejects_constant_load():
    run = simulate_closed_loop(
        MOTORS["rear_right"],
        settings_of("rear_right"),
        lambda t: 1.5,
        4.0,
        load=lambda t: 0.6 if t > 2.0 else 0.0,
    )
    assert np.mean(run.velocity[run.time > 3.5]) == pytest.approx(1.5, rel=0.005)


def test_simulation_is_reproducible_by_seed():
    entry, drive = MOTORS["front_right"], DriveSettings(current_noise=0.05, torque_noise=1e-5)
    one, same, other = (
        simulate_open_loop(entry, lambda t: 5.0, 1.0, drive=drive, seed=seed) for seed in (1, 1, 2)
    )
    assert np.array_equal(one.current, same.current)
    assert not np.array_equal(one.current, other.current)


def test_settings_change_is_bumpless():
    loop = WheelLoop(settings_of("rear_left", transition_time=0.0))
    loop.start(1.0)
    for _ in range(50):
        before = loop.step(1.5, 1.45, 0.005)
    loop.configure(settings_of("rear_left", gains=replace(GAINS, p=6.0)))
    after = loop.step(1.5, 1.45, 0.005)
    # One step of the integral and of the changed derivative at most.
    assert after.output == pytest.approx(before.output, abs=0.1)


@pytest.mark.parametrize("delays", [(0.0, 0.4), (0.4, 0.0)])
def test_reference_delay_change_while_driving_is_bumpless(delays):
    before, after = (settings_of("rear_left", reference_delay=delay) for delay in delays)
    loop = WheelLoop(before)
    loop.start(0.0)
    for _ in range(400):
        out = loop.step(1.5, 1.5, 0.005)
    loop.configure(after)
    changed = [loop.step(1.5, 1.5, 0.005).output for _ in range(50)]
    assert loop.reference.velocity == pytest.approx(1.5)
    # Without a control error only the composition of the feed-forward changes.
    assert changed == pytest.approx([out.output] * 50, abs=0.1)


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
