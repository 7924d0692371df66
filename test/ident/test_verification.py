# SPDX-License-Identifier: Apache-2.0
"""A drive on new gains: its set-point changes, compared with the design and its prediction."""

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from paper_motors import combinations_of
from wheel_simulation import Timing, simulate_closed_loop

from smp_motor_control.motor.file import PAPER_MOTORS, find_config, load_motors
from smp_motor_control.motor.hardware import DriveSettings
from smp_motor_control.motor.parameters import MotorParameters
from smp_motor_ident.bag.storage import Table
from smp_motor_ident.cli import driving, tune
from smp_motor_ident.cli.processes import ProcessError
from smp_motor_ident.cli.tuning import read_estimates
from smp_motor_ident.result import Quantity
from smp_motor_ident.tune import Design, Loop, design, verification
from smp_motor_ident.tune import verification as v
from smp_motor_ident.tune.writing import parameters

MOTORS = Path(__file__).resolve().parents[2] / "config" / "motors_paper.yaml"
WHEEL, STEP, REST, LASTS = "front_left", 0.005, 0.3, 1.2
ESTIMATE = read_estimates(MOTORS)[WHEEL]
ENTRY = load_motors(MOTORS)[WHEEL]
LOOP = {"sample_time": STEP, "delay": STEP, "supply_voltage": 12.0}


@pytest.fixture(scope="module")
def designed() -> Design:
    return design(ESTIMATE, Loop(sample_time=STEP, supply_voltage=12.0))


def drive(one, entry=ENTRY, load=0.0, late=0.0, wait=0.0, offset=0.0):
    """Return the set-point change of a simulated motor, evaluated as by commission."""
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
    # Time zero is the first sample with the new set-point.
    instants = run.time - run.time[run.time >= REST][0]
    turn = entry.gearbox.to_wheel(entry.encoder.angle_per_count)
    even, speed = v.smooth_speed(instants, turn * run.count, STEP)
    kept = even >= 0.0
    rows = v.predict_speed(
        ESTIMATE,
        parameters(one),
        LOOP,
        np.where(instants < 0.0, 0.0, setpoint),
        (instants, np.full(instants.size, STEP + wait)),
        even[kept],
    )
    specification = asdict(one.specification)
    return v.read_change(
        WHEEL, "forward", setpoint, even[kept], speed[kept] + offset * setpoint, rows,
        specification, v.resolution(turn, STEP),
    )  # fmt: skip


def test_nominal_wheel_is_within_its_bands(designed):
    change = drive(designed)
    assert v.judge([change]) == []
    # The prediction matches the drive up to the steps of the duty cycle.
    assert np.abs(change.nominal - change.speed).max() < 0.01 * change.setpoint


def test_prediction_includes_sampling_jitter(designed):
    # A busy computer: intervals jitter by 30 %.
    change = drive(designed, late=0.3 * STEP)
    assert v.judge([change]) == []
    assert np.abs(change.nominal - change.speed).max() < 0.02 * change.setpoint


def test_prediction_includes_unanswered_samples(designed):
    instants = STEP * np.arange(-60, 240)
    # 60 ms without control while the wheel accelerates: the held voltage is too large.
    silent = np.where((instants > 0.05) & (instants < 0.11), np.nan, 0.0)
    setpoints = np.where(instants < 0.0, 0.0, 1.0)
    rows = [
        v.predict_speed(
            ESTIMATE, parameters(designed), LOOP, setpoints, (instants, ages), instants[60:230]
        )[0]
        for ages in (np.zeros(instants.size), silent)
    ]
    assert np.abs(rows[1] - rows[0]).max() > 0.02
    assert rows[1][-1] == pytest.approx(1.0, abs=0.02)


def test_prediction_includes_the_integral_left_by_the_previous_change(designed):
    # Friction of 2 V holds the wheel after each stop, so the integral is not reset.
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
    setpoints = np.array([asked(t) for t in run.time])
    answers = (run.time, np.full(run.time.size, STEP))
    row = v.predict_speed(estimate, parameters(designed), LOOP, setpoints, answers, even)[0]
    assert np.abs(row - speed).max() < 0.02 * setpoint


def test_arrival_delay_is_measured_from_the_applied_voltages():
    rng = np.random.default_rng(4)
    time = STEP * np.arange(200)
    commands, ages = rng.uniform(-10.0, 10.0, time.size), np.full(time.size, 0.001)
    # Commands act from the next sample on; between 0.50 and 0.54 s none arrives.
    arrived = time + STEP
    arrived[(arrived > 0.501) & (arrived < 0.539)] = 0.54
    latest = np.array([np.flatnonzero(arrived <= t + 1e-9)[-1:] for t in time[:-1]], dtype=object)
    voltage = np.array([0.0] + [float(commands[k[0]]) if k.size else 0.0 for k in latest])
    loop = {"delay": 0.0, "supply_voltage": 12.0}
    delays = v.measure_arrival_delays((time, ages, commands), (time, voltage), loop)
    # The first command has no predecessor; the last two act after the end of the record.
    np.testing.assert_allclose(delays[1:-2], (arrived - time)[1:-2], atol=1e-9)
    measured = voltage + rng.normal(0.0, 1.0, voltage.size)
    said = v.measure_arrival_delays((time, ages, commands), (time, measured), loop)
    assert np.array_equal(said, ages)
    slower = v.measure_arrival_delays(
        (time, ages, commands), (time, measured), {**loop, "delay": STEP}
    )
    assert np.array_equal(slower, np.full(time.size, STEP))


