# SPDX-License-Identifier: Apache-2.0
"""Simulated wheel loops with the robot's components: speed sources, references, limits."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from paper_motors import combinations_of
from wheel_simulation import DriveSettings, Timing, simulate_closed_loop, simulate_open_loop

from smp_motor_control import WHEELS
from smp_motor_control.excitation import Fourier
from smp_motor_control.motor.file import load_motors
from smp_motor_control.motor.parameters import MotorModel
from smp_motor_control.pid import PidGains
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
