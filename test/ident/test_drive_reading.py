# SPDX-License-Identifier: Apache-2.0
"""Set-point changes in a recorded drive, evaluated against the design."""

import json
import math

import numpy as np
import pytest
from wheel_simulation import Timing, simulate_closed_loop

from smp_motor_control.motor.file import PAPER_MOTORS, find_config, load_motors
from smp_motor_control.motor.hardware import DriveSettings
from smp_motor_ident.bag.storage import Table
from smp_motor_ident.cli import driving, tune
from smp_motor_ident.cli.processes import ProcessError
from smp_motor_ident.cli.tuning import read_estimates
from smp_motor_ident.tune import verification

WHEEL, STEP, LASTS = "front_left", 0.005, 1.0
PLAN = [
    (name, speed, LASTS)
    for name, speed in (("stand", 0.0), ("forward", 2.0), ("stop", 0.0), ("reverse", -1.0))
]


def table(time: np.ndarray, **columns: np.ndarray) -> Table:
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
        lambda t: asked[min(int(t / LASTS), len(asked) - 1)],
        LASTS * len(asked),
        timing=Timing(sample_time=STEP, delay=STEP),
        drive=DriveSettings(command_timeout=math.inf),
    )
    none = np.full(run.time.size, np.nan)
    state = table(run.time, encoder_count=run.count, position=none, voltage=none)
    setpoints = np.array([asked[min(int(t / LASTS), len(asked) - 1)] for t in run.time])
    steps = np.full(run.time.size, STEP)
    answers = table(run.time, setpoint=setpoints, output=none, age=steps, dt=steps)
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
    late = driving.DriveRecording(table(run.time + 0.1, **state.columns), answers)
    (behind, *_), _ = driving.read_wheel_changes(WHEEL, late, PLAN, given)
    assert behind.reading.settling - stated["value"] > 0.05
    # A clock step during the drive gives one error line and allocates no samples for the gap.
    early = np.where(run.time < 0.5, 0.0, 1.7e9) + run.time
    torn = driving.DriveRecording(table(early, **state.columns), table(early, **answers.columns))
    with pytest.raises(ProcessError, match="a clock was set"):
        driving.read_wheel_changes(WHEEL, torn, PLAN, given)
