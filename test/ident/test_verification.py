# SPDX-License-Identifier: Apache-2.0
"""A drive on new gains compared with its prediction."""

import math
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from paper_motors import combinations_of
from wheel_simulation import Timing, simulate_closed_loop

from smp_motor_control.motor.file import load_motors
from smp_motor_control.motor.hardware import DriveSettings
from smp_motor_control.motor.parameters import MotorParameters
from smp_motor_ident.cli.tuning import read_estimates
from smp_motor_ident.result import Quantity
from smp_motor_ident.tune import Design, Loop, design
from smp_motor_ident.tune import verification as v
from smp_motor_ident.tune.writing import parameters

MOTORS = Path(__file__).resolve().parents[2] / "config" / "motors_paper.yaml"
WHEEL, STEP, REST, LASTS = "front_left", 0.005, 0.3, 1.2
ESTIMATE = read_estimates(MOTORS)[WHEEL]
ENTRY = load_motors(MOTORS)[WHEEL]


@pytest.fixture(scope="module")
def designed() -> Design:
    return design(ESTIMATE, Loop(sample_time=STEP, supply_voltage=12.0))


def drive(one, entry=ENTRY, load=0.0, late=0.0, wait=0.0, offset=0.0):
    """Return a change of set-point that another motor did, as commission reads it."""
    document = {"sample_time": STEP, "delay": STEP, "supply_voltage": 12.0}
    setpoint = one.specification.change / one.loop.gear_ratio
    run = simulate_closed_loop(
        entry,
        v.loop_settings(parameters(one)),
        lambda t: setpoint if t >= REST else 0.0,
        REST + LASTS,
        timing=Timing(sample_time=STEP, delay=STEP + wait, jitter=late),
        drive=DriveSettings(command_timeout=math.inf, pwm_steps=1000),
        load=lambda t: load,
    )
    # Zero is the first sample that saw the new set-point.
    instants = run.time - run.time[run.time >= REST][0]
    turn = entry.gearbox.to_wheel(entry.encoder.angle_per_count)
    even, speed = v.smooth_speed(instants, turn * run.count, STEP)
    kept = even >= 0.0
    rows = v.predict_speed(
        ESTIMATE,
        parameters(one),
        document,
        np.where(instants < 0.0, 0.0, setpoint),
        (instants, np.full(instants.size, STEP + wait)),
        even[kept],
    )
    specification = asdict(one.specification)
    return v.read_change(
        WHEEL, "forward", setpoint, even[kept], speed[kept] + offset * setpoint, rows,
        specification, v.resolution(turn, STEP),
    )  # fmt: skip


def test_a_wheel_that_does_as_designed_is_within_its_bands(designed):
    change = drive(designed)
    assert v.judge([change]) == []
    # The prediction is the drive, but for the steps of the duty cycle.
    assert np.abs(change.nominal - change.speed).max() < 0.01 * change.setpoint


def test_samples_that_come_late_are_in_the_prediction(designed):
    # A computer that is busy elsewhere: intervals scatter by a third.
    change = drive(designed, late=0.3 * STEP)
    assert v.judge([change]) == []
    assert np.abs(change.nominal - change.speed).max() < 0.02 * change.setpoint


def test_samples_that_nobody_answered_are_in_the_prediction(designed):
    loop = {"sample_time": STEP, "delay": STEP, "supply_voltage": 12.0}
    instants = STEP * np.arange(-60, 240)
    # 60 ms without an answer while the wheel gets faster: the voltage stays and is too large.
    silent = np.where((instants > 0.05) & (instants < 0.11), np.nan, 0.0)
    setpoints = np.where(instants < 0.0, 0.0, 1.0)
    rows = [
        v.predict_speed(
            ESTIMATE, parameters(designed), loop, setpoints, (instants, ages), instants[60:230]
        )[0]
        for ages in (np.zeros(instants.size), silent)
    ]
    assert np.abs(rows[1] - rows[0]).max() > 0.02
    assert rows[1][-1] == pytest.approx(1.0, abs=0.02)


def test_what_the_integral_keeps_from_one_change_to_the_next_is_in_the_prediction(designed):
    # Friction of 2 V holds the wheel after each stop, so the integral stays.
    values = combinations_of(ENTRY.parameters) | {"static_voltage": 2.0}
    rubbing = MotorParameters.from_combinations(**values)
    known = {**ESTIMATE.combinations, "static_voltage": Quantity(2.0, status="fixed")}
    setpoint, lasts = 1.0, 1.0

    def asked(t: float) -> float:
        return 0.0 if t < REST or REST + lasts <= t < REST + 2 * lasts else setpoint

    run = simulate_closed_loop(
        replace(ENTRY, parameters=rubbing), v.loop_settings(parameters(designed)), asked,
        REST + 3 * lasts, timing=Timing(sample_time=STEP, delay=STEP),
        drive=DriveSettings(command_timeout=math.inf, pwm_steps=1000),
    )  # fmt: skip
    turn = ENTRY.gearbox.to_wheel(ENTRY.encoder.angle_per_count)
    even, speed = v.smooth_speed(run.time, turn * run.count, STEP)
    estimate = replace(ESTIMATE, combinations=known)
    loop = {"sample_time": STEP, "delay": STEP, "supply_voltage": 12.0}
    setpoints = np.array([asked(t) for t in run.time])
    answers = (run.time, np.full(run.time.size, STEP))
    row = v.predict_speed(estimate, parameters(designed), loop, setpoints, answers, even)[0]
    assert np.abs(row - speed).max() < 0.02 * setpoint