def test_command_in_the_driver_dead_zone_is_not_measured_as_delayed():
    # Drive, brake, a slow rise inside the dead zone of 1.5 V, drive.
    parts = (0.0, 60), (5.0, 100), (0.0, 1), (0.5, 100), (5.0, 100)
    commands = np.concatenate([np.full(lasts, volts) for volts, lasts in parts])
    commands += 1e-2 * np.arange(commands.size) * (commands != 0.0)
    time, ages = STEP * np.arange(commands.size), np.full(commands.size, 0.001)
    applied = np.where(np.abs(commands) < 1.5, 0.0, commands)
    voltage = np.concatenate(([0.0], applied[:-1]))
    loop = {"delay": 0.0, "supply_voltage": 12.0}
    delays = v.measure_arrival_delays((time, ages, commands), (time, voltage), loop)
    assert delays[1:].max() <= STEP + 1e-9


def test_excess_loop_delay_is_reported_and_included_in_the_bands(designed):
    slow = drive(designed, wait=0.03)
    assert slow.reading.overshoot > 10.0
    assert v.judge([slow]) == []
    (found,) = v.report_loop_delay([slow, drive(designed)])
    assert found.severity == "warning" and found.evidence["excess"] == slow.excess
    assert v.report_loop_delay([drive(designed)]) == []
    # Beyond those bands the message blames the computer, not the wheel.
    (refused,) = v.judge([replace(slow, bands=replace(slow.bands, overshoot=1.0))])
    assert refused.advice == found.advice != v.judge([drive(designed, offset=-0.05)])[0].advice


@pytest.mark.parametrize("gain", [0.6, 1.6])
def test_drive_of_a_different_motor_is_refused(designed, gain):
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


def test_steady_state_speed_error_is_refused(designed):
    found = v.judge([drive(designed, offset=-0.05)])
    assert any("stays off" in f.message for f in found)


def test_blocked_wheel_that_never_settles_is_refused_with_a_message(designed):
    # Twice the torque of 12 V blocks the wheel.
    stall = 2.0 * ENTRY.gearbox.ratio * 12.0 * ENTRY.parameters.motor_constant
    found = v.judge([drive(designed, load=stall / ENTRY.parameters.resistance)])
    assert any("more than was recorded" in f.message for f in found)


def test_silent_controller_is_refused_with_the_duration():
    assert v.report_silence(0.09) == []
    (found,) = v.report_silence(0.4)
    assert found.severity == "refused" and "0.40 s" in found.message and found.advice


def test_speed_resolution_matches_the_scatter_of_the_smoothed_slope():
    # A staircase of counts from a slow wheel: the smoothed slope scatters as the formula says.
    quantum, speed = 0.01, 0.37
    time = np.arange(0.0, 20.0, STEP)
    angle = quantum * np.floor(speed * time / quantum)
    _, slope = v.smooth_speed(time, angle, STEP)
    # Errors of a staircase are periodic, not independent: tolerance of a factor of two.
    assert 0.5 < np.std(slope[20:-20]) / v.resolution(quantum, STEP) < 2.0


SEGMENT_S = 1.0
PLAN = [
    (name, speed, SEGMENT_S)
    for name, speed in (("stand", 0.0), ("forward", 2.0), ("stop", 0.0), ("reverse", -1.0))
]


def make_table(time: np.ndarray, **columns: np.ndarray) -> Table:
    return Table(None, np.round(1e9 * time).astype(np.int64), columns)


def test_measured_settling_of_a_simulated_drive_matches_the_design(tmp_path):
    motors = find_config(PAPER_MOTORS)
    gains = tmp_path / "gains.yaml"
    assert tune.main([str(motors), "--output", str(gains), "--supply", "12"]) == 0
    given = driving.read_designs(read_estimates(motors), gains)
    stated = json.loads((tmp_path / "gains.json").read_text())["wheels"][WHEEL]["settling"]
    assert stated["common"]  # four wheels, one transition

    entry = load_motors(motors)[WHEEL]
    asked = [speed for _, speed, _ in PLAN]
    run = simulate_closed_loop(
        entry,
        verification.loop_settings(given.gains[WHEEL]),
        lambda t: asked[min(int(t / SEGMENT_S), len(asked) - 1)],
        SEGMENT_S * len(asked),
        timing=Timing(sample_time=STEP, delay=STEP),
        drive=DriveSettings(command_timeout=math.inf),
    )
    none = np.full(run.time.size, np.nan)
    state = make_table(run.time, encoder_count=run.count, position=none, voltage=none)
    setpoints = np.array([asked[min(int(t / SEGMENT_S), len(asked) - 1)] for t in run.time])
    steps = np.full(run.time.size, STEP)
    answers = make_table(run.time, setpoint=setpoints, output=none, age=steps, dt=steps)
    changes, _ = driving.read_wheel_changes(
        WHEEL, driving.DriveRecording(state, answers), PLAN, given
    )
    assert [(one.name, one.setpoint) for one in changes] == [("forward", 2.0), ("reverse", -1.0)]
    for one in changes:
        # Tolerance of two samples: another size of change, and speed from counts.
        assert abs(one.reading.settling - stated["value"]) <= 2 * STEP
        assert abs(one.reading.settling - one.expected.settling) <= STEP
        assert one.reading.overshoot < 1.0
    # A lagging wheel is detected: the same drive, 0.1 s late.
    late = driving.DriveRecording(make_table(run.time + 0.1, **state.columns), answers)
    (behind, *_), _ = driving.read_wheel_changes(WHEEL, late, PLAN, given)
    assert behind.reading.settling - stated["value"] > 0.05
    # A clock step during the drive gives one error line and allocates no samples for the gap.
    early = np.where(run.time < 0.5, 0.0, 1.7e9) + run.time
    torn = driving.DriveRecording(
        make_table(early, **state.columns), make_table(early, **answers.columns)
    )
    with pytest.raises(ProcessError, match="a clock was set"):
        driving.read_wheel_changes(WHEEL, torn, PLAN, given)
