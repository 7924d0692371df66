# SPDX-License-Identifier: Apache-2.0
"""One wheel under its controller, with simulated time and injected faults.

The motor is of first order: 0.36 rad/s per volt at the wheel, 50 ms, sampled at 100 Hz.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from smp_motor_control.pid import PidGains
from smp_motor_control.wheel.controller import WheelController, WheelSettings
from smp_motor_control.wheel.loop import LoopSettings

GAIN, TAU, DT, SUPPLY = 0.36, 0.05, 0.01, 12.0
EPOCH = 1_700_000_000 * 10**9
SETPOINT_TIMEOUT, FEEDBACK_TIMEOUT = 0.5, 0.2
GAINS = PidGains(
    p=1.5, i=20.0, u_clamp_min=-SUPPLY, u_clamp_max=SUPPLY, antiwindup_strategy="back_calculation"
)
SETTINGS = WheelSettings(
    loop=LoopSettings(gains=GAINS),
    setpoint_timeout=SETPOINT_TIMEOUT,
    feedback_timeout=FEEDBACK_TIMEOUT,
    fault_retry=1.0,
)


@dataclass
class Sample:
    voltage: float = 0.0
    current: float = math.nan
    velocity: float = 0.0
    encoder_count: int = 0


class World:
    """A wheel under its controller, with faults injected between plant and controller."""

    def __init__(self, settings: WheelSettings = SETTINGS) -> None:
        self.wheel = WheelController(settings)
        self.now = 100.0
        self.speed = self.angle = self.held = 0.0
        self.setpoint: float | None = 1.5
        self.sensor: Callable[[Sample], Sample | None] = lambda sample: sample
        self.stamp: Callable[[int], int] = lambda stamp: stamp
        self.blocked = False
        self.load = 0.0  # pushes the wheel forward [V]
        self.log: list[tuple[float, float, float]] = []  # time, voltage, true speed
        self.wheel.activate(self.now)

    def step(self) -> None:
        self.now += DT
        decay = math.exp(-DT / TAU)
        final = 0.0 if self.blocked else GAIN * (self.held + self.load)
        self.speed = 0.0 if self.blocked else final + (self.speed - final) * decay
        self.angle += self.speed * DT
        if self.setpoint is not None:
            self.wheel.take_setpoint(self.setpoint, self.now)
        count = round(self.angle * 500 * 65.5 / (2 * math.pi))
        sample = self.sensor(Sample(self.held, math.nan, self.speed, count))
        tick = self.wheel.tick(self.now)
        answer = None
        if sample is not None:
            arrival = EPOCH + round(self.now * 1e9)
            answer = self.wheel.take_feedback(sample, self.stamp(arrival), arrival, self.now)
        for voltage in (tick, answer):
            self.held = self.held if voltage is None else voltage
        self.log.append((self.now, self.held, self.speed))

    def run(self, seconds):
        for _ in range(round(seconds / DT)):
            self.step()
        return self

    def named(self) -> str:
        fault = self.wheel.recovery.fault
        return fault.value if fault else self.wheel.state.value

    def until(self, condition: Callable[[], bool], within: float) -> float:
        """Step until a condition holds; return how long that took."""
        begin = self.now
        while not condition():
            assert self.now - begin < within, f"{self.named()} after {within} s"
            self.step()
        return self.now - begin


def change_feedback(**fields: object) -> Callable[[World], None]:
    """Return a fault that changes feedback fields; a callable computes the new value."""

    def put(world: World) -> None:
        def sensor(sample: Sample) -> Sample:
            new = {k: v(getattr(sample, k)) if callable(v) else v for k, v in fields.items()}
            return replace(sample, **new)

        world.sensor = sensor

    return put


def lose_feedback(world: World) -> None:
    world.sensor = lambda sample: None


def delay_feedback(world: World) -> None:
    world.stamp = lambda stamp: stamp - 500_000_000


def block_wheel(world: World) -> None:
    world.blocked = True


def stop_set_points(world: World) -> None:
    world.setpoint = None


def send_set_point(value: float) -> Callable[[World], None]:
    return lambda world: setattr(world, "setpoint", value)


def set_other_owner(world: World) -> None:
    world.wheel.owner = "/excite#1"


def clear_faults(world: World) -> None:
    world.sensor, world.stamp = (lambda sample: sample), (lambda stamp: stamp)
    world.blocked, world.setpoint, world.wheel.owner = False, 1.5, ""
