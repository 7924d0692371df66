# SPDX-License-Identifier: Apache-2.0
"""A wheel stops within ``stop_time`` of a zero set-point or of silence, and stands still."""

import math
import random
from dataclasses import replace

import numpy as np
import pytest
from wheel_world import (
    DT,
    GAIN,
    GAINS,
    SETPOINT_TIMEOUT,
    SETTINGS,
    SUPPLY,
    TAU,
    World,
    stop_set_points,
)

from smp_motor_control.encoder import Encoder
from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.parameters import Gearbox, MotorModel
from smp_motor_control.observer import ObserverNoise
from smp_motor_control.pid import PidGains
from smp_motor_control.reference.profile import Drive, ProfileLimits
from smp_motor_control.wheel import stop
from smp_motor_control.wheel.acceptance import OperatingConditions, check
from smp_motor_control.wheel.controller import State, WheelSettings
from smp_motor_control.wheel.loop import LoopSettings, WheelLoop
from smp_motor_control.wheel.stop import (
    AVERAGING_WINDOW_S,
    REST_SPEED,
    STANDSTILL_SETPOINT,
    STANDSTILL_TIME_S,
    Standstill,
)

MODEL = MotorModel(dc_gain=GAIN * 65.5, time_constant=TAU)
KNOWN = OperatingConditions(sample_time=DT, supply=SUPPLY, gearbox=Gearbox(65.5))
SLOW_SETTINGS = {
    "drive": {"drive": Drive(top_speed=3.0, time_constant=1e5)},
    "delay": {"reference_delay": 10.0},
    "delay_uncertainty": {"reference_delay": 0.1, "reference_delay_uncertainty": 1.0},
    "transition": {"transition_time": 60.0},
    "acceleration": {"limits": ProfileLimits(acceleration=0.01)},
    "jerk": {"limits": ProfileLimits(jerk=0.01)},
}
"""Settings whose reference takes more than a second to reach zero."""


def settings(gains: PidGains = GAINS, stop_time: float = 1.0, **loop: object) -> WheelSettings:
    return replace(SETTINGS, loop=LoopSettings(gains=gains, stop_time=stop_time, **loop))


def start_at_speed(world: World, speed: float = 1.5) -> World:
    """Start a wheel and its reference at a speed."""
    world.setpoint = speed
    world.run(0.1)
    world.speed = speed
    world.wheel.loop.start(speed)
    return world.run(1.0)


@pytest.mark.parametrize("stop_time", [0.5, 1.0])
@pytest.mark.parametrize("name", SLOW_SETTINGS)
def test_slow_reference_is_zero_at_stop_time(name, stop_time):
    world = start_at_speed(World(settings(stop_time=stop_time, **SLOW_SETTINGS[name])))
    assert world.speed > 1.0
    world.setpoint = 0.0
    # The reference is zero then; the remaining motion is the loop's response.
    world.run(stop_time + 2 * DT)
    assert world.wheel.loop.reference.velocity == 0.0 and world.held <= 0.0
    world.run(8 * TAU)
    assert abs(world.speed) < REST_SPEED and world.wheel.loop.reference.velocity == 0.0
    world.run(10.0)
    assert abs(world.speed) < REST_SPEED and world.wheel.state is State.DRIVING


@pytest.mark.parametrize("name", SLOW_SETTINGS)
def test_voltage_is_zero_after_set_point_time_out_and_stop_time(name):
    world = start_at_speed(World(settings(**SLOW_SETTINGS[name])))
    stop_set_points(world)
    world.run(SETPOINT_TIMEOUT + 1.0 + 2 * DT)
    assert world.held == 0.0 and world.wheel.setpoint is None
    world.run(6 * TAU)
    assert abs(world.speed) < REST_SPEED


@pytest.mark.parametrize(
    "gains",
    [
        replace(GAINS, p=0.0, i=0.05),
        replace(GAINS, p=0.0, i=20.0, error_deadband=1e3),
        replace(GAINS, p=0.01, i=1e-6),
    ],
)
def test_integral_that_keeps_driving_after_stop_is_cleared(gains):
    blind = replace(SETTINGS.faults, tracking_time=0.0)
    world = World(replace(settings(), faults=blind)).run(2.0)
    # No jump: the integral takes over the contribution of the other terms.
    world.wheel.configure(replace(settings(gains), faults=blind))
    world.run(0.2)
    assert world.speed == pytest.approx(1.5, rel=0.1)
    world.setpoint = 0.0
    world.run(1.0 + AVERAGING_WINDOW_S + 2 * DT + 6 * TAU)
    assert abs(world.speed) < REST_SPEED
    (why,) = world.wheel.refused
    assert "integral" in why and world.wheel.state is State.DRIVING


