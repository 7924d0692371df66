# SPDX-License-Identifier: Apache-2.0
"""Designed gains on the running wheel controller with simulated hardware."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from bench_scripts import load
from wheel_simulation import Run, Timing, simulate_closed_loop

from smp_motor_control.fields import build_settings, parameters_in
from smp_motor_control.motor.file import load_motors
from smp_motor_control.motor.hardware import DrivenMotor, DriveSettings
from smp_motor_control.motor.parameters import MotorModel
from smp_motor_control.parameter_file import flatten
from smp_motor_control.reference.profile import ProfileLimits, Reference
from smp_motor_control.reference.time_optimal import VoltageLimited
from smp_motor_control.wheel.controller import State, WheelController, WheelSettings
from smp_motor_control.wheel.loop import LoopSettings, WheelLoop
from smp_motor_ident.cli.tuning import read_estimates
from smp_motor_ident.tune import Design, Loop, design, design_wheels
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.motors import make_motors
from smp_motor_ident.tune.plant import sample
from smp_motor_ident.tune.reference import planned_change
from smp_motor_ident.tune.simulation import Controller, Inputs, simulate
from smp_motor_ident.tune.writing import describe_slow_loop, parameters, silence

MOTORS = Path(__file__).resolve().parents[2] / "config" / "motors_paper.yaml"
ENTRIES, TOGETHER = load_motors(MOTORS), load("together")
STEP = 1.2
"""Set-point [rad/s, wheel]: about half of the slowest motor's top speed."""


def settings_of(one) -> LoopSettings:
    ratio, plan = one.loop.gear_ratio, one.reference
    return LoopSettings(
        gains=one.gains,
        limits=ProfileLimits(
            velocity=plan.max_velocity / ratio, acceleration=plan.max_acceleration / ratio
        ),
        transition_time=plan.transition_time,
        reference_delay=plan.lag,
        reference_delay_uncertainty=plan.doubt,
        drive=replace(plan.drive, top_speed=plan.drive.top_speed / ratio),
        model=MotorModel(**one.motor),
    )


def drive_motor(wheel: str, one: Design, setpoint: Callable[[float], float], seconds: float) -> Run:
    """Return the simulated drive of a motor of the paper with its design."""
    return simulate_closed_loop(
        ENTRIES[wheel], settings_of(one), setpoint, seconds,
        timing=Timing(sample_time=one.loop.sample_time, delay=one.loop.expected_delay),
        drive=DriveSettings(command_timeout=np.inf, pwm_steps=1000),
    )  # fmt: skip


@pytest.fixture(scope="module")
def estimates():
    return read_estimates(MOTORS)


@pytest.mark.parametrize("share", [0.05, 0.9])
@pytest.mark.parametrize(("T", "static"), [(0.005, 0.0), (0.005, 0.5), (2e-4, 0.5)])
def test_the_wheel_loop_applies_the_designed_feed_forward(estimates, share, T, static):
    one = design(estimates["front_left"], Loop(sample_time=T))
    settings = settings_of(one)
    loop = WheelLoop(replace(settings, gains=replace(settings.gains, feedforward_static=static)))
    loop.start(0.0)
    target = share * one.reference.max_velocity
    ratio = one.loop.gear_ratio
    outs, references = [], []
    for _ in range(80):
        out = loop.step(target / ratio, loop.reference.velocity, T)
        outs.append(out.feedforward)
        references.append(loop.reference.velocity * ratio)
    time = T * np.arange(80)
    plant = sample(make_motors(estimates["front_left"]), one.loop)
    planned = planned_change(plant, one.reference, target, time)
    # Both interpolate linearly between the same samples.
    np.testing.assert_allclose(references, planned.reference, atol=1e-9 * target)
    forward = planned.forward + static * planned.friction
    np.testing.assert_allclose(outs, forward, atol=1e-9 * 12)
    # From rest the feed-forward exceeds friction: it includes the rate of its current.
    assert planned.friction.max() > 1.5


def test_saturated_feed_forward_without_error_does_not_wind_the_integral(estimates):
    """As in the running controller, there is no back-calculation while the error is zero."""
    plant = sample(make_motors(estimates["front_left"]), Loop(sample_time=0.005))
    controller = Controller(Feedback(0.1, 1.0), limit=12.0, tracking=0.01)
    lead = np.where(np.arange(40) < 3, 20.0, 5.0)
    run = simulate(plant, controller, Inputs(np.full(40, -1e9), np.full(40, 1e9), lead))
    np.testing.assert_array_equal(run.voltage[0], np.minimum(lead, 12.0))


