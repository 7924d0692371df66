# SPDX-License-Identifier: Apache-2.0
"""Sustained oscillations of a wheel are reported, and nothing else is."""

import math
import random
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from wheel_world import DT, SETTINGS, World

from smp_motor_control.fields import build_settings, parameters_in
from smp_motor_control.motor.file import load_motors
from smp_motor_control.motor.hardware import DrivenMotor, DriveSettings
from smp_motor_control.parameter_file import flatten, read_parameters
from smp_motor_control.pid import PidGains
from smp_motor_control.wheel.controller import State, WheelController, WheelSettings
from smp_motor_control.wheel.loop import LoopSettings
from smp_motor_control.wheel.oscillation import Oscillation

CONFIG = Path(__file__).resolve().parents[2] / "config"


def load_settings(file: str, wheel: str = "front_left") -> WheelSettings:
    """Return the settings of a parameter file, as wheel_pid makes them."""
    known = parameters_in(WheelSettings)
    values = {name: entry.default for name, entry in known.items()}
    format_parameters = flatten(read_parameters(CONFIG / file)[f"/**/{wheel}/wheel_pid"])
    return build_settings(WheelSettings, {**values, **format_parameters})


def proportional_only(p: float) -> WheelSettings:
    clamped = PidGains(p=p, u_clamp_min=-12.0, u_clamp_max=12.0)
    return replace(SETTINGS, loop=LoopSettings(gains=clamped))


def drive(
    settings, rate, target=lambda t: 1.5, noise=0.0, seconds=8.0, seed=0, motor="front_left",
    latch=True,
):  # fmt: skip
    """Drive a motor of the paper; return the time of detection [s] and the controller."""
    entry, draw = load_motors(CONFIG / "motors_paper.yaml")[motor], random.Random(seed)
    wheel = WheelController(settings)
    wheel.set_hardware(entry.gearbox, entry.encoder, entry.supply_voltage)
    plant = DrivenMotor(entry, DriveSettings(pwm_steps=1000, latch=latch), start=100.0)
    wheel.activate(100.0)
    found = math.inf
    for k in range(1, round(seconds * rate)):
        now = 100.0 + k / rate
        sample = plant.sample(now)
        sample = sample._replace(velocity=sample.velocity + draw.gauss(0.0, noise))
        wheel.take_setpoint(target(now - 100.0), now)
        stamp = round(1e9 * now)
        answer = wheel.take_feedback(SimpleNamespace(**sample._asdict()), stamp, stamp, now)
        wheel.tick(now)
        if answer is not None:
            plant.command(now, answer)
        if wheel.oscillation.found is not None:
            found = min(found, k / rate)
    return found, wheel


def test_oscillation_of_paper_gains_at_50_hz_is_found_without_model():
    settings = load_settings("gains_paper.yaml")
    assert settings.loop.model is None and settings.loop.drive is None
    found, wheel = drive(settings, 50.0)
    oscillation = wheel.oscillation.found
    assert found < 2.0 and wheel.state is State.DRIVING
    # The true speed oscillates by 4 rad/s peak to peak, with eight samples per period.
    assert oscillation.amplitude == pytest.approx(2.0, abs=0.4)
    assert oscillation.frequency == pytest.approx(6.1, abs=0.4)


@pytest.mark.parametrize(
    ("rate", "p"), [(20.0, 50.0), (50.0, 10.0), (100.0, 10.0), (200.0, 20.0), (200.0, 300.0)]
)
def test_oscillation_of_unstable_gains_is_found_at_any_rate(rate, p):
    found, wheel = drive(proportional_only(p), rate)
    assert found < 5.0 and wheel.state is State.DRIVING


@pytest.mark.parametrize(("rate", "p"), [(15.0, 15.0), (33.0, 6.0), (33.0, 60.0)])
def test_oscillation_with_few_samples_per_period_is_found(rate, p):
    """Three to five samples per period, in a slow loop on the most powerful motor."""
    found, wheel = drive(proportional_only(p), rate, lambda t: -2.0, motor="rear_left", latch=False)
    assert found < 5.0 and wheel.state is State.DRIVING


@pytest.mark.parametrize("rate", [100.0, 200.0, 500.0])
@pytest.mark.parametrize("speed", [0.0, 0.02, 0.1, 0.5, 2.4])
def test_stable_loop_is_not_reported_at_any_speed(rate, speed):
    found, _ = drive(load_settings("gains.yaml"), rate, lambda t: speed, seconds=6.0)
    assert found == math.inf


@pytest.mark.parametrize(
    "target",
    [
        lambda t: 1.5 * math.sin(2 * math.pi * t),
        lambda t: 1.5 if t % 0.6 < 0.3 else -1.5,
        lambda t: 2.0 * round(math.sin(9.0 * t)),
    ],
)
def test_oscillating_set_point_is_not_reported_as_oscillation(target):
    found, _ = drive(load_settings("gains.yaml"), 200.0, target)
    assert found == math.inf


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("rate", [100.0, 200.0, 500.0])
def test_measurement_noise_is_not_reported_as_oscillation(rate, seed):
    found, _ = drive(load_settings("gains.yaml"), rate, lambda t: 1.0, 0.3, seed=seed)
    assert found == math.inf


@pytest.mark.parametrize("rate", [10.0, 33.0, 100.0])
def test_white_noise_is_not_reported_as_oscillation_at_any_rate(rate):
    oscillation, draw = Oscillation(), random.Random(7)
    for _ in range(round(600 * rate)):
        oscillation.add(1.0 / rate, 1.0, 1.0 + draw.gauss(0.0, 1.0))
        assert oscillation.found is None


def test_oscillation_report_ends_with_the_oscillation():
    oscillation = Oscillation()
    for k in range(400):
        oscillation.add(0.01, 1.0, 1.0 + 0.8 * math.sin(40.0 * 0.01 * k))
    assert oscillation.found.amplitude == pytest.approx(0.8, abs=0.02)
    assert oscillation.found.frequency == pytest.approx(40.0 / (2 * math.pi), rel=0.02)
    for _ in range(400):
        oscillation.add(0.01, 1.0, 1.0)
    assert oscillation.found is None


def test_count_quantisation_is_not_reported_as_oscillation():
    """One count of 16 per revolution in 10 ms is 39 rad/s."""
    oscillation = Oscillation()
    oscillation.set_count(2 * math.pi / 16)
    for k in range(4000):
        oscillation.add(0.01, 5.0, 39.27 * (math.floor(0.1273 * (k + 1)) - math.floor(0.1273 * k)))
    assert oscillation.found is None


@pytest.mark.parametrize("reading", [-999.0, 999.0, -60.0, -12.0, 8.0, -3.0, 0.0])
@pytest.mark.parametrize("apart", [0.5, 0.2])
def test_isolated_false_readings_do_not_stop_the_wheel(reading, apart):
    """Without drive.*, the motor's top speed and time constant are unknown."""
    world = World().run(2.0)
    every = round(apart / DT)

    def sensor(sample):
        spoilt = round(world.now / DT) % every == 0
        return replace(sample, velocity=reading) if spoilt else sample

    world.sensor = sensor
    worst = 0.0
    for _ in range(1000):
        world.step()
        assert world.wheel.recovery.fault is None
        worst = max(worst, abs(world.speed - 1.5))
    assert world.wheel.recovery.failures == 0 and world.wheel.state is not State.FAULT
    # Gross outliers never reach the loop; at 10 ms a reading of 8 may be an impact.
    assert worst < (0.1 if abs(reading) > 20.0 else 1.0)
