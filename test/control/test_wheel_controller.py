"""The fault matrix of one wheel, event by event, with the time passed in.

The motor is the test's own: first order, 0.36 rad/s per volt at the wheel, 50 ms; 100 Hz.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import pytest

from smp_motor_control.encoder import Encoder
from smp_motor_control.motor.model import MotorModel
from smp_motor_control.motor.parameters import Gearbox
from smp_motor_control.pid import PidGains
from smp_motor_control.wheel.controller import State, WheelController, WheelSettings
from smp_motor_control.wheel.faults import Fault
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
    voltage: float
    current: float
    velocity: float
    encoder_count: int


class World:
    """A wheel under control; faults are put in between."""

    def __init__(self, settings: WheelSettings = SETTINGS) -> None:
        self.wheel = WheelController(settings)
        self.now = 100.0
        self.speed = self.angle = self.held = 0.0
        self.setpoint: float | None = 1.5
        self.sensor: Callable[[Sample], Sample | None] = lambda sample: sample
        self.stamp: Callable[[int], int] = lambda stamp: stamp
        self.blocked = False
        self.log: list[tuple[float, float, float]] = []  # time, voltage, true speed
        self.wheel.activate(self.now)

    def step(self) -> None:
        self.now += DT
        decay = math.exp(-DT / TAU)
        final = 0.0 if self.blocked else GAIN * self.held
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

    def run(self, seconds: float) -> World:
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


def change(**fields: object) -> Callable[[World], None]:
    """Return a fault that changes fields of the feedback; a callable makes them of the old."""

    def put(world: World) -> None:
        def sensor(sample: Sample) -> Sample:
            new = {k: v(getattr(sample, k)) if callable(v) else v for k, v in fields.items()}
            return replace(sample, **new)

        world.sensor = sensor

    return put


def lose(world: World) -> None:
    world.sensor = lambda sample: None


def delay(world: World) -> None:
    world.stamp = lambda stamp: stamp - 500_000_000


def block(world: World) -> None:
    world.blocked = True


def silent(world: World) -> None:
    world.setpoint = None


def asking(value: float) -> Callable[[World], None]:
    return lambda world: setattr(world, "setpoint", value)


def taken(world: World) -> None:
    world.wheel.owner = "/excite#1"


def sensible(world: World) -> None:
    world.sensor, world.stamp = (lambda sample: sample), (lambda stamp: stamp)
    world.blocked, world.setpoint, world.wheel.owner = False, 1.5, ""


FRONT = 0.02  # one sample to see it, one for the answer
MATRIX = [
    # what happens, how it is named, within, 0 V within, drives again within
    ("feedback lost", lose, "no feedback", FEEDBACK_TIMEOUT, FEEDBACK_TIMEOUT, 1.0),
    ("feedback late", delay, "late", 0.55, FEEDBACK_TIMEOUT, 1.0),
    ("velocity nan", change(velocity=math.nan), "not a number", 0.2, 0.2, 1.0),
    ("velocity inf", change(velocity=math.inf), "not a number", 0.2, 0.2, 1.0),
    ("velocity absurd", change(velocity=1e9), "not a number", 0.2, 0.2, 1.0),
    ("encoder dead", change(velocity=0.0), "no counts", 0.85, 0.85, 1.0),
    ("wheel blocked", block, "no counts", 0.85, 0.85, 3.0),
    ("leads swapped", change(velocity=lambda v: -v), "runaway", 0.5, 0.5, 3.0),
    ("sticks at 0.2", change(velocity=0.2), "does not follow", 0.5, 0.5, 3.0),
    ("over-current", change(current=9.0), "over-current", 0.15, 0.15, 3.0),
    ("set-points cease", silent, "set-point timed out", 0.53, 1.0, 1.0),
    ("set-point nan", asking(math.nan), "set-point timed out", 0.53, 1.0, 1.0),
    ("set-point inf", asking(math.inf), "set-point timed out", 0.53, 1.0, 1.0),
    ("set-point absurd", asking(-1e300), "set-point timed out", 0.53, 1.0, 1.0),
    ("another's wheel", taken, "not yours", FRONT, FRONT, 1.0),
]


@pytest.mark.parametrize("row", MATRIX, ids=[row[0] for row in MATRIX])
def test_every_fault_is_named_stops_the_wheel_in_time_and_passes(row):
    _, put, words, within, stopped, again = row
    limits = replace(SETTINGS.faults, current_limit=5.0)
    world = World(replace(SETTINGS, faults=limits)).run(2.0)
    assert world.speed == pytest.approx(1.5, rel=0.01) and world.wheel.state is State.DRIVING
    put(world)
    begin = world.now
    world.until(lambda: words in world.named(), within + FRONT)
    world.until(lambda: world.held == 0.0, stopped + FRONT - (world.now - begin) + DT)
    sensible(world)
    # Ten time constants to speed, after the pause and the small voltage of a try.
    world.until(lambda: abs(world.speed - 1.5) < 0.15, again + 10 * TAU)


@pytest.mark.parametrize(
    ("put", "fault"),
    [
        (change(velocity=lambda v: -v), Fault.RUNAWAY),
        (change(velocity=lambda v: -v, encoder_count=lambda n: -n), Fault.RUNAWAY),
        (block, Fault.NO_MOTION),
        (change(velocity=0.2), Fault.NOT_FOLLOWING),
    ],
)
def test_fault_that_stays_is_tried_three_times_gently_and_then_latched(put, fault):
    world = World().run(2.0)
    put(world)
    world.until(lambda: world.wheel.recovery.fault is not None, 1.0)
    found = len(world.log)
    world.run(60.0)
    assert world.wheel.recovery.latched and world.wheel.recovery.fault is fault
    tried = [abs(voltage) for _, voltage, _ in world.log[found:]]
    assert max(tried) <= 1.05 * SETTINGS.faults.stall_voltage
    starts = sum(a == 0.0 != b for a, b in pairwise(tried))
    assert starts == 3
    sensible(world)
    world.run(10.0)
    assert world.held == 0.0, "a latched wheel waits for a person"
    world.setpoint = 0.0
    world.run(10.0)
    world.setpoint = 1.5
    world.run(2.0)
    assert world.held == 0.0
    world.wheel.reset(world.now)
    world.until(lambda: abs(world.speed - 1.5) < 0.15, 1.0)


def test_nothing_is_driven_at_a_zero_set_point_after_a_runaway():
    world = World().run(2.0)
    change(velocity=lambda v: -v)(world)
    world.until(lambda: world.wheel.recovery.fault is not None, 0.5)
    world.setpoint = 0.0
    found = len(world.log)
    world.run(30.0)
    assert all(voltage == 0.0 for _, voltage, _ in world.log[found:])


def test_wheel_that_stands_after_a_fault_shows_that_it_hears_its_set_point():
    world = World().run(2.0)
    world.blocked = True
    world.until(lambda: world.wheel.recovery.fault is not None, 1.5)
    world.blocked, world.setpoint = False, 0.0
    world.until(lambda: world.wheel.recovery.fault is None, 2.0)
    world.run(0.1)
    assert world.wheel.recovery.cautious
    assert world.wheel.answer is not None and world.wheel.answer.output == 0.0
    assert world.wheel.target == world.wheel.loop.reference.velocity == world.held == 0.0
    world.setpoint = 1.5
    world.until(lambda: abs(world.speed - 1.5) < 0.15, 4.0)


def test_intact_wheel_may_be_tried_as_often_as_it_was_proven_sound():
    world = World().run(2.0)
    for _ in range(6):
        world.blocked = True
        world.until(lambda: world.wheel.recovery.fault is not None, 1.5)
        world.blocked = False
        world.until(lambda: world.wheel.state is State.DRIVING, 1.1)
        world.run(4.0)
    assert world.speed == pytest.approx(1.5, rel=0.01)


def test_set_point_of_no_number_is_no_sign_of_life_between_good_ones():
    world = World().run(2.0)
    good_until = world.now
    for k in range(400):
        world.setpoint = (math.nan, math.inf, -math.inf)[k % 3]
        world.step()
    stopped = next(t for t, voltage, _ in world.log if t > good_until and voltage == 0.0)
    assert stopped - good_until < SETPOINT_TIMEOUT + 1.0
    assert world.wheel.refused["set-point that is not a number or absurd"] == 400


def test_parameters_that_cannot_be_computed_stop_the_wheel_and_nothing_else(monkeypatch):
    world = World().run(1.0)

    def fails(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(world.wheel.loop, "step", fails)
    world.run(0.05)
    assert world.held == 0.0 and world.wheel.recovery.fault is Fault.COMPUTATION
    monkeypatch.undo()
    world.wheel.configure(SETTINGS)
    world.until(lambda: abs(world.speed - 1.5) < 0.15, 5.0)


def test_inactive_wheel_answers_nothing_and_starts_afresh():
    world = World().run(1.0)
    world.wheel.deactivate()
    answers = len(world.log)
    world.held = 0.0
    world.run(1.0)
    assert all(voltage == 0.0 for _, voltage, _ in world.log[answers:])
    assert world.wheel.state is State.INACTIVE
    world.wheel.activate(world.now)
    world.until(lambda: abs(world.speed - 1.5) < 0.15, 1.0)


def test_supply_limits_the_voltage_and_hardware_without_one_is_refused():
    world = World(replace(SETTINGS, loop=LoopSettings(gains=replace(GAINS, p=100.0))))
    world.wheel.set_hardware(Gearbox(65.5), Encoder(), 5.0)
    world.run(1.0)
    assert max(abs(voltage) for _, voltage, _ in world.log) <= 5.0
    for supply in (0.0, -12.0, 1e-3, 1e6, math.inf, math.nan):
        with pytest.raises(ValueError, match="supply_voltage"):
            world.wheel.set_hardware(Gearbox(65.5), Encoder(), supply)
    for resistance in (0.0, -1.0, 1e9, math.inf):
        with pytest.raises(ValueError, match="resistance"):
            world.wheel.set_hardware(Gearbox(65.5), Encoder(), 12.0, resistance)
    world.run(1.0)
    assert max(abs(voltage) for _, voltage, _ in world.log) <= 5.0


def test_gains_that_suit_no_such_feedback_are_named_once_its_rate_is_known():
    model = MotorModel(dc_gain=GAIN * 65.5, time_constant=TAU)
    # One sample late, half a sample averaged: at 10 ms a third of this is the limit.
    gains = replace(GAINS, p=60.0, i=0.0)
    world = World(replace(SETTINGS, loop=LoopSettings(gains=gains, model=model)))
    world.wheel.set_hardware(Gearbox(65.5), Encoder(), SUPPLY)
    world.run(0.5)
    assert "unstable on the motor's model at intervals of 10 ms" in world.wheel.advice