def test_how_long_a_command_waited_is_seen_in_the_voltages_that_were_applied():
    rng = np.random.default_rng(4)
    time = STEP * np.arange(200)
    commands, ages = rng.uniform(-10.0, 10.0, time.size), np.full(time.size, 0.001)
    # In effect from the next sample on; between 0.50 and 0.54 s the driver takes none.
    arrived = time + STEP
    arrived[(arrived > 0.501) & (arrived < 0.539)] = 0.54
    latest = np.array([np.flatnonzero(arrived <= t + 1e-9)[-1:] for t in time[:-1]], dtype=object)
    voltage = np.array([0.0] + [float(commands[k[0]]) if k.size else 0.0 for k in latest])
    loop = {"delay": 0.0, "supply_voltage": 12.0}
    delays = v.measure_arrival_delays((time, ages, commands), (time, voltage), loop)
    # Before the first nothing was; the last two were not in effect when the record ended.
    np.testing.assert_allclose(delays[1:-2], (arrived - time)[1:-2], atol=1e-9)
    measured = voltage + rng.normal(0.0, 1.0, voltage.size)
    said = v.measure_arrival_delays((time, ages, commands), (time, measured), loop)
    assert np.array_equal(said, ages)
    slower = v.measure_arrival_delays(
        (time, ages, commands), (time, measured), {**loop, "delay": STEP}
    )
    assert np.array_equal(slower, np.full(time.size, STEP))


def test_a_command_inside_the_dead_zone_of_a_driver_has_not_waited():
    # It drives, brakes, creeps up inside a zone of 1.5 V, and drives on.
    parts = (0.0, 60), (5.0, 100), (0.0, 1), (0.5, 100), (5.0, 100)
    commands = np.concatenate([np.full(lasts, volts) for volts, lasts in parts])
    commands += 1e-2 * np.arange(commands.size) * (commands != 0.0)
    time, ages = STEP * np.arange(commands.size), np.full(commands.size, 0.001)
    applied = np.where(np.abs(commands) < 1.5, 0.0, commands)
    voltage = np.concatenate(([0.0], applied[:-1]))
    loop = {"delay": 0.0, "supply_voltage": 12.0}
    delays = v.measure_arrival_delays((time, ages, commands), (time, voltage), loop)
    assert delays[1:].max() <= STEP + 1e-9


def test_a_drive_that_its_computer_slowed_is_within_its_bands_and_says_so(designed):
    slow = drive(designed, wait=0.03)
    assert slow.reading.overshoot > 10.0
    assert v.judge([slow]) == []
    (found,) = v.report_loop_delay([slow, drive(designed)])
    assert found.severity == "warning" and found.evidence["excess"] == slow.excess
    assert v.report_loop_delay([drive(designed)]) == []
    # Where it is beyond even that, the computer is named, not the wheel.
    (refused,) = v.judge([replace(slow, bands=replace(slow.bands, overshoot=1.0))])
    assert refused.advice == found.advice != v.judge([drive(designed, offset=-0.05)])[0].advice


@pytest.mark.parametrize("gain", [0.6, 1.6])
def test_another_motor_is_refused(designed, gain):
    motor = ENTRY.parameters
    other = replace(
        ENTRY,
        parameters=replace(
            motor, motor_constant=motor.motor_constant * gain, inertia=motor.inertia / gain
        ),
    )
    found = v.judge([drive(designed, other)])
    assert found and {f.code for f in found} == {"verification"}
    assert all(f.severity == "refused" and WHEEL in f.message for f in found)


def test_a_speed_that_stays_off_is_refused(designed):
    found = v.judge([drive(designed, offset=-0.05)])
    assert any("stays off" in f.message for f in found)


def test_a_wheel_that_never_arrives_is_refused_in_words(designed):
    # Twice the torque of 12 V blocks the wheel.
    stall = 2.0 * ENTRY.gearbox.ratio * 12.0 * ENTRY.parameters.motor_constant
    found = v.judge([drive(designed, load=stall / ENTRY.parameters.resistance)])
    assert any("more than was recorded" in f.message for f in found)


def test_a_drive_without_control_is_refused_with_its_reason():
    assert v.report_silence(0.09) == []
    (found,) = v.report_silence(0.4)
    assert found.severity == "refused" and "0.40 s" in found.message and found.advice


def test_the_resolution_of_a_speed_is_that_of_its_parabola():
    # A staircase of counts from a slow wheel: the smoothed slope scatters as the formula says.
    quantum, speed = 0.01, 0.37
    time = np.arange(0.0, 20.0, STEP)
    angle = quantum * np.floor(speed * time / quantum)
    _, slope = v.smooth_speed(time, angle, STEP)
    # Errors of a staircase repeat and are not independent: to a factor of two.
    assert 0.5 < np.std(slope[20:-20]) / v.resolution(quantum, STEP) < 2.0