@pytest.mark.parametrize("rate", [100.0, 200.0, 1000.0])
@pytest.mark.parametrize("share", [0.3, 0.6])
def test_single_wheel_settles_as_fast_as_its_voltage_allows(estimates, rate, share):
    T = 1 / rate
    one = design(estimates["rear_right"], Loop(sample_time=T))
    drive, ratio = one.reference.drive, one.loop.gear_ratio
    target = share * drive.top_speed / ratio
    run = drive_motor("rear_right", one, lambda time: target, 0.6)
    outside = np.flatnonzero(np.abs(run.velocity - target) > 0.02 * target)
    arrived = run.time[outside[-1] + 1]
    quickest = VoltageLimited(
        Reference(0.0, 0.0, 0.0), target, replace(drive, top_speed=drive.top_speed / ratio), T
    ).duration
    # First sample, delay, and what rounding up to samples and the least duration add.
    assert arrived <= max(quickest, one.reference.transition_time) + one.loop.loop_delay + 2 * T
    assert run.velocity.max() < 1.02 * target


def test_friction_feed_forward_switches_in_time_at_a_reversal(estimates):
    T = 0.005
    designs = design_wheels(estimates, {wheel: Loop(sample_time=T) for wheel in estimates}).designs
    for wheel, one in designs.items():
        run = drive_motor(wheel, one, lambda time: 1.0 if time < 1.0 else -2.0, 2.0)
        # 0.9 % of the change for the slowest winding; switched with the delayed reference, 2.2 %.
        assert run.velocity.min() > -2.0 - 0.013 * 3.0


@pytest.mark.parametrize("rate", [1.0, 2.0, 4.0, 5.0, 10.0, 20.0])
def test_slow_loop_reaches_its_set_point_despite_lost_samples(estimates, rate):
    T, entry = 1 / rate, ENTRIES["front_left"]
    one = design(estimates["front_left"], Loop(sample_time=T))
    written = flatten(parameters(one))
    values = {name: field.default for name, field in parameters_in(WheelSettings).items()}
    settings = build_settings(WheelSettings, {**values, **written})
    wheel = WheelController(WheelSettings())
    wheel.check(settings)
    wheel.configure(settings)
    wheel.set_hardware(entry.gearbox, entry.encoder, entry.supply_voltage)
    held = DriveSettings(command_timeout=silence(one.loop), latch=True)
    plant = DrivenMotor(entry, held, start=100.0)
    wheel.activate(100.0)
    speeds, target, begun = [], 0.5 * one.wheel_reference.max_velocity, 0
    for k in range(1, 80):
        now = 100.0 + k * T
        if k % 7 == 3:
            continue  # every seventh sample is lost
        sample = plant.sample(now)
        wheel.take_setpoint(target, now)
        late = now + 0.05 * T
        wheel.tick(late)
        stamp = round(1e9 * now)
        answer = wheel.take_feedback(
            SimpleNamespace(**sample._asdict()), stamp, stamp + round(5e7 * T), late
        )
        if answer is not None:
            plant.command(late, answer)
        begun += wheel.state is State.DRIVING
        speeds.append(sample.velocity)
    assert begun > 55
    assert np.mean(speeds[-20:]) == pytest.approx(target, rel=0.1)
    assert bool(describe_slow_loop(one)) is (silence(one.loop) > 0.2)


@pytest.fixture(scope="module")
def found():
    return TOGETHER.identify_recorded(ENTRIES, 200.0, seed=11, duration=10.0)


@pytest.mark.parametrize(("rate", "most"), [(100.0, 0.010), (200.0, 0.005), (1000.0, 0.005)])
def test_four_motors_under_uneven_load_settle_together_without_overshoot(found, rate, most):
    runs = TOGETHER.compare(ENTRIES, found, rate, seed=11)
    plain, arrival = (TOGETHER.assess(runs[way]) for way in ("plain", "together"))
    # The bounds: one control period, 5 ms at 1 kHz; overshoot below 1 %.
    assert arrival.spread <= most
    assert max(arrival.overshoot.values()) < 1.0
    # The common reference causes it: under a plain step the same loops are far apart.
    assert plain.spread > 3.0 * arrival.spread