def test_integral_that_holds_against_slope_or_push_is_kept():
    world = World().run(2.0)
    world.load = 3.0
    world.setpoint = 0.0
    world.run(10.0)
    assert world.held == pytest.approx(-3.0, abs=0.1) and abs(world.speed) < REST_SPEED
    world.load = 3.8
    world.run(3.0)
    assert world.held == pytest.approx(-3.8, abs=0.1)
    assert not world.wheel.refused and world.wheel.state is State.DRIVING
    assert max(abs(speed) for _, _, speed in world.log[-100:]) < REST_SPEED


def test_rolling_after_a_fault_is_not_reported_as_driving():
    world = World().run(2.0)
    world.blocked = True
    world.until(lambda: world.wheel.recovery.fault is not None, 1.5)
    world.blocked, world.load, world.setpoint = False, 3.0, 0.0
    world.until(lambda: world.wheel.recovery.fault is None, 2.0)
    world.run(0.5)
    assert world.held == 0.0 and world.wheel.state is State.ROLLING
    world.load = 0.0
    world.run(1.0)
    assert world.wheel.state is State.DRIVING


def test_joystick_offset_counts_as_zero_set_point():
    world = start_at_speed(World(settings(**SLOW_SETTINGS["transition"])))
    for k in range(round(1.2 / DT)):
        world.setpoint = (0.0, 0.9 * STANDSTILL_SETPOINT, -0.9 * STANDSTILL_SETPOINT)[k % 3]
        world.step()
    world.run(6 * TAU)
    assert abs(world.speed) < REST_SPEED


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_joystick_offset_gets_no_friction_feed_forward(sign):
    world = World(settings(PidGains(feedforward_static=3.0, u_clamp_min=-12.0, u_clamp_max=12.0)))
    world.setpoint = sign * STANDSTILL_SETPOINT
    world.run(1.0)
    assert world.held == 0.0 and world.speed == 0.0


def test_slow_set_point_does_not_count_as_zero():
    world = World().run(2.0)
    world.setpoint = 0.1
    world.run(5.0)
    assert world.speed == pytest.approx(0.1, rel=0.01)


@pytest.mark.parametrize("name", SLOW_SETTINGS)
def test_settings_exceeding_stop_time_are_refused_with_their_duration(name):
    with pytest.raises(ParameterError, match=r"stops .* s after a set-point of zero, and stop_"):
        check(settings(**SLOW_SETTINGS[name]).loop)


@pytest.mark.parametrize("name", ["transition_time", "reference_delay"])
def test_settings_up_to_stop_time_are_accepted(name):
    check(settings(**{name: 1.0}).loop)
    with pytest.raises(ParameterError, match=f"{name} 1.002"):
        check(settings(**{name: 1.002}).loop)
    check(settings(stop_time=1.1, **{name: 1.002}).loop)


def test_stop_time_is_checked_from_the_highest_reachable_speed():
    known, loop = KNOWN, LoopSettings(gains=GAINS, model=MODEL)
    top = GAIN * SUPPLY  # 4.32 rad/s
    check(replace(loop, limits=ProfileLimits(acceleration=1.02 * top)), known)
    with pytest.raises(ParameterError, match=f"a wheel at {top:.3g} rad/s stops 1.02 s"):
        check(replace(loop, limits=ProfileLimits(acceleration=0.98 * top)), known)
    check(replace(loop, limits=ProfileLimits(acceleration=0.6, velocity=0.5)), known)
    with pytest.raises(ParameterError, match=r"max_acceleration 0\.4: a wheel at 0\.5 rad/s"):
        check(replace(loop, limits=ProfileLimits(acceleration=0.4, velocity=0.5)), known)
    drive = Drive(top_speed=2.0, time_constant=1.4)  # from 2 rad/s: 1.4 s ln 2
    check(replace(loop, drive=drive), known)
    with pytest.raises(ParameterError, match=r"drive.time_constant 1\.5: a wheel at 2 rad/s"):
        check(replace(loop, drive=replace(drive, time_constant=1.5)), known)


