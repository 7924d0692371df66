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


def given(file: str, wheel: str = "front_left") -> WheelSettings:
    """Return the settings of a parameter file, as wheel_pid makes them."""
    known = parameters_in(WheelSettings)
    values = {name: entry.default for name, entry in known.items()}
    format_parameters = flatten(read_parameters(CONFIG / file)[f"/**/{wheel}/wheel_pid"])
    return build_settings(WheelSettings, {**values, **format_parameters})


def p_alone(p: float) -> WheelSettings:
    clamped = PidGains(p=p, u_clamp_min=-12.0, u_clamp_max=12.0)
    return replace(SETTINGS, loop=LoopSettings(gains=clamped))


def drive(
    settings, rate, target=lambda t: 1.5, noise=0.0, seconds=8.0, seed=0, motor="front_left",
    latch=True,
):  # fmt: skip
    """Drive one of the paper's motors; return when a swing was found [s], and the controller."""
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


def test_the_papers_gains_at_50_hz_swing_and_are_named_without_a_model():
    settings = given("gains_paper.yaml")
    assert settings.loop.model is None and settings.loop.drive is None
    found, wheel = drive(settings, 50.0)
    swing = wheel.oscillation.found
    assert found < 2.0 and wheel.state is State.DRIVING
    # Peak to peak over 4 rad/s of the true speed, in eight samples a cycle.
    assert swing.amplitude == pytest.approx(2.0, abs=0.4)
    assert swing.frequency == pytest.approx(6.1, abs=0.4)


@pytest.mark.parametrize(
    ("rate", "p"), [(20.0, 50.0), (50.0, 10.0), (100.0, 10.0), (200.0, 20.0), (200.0, 300.0)]
)
def test_gains_beyond_the_limit_of_stability_are_named_at_any_rate(rate, p):
    found, wheel = drive(p_alone(p), rate)
    assert found < 5.0 and wheel.state is State.DRIVING


@pytest.mark.parametrize(("rate", "p"), [(15.0, 15.0), (33.0, 6.0), (33.0, 60.0)])
def test_a_cycle_of_few_samples_is_named(rate, p):
    """Three to five samples of a slow loop on the most powerful of the motors."""
    found, wheel = drive(p_alone(p), rate, lambda t: -2.0, motor="rear_left", latch=False)
    assert found < 5.0 and wheel.state is State.DRIVING


@pytest.mark.parametrize("rate", [100.0, 200.0, 500.0])
@pytest.mark.parametrize("speed", [0.0, 0.02, 0.1, 0.5, 2.4])
def test_a_wheel_that_follows_swings_at_no_speed(rate, speed):
    found, _ = drive(given("gains.yaml"), rate, lambda t: speed, seconds=6.0)
    assert found == math.inf


@pytest.mark.parametrize(
    "target",
    [
        lambda t: 1.5 * math.sin(2 * math.pi * t),
        lambda t: 1.5 if t % 0.6 < 0.3 else -1.5,
        lambda t: 2.0 * round(math.sin(9.0 * t)),
    ],
)
def test_a_wheel_that_is_asked_to_swing_is_not_blamed(target):
    found, _ = drive(given("gains.yaml"), 200.0, target)
    assert found == math.inf


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("rate", [100.0, 200.0, 500.0])
def test_noise_is_not_an_oscillation(rate, seed):
    found, _ = drive(given("gains.yaml"), rate, lambda t: 1.0, 0.3, seed=seed)
    assert found == math.inf


@pytest.mark.parametrize("rate", [10.0, 33.0, 100.0])
def test_white_noise_of_any_rate_is_no_cycle(rate):
    swings, draw = Oscillation(), random.Random(7)
    for _ in range(round(600 * rate)):
        swings.add(1.0 / rate, 1.0, 1.0 + draw.gauss(0.0, 1.0))
        assert swings.found is None


def test_a_swing_is_over_when_its_gains_are():
    swings = Oscillation()
    for k in range(400):
        swings.add(0.01, 1.0, 1.0 + 0.8 * math.sin(40.0 * 0.01 * k))
    assert swings.found.amplitude == pytest.approx(0.8, abs=0.02)
    assert swings.found.frequency == pytest.approx(40.0 / (2 * math.pi), rel=0.02)
    for _ in range(400):
        swings.add(0.01, 1.0, 1.0)
    assert swings.found is None


def test_counts_that_come_and_go_are_no_swing():
    """One of 16 counts a turn in 10 ms is 39 rad/s."""
    swings = Oscillation()
    swings.set_count(2 * math.pi / 16)
    for k in range(4000):
        swings.add(0.01, 5.0, 39.27 * (math.floor(0.1273 * (k + 1)) - math.floor(0.1273 * k)))
    assert swings.found is None


@pytest.mark.parametrize("reading", [-999.0, 999.0, -60.0, -12.0, 8.0, -3.0, 0.0])
@pytest.mark.parametrize("apart", [0.5, 0.2])
def test_a_false_reading_now_and_then_stops_no_wheel(reading, apart):
    """Without drive.*, the motor's abilities are unknown."""
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
    # Gross outliers never reach the loop; at 10 ms a reading of 8 may be a jolt.
    assert worst < (0.1 if abs(reading) > 20.0 else 1.0)
