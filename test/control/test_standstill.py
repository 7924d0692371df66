# SPDX-License-Identifier: Apache-2.0
"""A wheel with a set-point of zero stops, and its voltage decays."""

import math

import numpy as np
import pytest

from smp_motor_control.encoder import Encoder
from smp_motor_control.motor.parameters import Gearbox, MotorModel
from smp_motor_control.observer import ObserverNoise
from smp_motor_control.pid import PidGains
from smp_motor_control.wheel import standstill
from smp_motor_control.wheel.loop import LoopSettings, WheelLoop
from smp_motor_control.wheel.standstill import STANDSTILL_TIME_S, Standstill

STEP, GEAR, COUNTS = 1e-3, 30.0, 271
GAIN, TAU, SECOND, STATIC = 55.0, 0.296, 2.8e-4, 0.081
MODEL = MotorModel(
    dc_gain=GAIN, time_constant=TAU, time_constant_product=SECOND, static_voltage=STATIC
)
GAINS = PidGains(
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
            self.rate += h * (GAIN * net - self.speed - TAU * self.rate) * 1.0 / SECOND
            after = self.speed + h * self.rate
            self.speed = 0.0 if after * self.speed < 0 else after
            self.angle += h * self.speed
        return math.floor(self.angle * COUNTS / (2 * math.pi))


def simulate(setpoints: np.ndarray, load: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return voltages and counts of a wheel under a loop with an observer."""
    settings = LoopSettings(
        gains=GAINS, speed_source="observer", difference_window=1, transition_time=0.01,
        model=MODEL, noise=ObserverNoise(),
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
    monkeypatch.setattr(standstill, "STANDSTILL_TIME_S", math.inf)
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
        settings = LoopSettings(gains=GAINS, speed_source=source, model=MODEL)
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
