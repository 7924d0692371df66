# SPDX-License-Identifier: Apache-2.0
"""The fault matrix of one wheel, event by event, in simulated time, and its documented table."""

import math
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from wheel_world import (
    DT,
    FEEDBACK_TIMEOUT,
    GAINS,
    SETPOINT_TIMEOUT,
    SETTINGS,
    TAU,
    World,
    block_wheel,
    change_feedback,
    clear_faults,
    delay_feedback,
    lose_feedback,
    send_set_point,
    set_other_owner,
    stop_set_points,
)

from smp_motor_control.encoder import Encoder
from smp_motor_control.motor.parameters import Gearbox
from smp_motor_control.wheel.controller import State
from smp_motor_control.wheel.faults import Fault
from smp_motor_control.wheel.loop import LoopSettings

FRONT = 0.02  # one sample to detect it, one for the answer
MATRIX = [
    # event, injected fault, diagnosis, time to diagnosis, time to 0 V, time to recovery
    ("feedback lost", lose_feedback, "no feedback", FEEDBACK_TIMEOUT, FEEDBACK_TIMEOUT, 1.0),
    ("feedback late", delay_feedback, "late", 0.55, FEEDBACK_TIMEOUT, 1.0),
    ("velocity nan", change_feedback(velocity=math.nan), "not a number", 0.2, 0.2, 1.0),
    ("velocity inf", change_feedback(velocity=math.inf), "not a number", 0.2, 0.2, 1.0),
    ("velocity absurd", change_feedback(velocity=1e9), "not a number", 0.2, 0.2, 1.0),
    ("encoder dead", change_feedback(velocity=0.0), "no counts", 0.85, 0.85, 1.0),
    ("wheel blocked", block_wheel, "no counts", 0.85, 0.85, 3.0),
    ("leads swapped", change_feedback(velocity=lambda v: -v), "runaway", 0.5, 0.5, 3.0),
    ("sticks at 0.2", change_feedback(velocity=0.2), "does not follow", 0.5, 0.5, 3.0),
    ("over-current", change_feedback(current=9.0), "over-current", 0.15, 0.15, 3.0),
    ("set-points cease", stop_set_points, "set-point timed out", 0.53, 1.0, 1.0),
    ("set-point nan", send_set_point(math.nan), "set-point timed out", 0.53, 1.0, 1.0),
    ("set-point inf", send_set_point(math.inf), "set-point timed out", 0.53, 1.0, 1.0),
    ("set-point absurd", send_set_point(-1e300), "set-point timed out", 0.53, 1.0, 1.0),
    ("another's wheel", set_other_owner, "rejected", FRONT, FRONT, 1.0),
]


@pytest.mark.parametrize("row", MATRIX, ids=[row[0] for row in MATRIX])
def test_every_fault_is_reported_stops_the_wheel_in_time_and_clears(row):
    _, put, words, clamp_to_supply, stopped, again = row
    limits = replace(SETTINGS.faults, current_limit=5.0)
    world = World(replace(SETTINGS, faults=limits)).run(2.0)
    assert world.speed == pytest.approx(1.5, rel=0.01) and world.wheel.state is State.DRIVING
    put(world)
    begin = world.now
    world.until(lambda: words in world.named(), clamp_to_supply + FRONT)
    world.until(lambda: world.held == 0.0, stopped + FRONT - (world.now - begin) + DT)
    clear_faults(world)
    # Ten time constants to reach the speed, after the pause and the low voltage of a retry.
    world.until(lambda: abs(world.speed - 1.5) < 0.15, again + 10 * TAU)


@pytest.mark.parametrize(
    ("put", "fault"),
    [
        (change_feedback(velocity=lambda v: -v), Fault.RUNAWAY),
        (change_feedback(velocity=lambda v: -v, encoder_count=lambda n: -n), Fault.RUNAWAY),
        (block_wheel, Fault.NO_MOTION),
        (change_feedback(velocity=0.2), Fault.NOT_FOLLOWING),
    ],
)
def test_persistent_fault_is_retried_three_times_at_low_voltage_then_latched(put, fault):
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
    clear_faults(world)
    world.run(10.0)
    assert world.held == 0.0, "a latched wheel waits for a person"
    world.setpoint = 0.0
    world.run(10.0)
    world.setpoint = 1.5
    world.run(2.0)
    assert world.held == 0.0
    world.wheel.reset(world.now)
    world.until(lambda: abs(world.speed - 1.5) < 0.15, 1.0)


def test_voltage_stays_zero_at_zero_set_point_after_runaway():
    world = World().run(2.0)
    change_feedback(velocity=lambda v: -v)(world)
    world.until(lambda: world.wheel.recovery.fault is not None, 0.5)
    world.setpoint = 0.0
    found = len(world.log)
    world.run(30.0)
    assert all(voltage == 0.0 for _, voltage, _ in world.log[found:])


def test_wheel_at_rest_after_fault_reports_zero_output_and_target():
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


def test_retry_count_resets_after_sound_driving():
    world = World().run(2.0)
    for _ in range(6):
        world.blocked = True
        world.until(lambda: world.wheel.recovery.fault is not None, 1.5)
        world.blocked = False
        world.until(lambda: world.wheel.state is State.DRIVING, 1.1)
        world.run(4.0)
    assert world.speed == pytest.approx(1.5, rel=0.01)


def test_non_finite_set_points_do_not_reset_the_time_out():
    world = World().run(2.0)
    good_until = world.now
    for k in range(400):
        world.setpoint = (math.nan, math.inf, -math.inf)[k % 3]
        world.step()
    stopped = next(t for t, voltage, _ in world.log if t > good_until and voltage == 0.0)
    assert stopped - good_until < SETPOINT_TIMEOUT + 1.0
    assert world.wheel.refused["set-point that is not a number or implausible"] == 400


def test_computation_error_stops_the_wheel_and_new_settings_clear_it(monkeypatch):
    world = World().run(1.0)

    def fails(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(world.wheel.loop, "step", fails)
    world.run(0.05)
    assert world.held == 0.0 and world.wheel.recovery.fault is Fault.COMPUTATION
    monkeypatch.undo()
    world.wheel.configure(SETTINGS)
    world.until(lambda: abs(world.speed - 1.5) < 0.15, 5.0)


def test_supply_limits_voltage_and_invalid_hardware_is_refused():
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


ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / "docs" / "decisions" / "when-a-wheel-stops.md"


def read_documented_faults() -> list[list[str]]:
    lines = [line for line in TABLE.read_text().splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[2:]]


def test_every_documented_fault_names_an_existing_test():
    sources = "\n".join(path.read_text() for path in (ROOT / "test").rglob("test_*.py"))
    known = set(re.findall(r"^def (test_\w+)\(", sources, re.MULTILINE))
    matrix = {f"MATRIX: {row[0]}" for row in MATRIX}
    known |= matrix
    rows, named = read_documented_faults(), set[str]()
    assert len(rows) > 20 and len(MATRIX) > 12
    for row in rows:
        assert len(row) == 6 and all(row), row
        tests = re.findall(r"`([^`]+)`", row[5])
        assert tests, f"{row[0]}: no test"
        for test in tests:
            assert test in known or (ROOT / test).is_file(), f"{row[0]}: there is no {test}"
        named |= set(tests)
    assert matrix <= named
