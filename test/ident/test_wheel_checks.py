# SPDX-License-Identifier: Apache-2.0
"""The checks before a commissioning: results of a short test of the wheels, and findings."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from smp_motor_ident.commission.wheel_checks import Robot, judge
from smp_motor_ident.commission.wheel_test import (
    Figures,
    Phase,
    Trace,
    count_coupled_motion,
    figures,
    has_settled,
    responds_clearly,
)
from smp_motor_ident.record import Hardware

STEP, GAIN, FRICTION, SLOW, RATIO, COUNTS = 0.005, 25.0, 0.4, 0.05, 50.0, 500.0
HARDWARE = Hardware(gear_ratio=RATIO, counts_per_revolution=COUNTS, supply_voltage=12.0)
LEVELS = (1.2, 2.4, 4.8)


def trace(sign=1.0, velocity_scale=1.0, applied=1.0, dead=0.0, driven=True):
    """Return the test of a first-order motor with friction: ramp, 3 levels, coast, both ways.

    The motor is integrated here, by Euler steps of a fiftieth of its time constant.
    """
    rows, phases, time, speed, angle = [], [], 0.0, 0.0, 0.0
    number = 0
    for way in (1.0, -1.0):
        plan = [("ramp", 0.0, 0.5)] + [("hold", level, 0.5) for level in LEVELS]
        for kind, level, lasts in [*plan, ("coast", 0.0, 0.4)]:
            number += 1
            for k in range(round(lasts / STEP)):
                command = way * (2.0 * STEP * k if kind == "ramp" else level)
                volts = applied * command * (abs(command) > dead)
                for _ in range(5):
                    push = driven * GAIN * (volts - math.copysign(FRICTION, speed or volts))
                    if speed == 0.0 and abs(volts) <= FRICTION:
                        push = 0.0
                    new = speed + STEP / 5 / SLOW * (push - speed)
                    speed = 0.0 if speed * new < 0.0 else new
                    angle += speed * STEP / 5
                time += STEP
                shown = sign * angle * COUNTS / (2 * math.pi)
                reported = velocity_scale * sign * speed / RATIO
                row = (time, 0.001, command, volts, reported, sign * angle / RATIO)
                rows.append((*row, math.floor(shown), number))
            phases.append(Phase("left", number, kind, command))
    return Trace.of(rows), phases


def shown(**faults: float) -> Figures:
    seen, phases = trace(**faults)
    return figures(seen, phases, HARDWARE)


GOOD = shown()


def codes(*odd: Figures, hardware: Hardware = HARDWARE, **known: object) -> dict[str, str]:
    """Return codes and severities of the findings for three good wheels and some odd ones."""
    names = [f"wheel_{k}" for k in range(3 + len(odd))]
    found = judge(
        Robot(dict(zip(names, (*odd, GOOD, GOOD, GOOD))), dict.fromkeys(names, hardware), **known)
    )
    return {f.code: f.severity for f in found}


def test_check_figures_match_the_simulated_motor():
    # The speed of the last half of a hold has settled to exp(-5); counts resolve it to 0.1 %.
    assert GOOD.gain == pytest.approx(GAIN, rel=0.01)
    assert GOOD.friction == pytest.approx(FRICTION, abs=0.02)
    # On a ramp of 2 V/s the start is detected 10 counts and a time constant late.
    assert FRICTION < GOOD.breakaway < FRICTION + 0.2
    # Friction takes Vc/(V - Vc) ln(V/Vc) of it, a quarter, and the first sample some.
    assert 0.6 * SLOW < GOOD.coast < SLOW
    assert GOOD.direction == 1.0 and GOOD.applied == pytest.approx(1.0)
    assert GOOD.velocity_ratio == pytest.approx(1.0, abs=0.01)
    assert GOOD.rate == pytest.approx(1 / STEP) and GOOD.level == LEVELS[-1]


def test_faultless_robot_has_only_a_note_on_the_gear_ratio():
    assert codes() == {"gear_ratio_unknown": "note"}
    names = [f"wheel_{k}" for k in range(3)]
    known = {"gains": dict.fromkeys(names, 25.5), "ratios": dict.fromkeys(names, RATIO)}
    assert codes(**known) == {}


def test_slow_or_delayed_feedback_is_refused():
    assert codes(replace(GOOD, rate=20.0))["feedback_rate"] == "refused"
    assert codes(replace(GOOD, age=0.5))["feedback_age"] == "refused"
    assert codes(replace(GOOD, age=-3600.0))["feedback_age"] == "refused"
    assert codes(replace(GOOD, repeated=7))["repeated_stamps"] == "warning"


def test_encoder_jitter_is_not_motion_and_a_turning_wheel_is():
    assert "motion_at_zero_voltage" not in codes(replace(GOOD, at_rest=2.0))
    assert codes(replace(GOOD, at_rest=40.0))["motion_at_zero_voltage"] == "refused"
    seen, phases = trace(driven=False)
    trembling = replace(seen, count=seen.count + np.arange(seen.count.size) % 2)
    still = figures(trembling, phases, HARDWARE)
    assert math.isnan(still.breakaway) and still.direction == 0.0


def test_a_wheel_that_does_not_turn_is_refused_by_name():
    seen, phases = trace(driven=False)
    still = figures(seen, [p for p in phases if p.kind == "ramp"], HARDWARE)
    assert still.applied == pytest.approx(1.0)
    assert codes(still, moved={"wheel_0": {"wheel_0": 0.0}})["no_motion"] == "refused"


def test_crossed_motor_plugs_are_separated_from_coupled_wheels():
    (seen, phases), (still, _) = trace(), trace(driven=False)
    # Commands to the left wheel turn the right one.
    moved = count_coupled_motion({"left": still, "right": seen}, phases)
    robot = Robot({"left": GOOD, "right": GOOD}, dict.fromkeys(("left", "right"), HARDWARE), moved)
    assert "crossed_wheels" in {f.code for f in judge(robot)}
    moved = count_coupled_motion({"left": seen, "right": seen}, phases)
    robot = Robot({"left": GOOD, "right": GOOD}, dict.fromkeys(("left", "right"), HARDWARE), moved)
    assert {f.code: f.severity for f in judge(robot)}["coupled_wheels"] == "warning"


def test_a_swapped_encoder_or_motor_is_refused_with_both_remedies():
    wrong = shown(sign=-1.0)
    assert wrong.direction == -1.0
    (found,) = [
        f
        for f in judge(Robot({"left": wrong}, {"left": HARDWARE}))
        if f.severity == "refused"
    ]  # fmt: skip
    assert found.code == "reversed"
    assert "channels" in found.advice and "leads" in found.advice


def test_gear_ratio_contradicting_counts_or_motor_file_is_refused():
    assert codes(shown(velocity_scale=0.75))["gear_ratio"] == "refused"
    assert codes(shown(velocity_scale=-1.0))["velocity_sign"] == "refused"
    assert codes(ratios={"wheel_0": 65.5})["gear_ratio"] == "refused"
    # Edges counted as lines make the motor appear four times as fast.
    assert codes(gains={"wheel_0": GAIN / 4})["unexpected_gain"] == "refused"
    assert "unexpected_gain" not in codes(gains={"wheel_0": 1.2 * GAIN})


def test_a_dead_zone_is_separated_from_friction():
    wide = shown(dead=1.0 - 1e-6)
    # The ramp ends at 1 V; friction itself is 0.4 V.
    assert codes(replace(wide, breakaway=1.1))["dead_zone"] == "warning"
    assert "dead_zone" not in codes()


def test_low_supply_is_refused_by_applied_voltage_or_battery_report():
    weak = shown(applied=0.7)
    assert weak.applied == pytest.approx(0.7)
    # Friction and gain refer to the applied voltage: the motor is the same.
    assert weak.gain == pytest.approx(GAIN, rel=0.02)
    assert codes(weak)["supply_low"] == "refused"
    assert codes(battery=9.0)["supply_low"] == "refused"
    assert "supply_low" not in codes(shown(applied=0.95), battery=11.9)
    assert codes(replace(GOOD, applied=-1.0))["reported_voltage_sign"] == "refused"
    assert codes(replace(GOOD, applied=0.0))["voltage_not_reported"] == "refused"


def test_dragging_wheel_is_separated_from_normal_friction_scatter():
    assert codes(replace(GOOD, friction=5 * FRICTION))["friction_outlier"] == "refused"
    heavier = codes(replace(GOOD, coast=5 * GOOD.coast))
    assert heavier["coasts_longer"] == "warning" and "friction_outlier" not in heavier
    assert "friction_outlier" not in codes(replace(GOOD, friction=1.8 * FRICTION))
    # With one level only, friction and gain cannot be separated.
    heavy = replace(GOOD, friction=math.nan, gain=math.nan, breakaway=3.3)
    assert codes(heavy)["friction_outlier"] == "refused"
    # With two wheels the outlier is ambiguous.
    two = {"a": GOOD, "b": replace(GOOD, friction=9 * FRICTION)}
    found = judge(Robot(two, dict.fromkeys(two, HARDWARE)))
    assert "friction_outlier" not in {f.code for f in found}


def test_check_voltage_suffices_if_friction_is_a_tenth_and_counts_resolve_the_speed():
    assert responds_clearly(5.0, 0.5, 100.0)
    assert not responds_clearly(4.9, 0.5, 1000.0)
    assert not responds_clearly(5.0, 0.5, 99.0)


def test_queued_samples_give_the_same_check_figures():
    # With samples 0.2 s late, a phase begins with samples of the previous one.
    seen, phases = trace()
    late = np.concatenate([np.full(40, seen.phase[0]), seen.phase[:-40]])
    found = figures(replace(seen, phase=late), phases, HARDWARE)
    # The last 0.15 s of the 0.3 s that are left begin after three time constants: of each step of
    # the speed 1.6 % are missing, of the line through speeds half a step apart twice that.
    assert found.gain == pytest.approx(GAIN, rel=0.032)
    assert found.friction == pytest.approx(FRICTION, abs=0.032 * LEVELS[0])


def test_wheel_has_not_settled_while_samples_belong_to_the_previous_voltage():
    seen, phases = trace()
    first, second = (seen.during(p.number) for p in phases if p.kind == "hold" and p.level > 2.0)
    assert has_settled(first)
    begun = Trace.of(np.concatenate([_rows(first), _rows(second)[:20]]))
    assert not has_settled(begun)
    assert has_settled(Trace.of(np.concatenate([_rows(first), _rows(second)])))
    # A busy computer delivers only these samples.
    assert not has_settled(replace(first, command=second.command[: first.command.size]))


def test_coast_time_is_unknown_while_voltage_is_still_applied():
    seen, phases = trace()
    late = seen.voltage.copy()
    for hold, coast in itertools.pairwise(phases):
        if (hold.kind, coast.kind) == ("hold", "coast"):
            rows = np.flatnonzero(seen.phase == coast.number)
            late[rows] = hold.level
    assert math.isnan(figures(replace(seen, voltage=late), phases, HARDWARE).coast)


def test_bunched_samples_do_not_count_as_settled():
    # Half-way up an exponential of 0.4 s, most samples fall in the last tenth of the time.
    time = np.concatenate([np.linspace(0.0, 0.5, 6), np.linspace(0.5, 0.55, 40)[1:]])
    count = 1000.0 * (time - 0.4 * (1.0 - np.exp(-time / 0.4)))
    columns = [np.ones(time.size)] * 8
    rows = np.stack(columns, axis=1)
    rows[:, 0], rows[:, 6] = time, count
    assert not has_settled(Trace.of(rows))


def _rows(part: Trace) -> np.ndarray:
    names = ("time", "age", "command", "voltage", "velocity", "position", "count", "phase")
    return np.stack([getattr(part, name) for name in names], axis=1)


def test_position_unusable_for_odometry_is_a_warning():
    found = judge(Robot({}, {}, positions={"left": "its position wraps", "right": ""}))
    assert [(f.code, f.severity, f.message) for f in found] == [
        ("position_unusable", "warning", "left: its position wraps")
    ]