@pytest.mark.parametrize(("low", "high"), [(1.0, 12.0), (-12.0, -1e-3), (5e-324, math.inf)])
def test_clamps_that_exclude_zero_are_refused(low, high):
    clamped = replace(GAINS, u_clamp_min=low, u_clamp_max=high)
    with pytest.raises(ParameterError, match="drives the wheel at a set-point of zero"):
        check(LoopSettings(gains=clamped))
    check(LoopSettings(gains=replace(GAINS, u_clamp_min=0.0)))
    check(LoopSettings(gains=replace(GAINS, u_clamp_max=0.0)))


def test_wheel_drives_again_after_reset_at_standstill():
    world = World().run(1.0)
    world.setpoint = 0.0
    world.run(5.0)
    world.wheel.reset(world.now)
    world.setpoint = 1.5
    world.run(1.0)
    assert world.speed == pytest.approx(1.5, rel=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_random_accepted_settings_stop_within_stop_time(seed):
    draw, stood = random.Random(seed), 0
    for _ in range(60):
        gains = replace(GAINS, p=10 ** draw.uniform(-2, 1), i=10 ** draw.uniform(-4, 2))
        loop = LoopSettings(
            gains=gains,
            model=MODEL,
            limits=ProfileLimits(
                acceleration=draw.choice([math.inf, 10 ** draw.uniform(-2, 2)]),
                jerk=draw.choice([math.inf, 10 ** draw.uniform(-1, 4)]),
            ),
            transition_time=draw.choice([0.0, 10 ** draw.uniform(-2, 1)]),
            reference_delay=draw.choice([0.0, 10 ** draw.uniform(-3, 1)]),
            drive=draw.choice([
                None, Drive(top_speed=3.0, time_constant=10 ** draw.uniform(-2, 5))
            ]),
            stop_time=draw.choice([0.2, 1.0, 3.0]),
        )  # fmt: skip
        try:
            check(loop, KNOWN)
        except ParameterError:
            continue
        world = World(replace(settings(), loop=loop)).run(3.0)
        world.setpoint = 0.0
        # A window to detect a driving integral, and the motor's time to come to rest.
        world.run(loop.stop_time + AVERAGING_WINDOW_S + 10 * TAU)
        last = [abs(speed) for _, _, speed in world.log[-round(0.2 / DT) :]]
        assert max(last) < max(REST_SPEED, 0.1), loop
        stood += 1
    assert stood > 10


STEP, GEAR, COUNTS = 1e-3, 30.0, 271
MOTOR_GAIN, MOTOR_TAU, SECOND, STATIC = 55.0, 0.296, 2.8e-4, 0.081
MOTOR_MODEL = MotorModel(
    dc_gain=MOTOR_GAIN, time_constant=MOTOR_TAU, time_constant_product=SECOND, static_voltage=STATIC
)
STIFF_GAINS = PidGains(
    p=13.4, i=590.0, d=0.073, derivative_filter_time_constant=1.15e-3, u_clamp_min=-6.0,
    u_clamp_max=6.0, i_clamp_min=-6.0, i_clamp_max=6.0, antiwindup_strategy="back_calculation",
    tracking_time_constant=0.0111, feedforward_static=STATIC, feedforward_velocity=0.545,
    feedforward_acceleration=0.1616,
)  # fmt: skip


class Motor:
    """A geared motor with dry friction and one sample of delay, in 50 steps per sample."""

    def __init__(self, load: float = 0.0) -> None:
        self.speed = self.rate = self.angle = self.late = 0.0
        self.load = load  # [V]

    def step(self, voltage: float) -> int:
        voltage, self.late = self.late, voltage
        h = STEP / 50
        for _ in range(50):
            net = voltage - self.load
            if self.speed == 0.0 and abs(net) <= STATIC:
                self.rate = 0.0
                continue
            net -= math.copysign(STATIC, self.speed or net)
            self.rate += h * (MOTOR_GAIN * net - self.speed - MOTOR_TAU * self.rate) * 1.0 / SECOND
            after = self.speed + h * self.rate
            self.speed = 0.0 if after * self.speed < 0 else after
            self.angle += h * self.speed
        return math.floor(self.angle * COUNTS / (2 * math.pi))


def simulate(setpoints: np.ndarray, load: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return voltages and counts of a wheel under a loop with an observer."""
    settings = LoopSettings(
        gains=STIFF_GAINS, speed_source="observer", difference_window=1, transition_time=0.01,
        model=MOTOR_MODEL, noise=ObserverNoise(),
    )  # fmt: skip
    loop = WheelLoop(settings, Gearbox(GEAR), Encoder(COUNTS), 9.0)
    motor, voltage = Motor(load), 0.0
    out = np.zeros((setpoints.size, 2))
    for k, setpoint in enumerate(setpoints):
        count = motor.step(voltage)
        speed = loop.speed(STEP, 0.0, count, voltage)
        voltage = 0.0 if speed != speed else loop.step(float(setpoint), speed, STEP).output
        out[k] = voltage, count
    return out[:, 0], out[:, 1]


def stop_profile(seed: int) -> np.ndarray:
    level = np.random.default_rng(seed).uniform(2.0, 8.0)
    return np.concatenate([np.zeros(100), np.full(700, level), np.zeros(2_000)])


def test_voltage_is_constant_at_standstill_despite_one_count_flicker(monkeypatch):
    ends = [simulate(stop_profile(seed))[0][-1_000:] for seed in range(6)]
    assert max(np.ptp(end) for end in ends) < 1e-9  # from a second after the stop
    monkeypatch.setattr(stop, "STANDSTILL_TIME_S", math.inf)
    ends = [simulate(stop_profile(seed))[0][-1_000:] for seed in range(6)]
    assert max(np.ptp(end) for end in ends) > 0.2  # [V], without the rule


def test_wheel_holds_against_load_and_restarts_on_set_point():
    again = np.concatenate([stop_profile(1), np.full(1_000, -3.0), np.zeros(1_500)])
    voltage, count = simulate(again, load=0.5)
    assert np.ptp(count[1_800:2_800]) <= 1 and np.ptp(voltage[1_800:2_800]) < 1e-9
    assert abs(voltage[2_700] - 0.5) <= STATIC * 1.05
    turned = (count[3_700] - count[3_200]) * 2 * math.pi / COUNTS / GEAR / 0.5
    assert turned == pytest.approx(-3.0, rel=0.02)  # a count is 1.5 mrad at the wheel, of 1.5 rad
    assert np.ptp(count[4_300:]) <= 1


def test_standstill_tolerates_one_count_and_ends_at_two():
    still = Standstill()
    for k in range(round(STANDSTILL_TIME_S / STEP) - 1):
        assert still.voltage(k % 2) is None
        still.step(k % 2, 1.0 if k % 2 else 0.0, STEP)
    still.step(0, 0.0, 2 * STEP)
    assert still.voltage(0) == pytest.approx(0.5, abs=0.01)
    assert still.voltage(1) is not None
    assert still.voltage(2) is None
    still.reset()
    assert still.voltage(0) is None


@pytest.mark.parametrize("source", ["observer", "measured"])
def test_unneeded_integral_voltage_decays_at_standstill(source):
    """Dry friction holds a wheel at any voltage below it; a leftover integral heats the motor."""
    for load, left in ((0.0, 0.0), (0.5, 0.5)):
        settings = LoopSettings(gains=STIFF_GAINS, speed_source=source, model=MOTOR_MODEL)
        loop = WheelLoop(settings, Gearbox(GEAR), Encoder(COUNTS), 9.0)
        motor = Motor(load)
        motor.angle, motor.late = 1.0, load
        loop.pid.i_term = voltage = load + 0.9 * STATIC
        first = motor.step(voltage)
        for _ in range(2_000):
            count = motor.step(voltage)
            speed = loop.speed(STEP, motor.speed / GEAR, count, voltage)
            if not math.isnan(speed):
                voltage = loop.step(0.0, speed, STEP).output
        assert abs(voltage - left) <= 1.05 * STATIC * (load > 0)
        assert abs(count - first) <= 5 and motor.speed == 0.0  # a slip is caught
