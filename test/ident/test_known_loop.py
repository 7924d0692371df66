# SPDX-License-Identifier: Apache-2.0
"""Controllers of other firmware: commands reconstructed from a log, and gains exported to it."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from bench_scripts import load
from results import estimate
from scipy.linalg import expm

from smp_motor_ident.cli.identify import main
from smp_motor_ident.cli.tune import main as tune
from smp_motor_ident.errors import SignalError
from smp_motor_ident.record import Hardware, Record
from smp_motor_ident.report.document import identification_document
from smp_motor_ident.tune import Loop, design
from smp_motor_ident.tune.exports import FORMATS, TARGETS, check
from smp_motor_ident.tune.known_loop import reconstruct

ROOT = Path(__file__).resolve().parents[2]
GAIN, LAG, FAST, SUPPLY = 25.0, 0.09, 1e-4, 12.0
"""Gain [rad/s/V], lags [s] and supply [V] of the motor."""

LOOPS = {
    "linorobot2": (0.02, {"K_P": 20.0, "K_I": 4.0, "K_D": 0.0, "PWM_BITS": 10}, 60 / (2 * math.pi)),
    "ros_arduino_bridge": (0.033, {"Kp": 3, "Kd": 10, "Ki": 0, "Ko": 25}, 0.0),
    "arduino_pid": (0.01, {"Kp": 15.0, "Ki": 150.0, "Kd": 0.0, "SampleTime": 10}, 1.0),
    "ros2_controllers": (
        0.01,
        {"p": 0.8, "i": 9.0, "d": 0.0, "u_clamp_max": 12.0, "u_clamp_min": -12.0,
         "tracking_time_constant": 0.1, "feedforward_gain": 0.0},
        1.0,
    ),
}  # fmt: skip
"""Interval, gains, and the target's unit of a wheel's rad/s."""


# Written from the targets' documentation for the paper's gearbox and encoder: use this motor's
# speeds as theirs.
BENCH = load("exports")
RATIO, COUNTS = BENCH.RATIO, BENCH.COUNTS


def drive(name: str, seconds: float = 20.0, seed: int = 3):
    """Drive the motor by the benchmark's law; return set-points, speeds and voltages."""
    ratio, counts, (T, numbers, unit) = RATIO, COUNTS, LOOPS[name]
    unit = unit or counts * ratio / (2 * math.pi) * T
    A = np.zeros((4, 4))
    A[0, 1], A[2, 0] = 1.0, 1.0
    A[1] = (-1 / (LAG * FAST), -(LAG + FAST) / (LAG * FAST), 0.0, GAIN / (LAG * FAST))
    advance = expm(A * T)
    law, rng = BENCH.LAWS[name](numbers, T), np.random.default_rng(seed)
    n = round(seconds / T)
    targets = np.repeat(rng.uniform(-150.0, 150.0, n // 20 + 1), 20)[:n] / ratio
    if name == "ros_arduino_bridge":  # whole ticks, and none that is 0, which stops this board
        targets = np.rint(targets * unit)
        targets[targets == 0] = 1.0
        targets = (targets + 0.01 * np.sign(targets)) / unit  # the law truncates to it
    targets[:3] = 0.0
    x, before, volts = np.zeros(4), 0, np.zeros(n)
    speed = np.zeros(n)
    for k in range(n):
        count = math.floor(x[2] * counts / (2 * math.pi))
        turned, before = count - before, count
        speed[k] = turned / T * 2 * math.pi / counts / ratio  # [rad/s], wheel
        x[3] = law(targets[k] * ratio, speed[k] * ratio, turned) if k > 2 else 0.0
        volts[k] = x[3]
        x = advance @ x
    logged = np.rint(targets * unit) if name == "ros_arduino_bridge" else targets * unit
    return T * np.arange(n), logged, speed, volts


def record(time, setpoints, speed, **hardware) -> Record:
    """Return the record as the reader gives it: a set-point holds from its row on."""
    known = {"gear_ratio": RATIO, "counts_per_revolution": COUNTS, "supply_voltage": SUPPLY}
    held = np.concatenate(([0.0], setpoints[:-1]))
    return Record("left", time, held, velocity=speed * RATIO, hardware=Hardware(**known | hardware))


def given(name: str) -> dict[str, float]:
    return dict(FORMATS[name].known.defaults) | LOOPS[name][1]


@pytest.mark.parametrize("name", LOOPS)
def test_the_command_is_reconstructed(name):
    time, setpoints, speed, volts = drive(name)
    # Nine digits, as logs have them.
    rounded = np.array([float(f"{v:.9g}") for v in speed])
    got = reconstruct(record(time, setpoints, rounded), FORMATS[name].known, given(name))
    # Two independent implementations of the rule; integers may round differently once.
    assert np.mean(np.abs(got.voltage[1:] - volts[:-1]) > 0.05) < 0.01
    assert [f.code for f in got.findings] == ["reconstructed_voltage"]


@pytest.mark.parametrize("name", ["linorobot2", "arduino_pid"])
def test_motor_is_identified_from_reconstructed_commands(name, tmp_path):
    time, setpoints, speed, _ = drive(name)
    log = tmp_path / "log.csv"
    np.savetxt(log, np.column_stack((time, setpoints, speed)), delimiter=",", comments="",
               header="t,target,speed", fmt="%.9g")  # fmt: skip
    numbers = [f"{k}={v}" for k, v in LOOPS[name][1].items()]
    code = main([str(log), "--controller", name, *numbers, "--quiet", "--output",
                 str(tmp_path / "r"), "--map", "time=t", "setpoint=target", "velocity=speed",
                 f"gear_ratio={RATIO}", f"counts_per_revolution={COUNTS}",
                 f"supply_voltage={SUPPLY}"])  # fmt: skip
    assert code == 0
    document = json.loads((tmp_path / "r" / "identification.json").read_text())
    (motor,) = document["motors"].values()
    for key, truth in (("dc_gain", GAIN), ("time_constant", LAG + FAST)):
        found = motor["combinations"][key]
        # Four standard deviations: 1 in 16,000 by chance, and the seed is fixed.
        assert abs(found["value"] - truth) < 4 * found["std"]
        # The delay of the driver within a period of 20 ms is unknown.
        assert found["std"] < 0.02 * truth + (0.1 * 0.02 if key == "time_constant" else 0.0)
    # Speeds are whole ticks: the gain comes from 20 s of counts, not from rounded speeds.
    assert motor["combinations"]["dc_gain"]["std"] < 1e-4 * GAIN
    assert "reconstructed_voltage" in [f["code"] for f in motor["findings"]]


def test_commands_that_cannot_be_reconstructed_are_refused():
    loop, numbers = FORMATS["arduino_pid"].known, given("arduino_pid")
    time, setpoints, speed, _ = drive("arduino_pid", 6.0)
    whole = record(time, setpoints, speed)
    with pytest.raises(SignalError, match="begins while the loop is running"):
        reconstruct(whole.slice(100, 400), loop, numbers)
    with pytest.raises(SignalError, match="ran every 20 ms"):
        reconstruct(whole, loop, numbers | {"SampleTime": 20})
    with pytest.raises(SignalError, match="the supply is unknown"):
        reconstruct(record(time, setpoints, speed, supply_voltage=None), loop, numbers)
    coarse = record(time, setpoints, np.round(speed, 1), counts_per_revolution=None)
    with pytest.raises(SignalError, match=r"logged in steps of 0\.1 rad/s.*log more digits"):
        reconstruct(coarse, loop, numbers)


def test_reconstruction_ends_at_a_lost_sample():
    time, setpoints, speed, volts = drive("arduino_pid", 6.0)
    kept = np.arange(time.size) != 300
    one = record(time[kept], setpoints[kept], speed[kept])
    got = reconstruct(one, FORMATS["arduino_pid"].known, given("arduino_pid"))
    assert len(got) == 300
    assert "lost_loop" in [f.code for f in got.findings]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["linorobot2", "K_P=1"], "give K_I=..."),
        (["linorobot2", "K_P=1", "K_I=1", "K_X=1"], "takes K_P, K_I"),
        (["arduino", "Kp=1"], "must be one of"),
    ],
)
def test_incomplete_or_unknown_controller_gains_are_refused(arguments, complaint, tmp_path, capsys):
    assert main(["log.csv", "--controller", *arguments, "--output", str(tmp_path / "r")]) == 2
    assert complaint in capsys.readouterr().err


def test_set_points_and_speeds_from_different_topics_are_refused(tmp_path, capsys):
    code = main(["bag", "--controller", "linorobot2", "K_P=1", "K_I=1", "--output",
                 str(tmp_path / "r"), "--map", "setpoint=/cmd.data",
                 "velocity=/state.speed"])  # fmt: skip
    assert code == 2
    assert "one message or row" in capsys.readouterr().err


MOTORS = ROOT / "config" / "motors_paper.yaml"


@pytest.mark.parametrize("name", FORMATS)
def test_target_arithmetic_settles_and_overshoots_as_specified(name):
    motors = [*BENCH.TABLE_1.values(), *BENCH.random_motors(1)]
    for motor in motors:
        _, _, over, overshot, peak, kept = BENCH.attempt(name, motor)
        # From 1.2 times the settling time on it stays within half a percent of the band: the slow
        # tail of the integral enters at a shallow angle, where counts and PWM steps move it.
        assert kept
        assert overshot == pytest.approx(over, abs=1.5)
        assert over < 10.0
        # Rounded to five digits, and to whole numbers of three.
        assert peak <= 1.4 * 1.02


@pytest.mark.parametrize("name", FORMATS)
def test_export_writes_parameters_and_limitations(name, tmp_path, capsys):
    output = tmp_path / "gains.txt"
    assert tune([str(MOTORS), "--export", name, "--output", str(output)]) == 0
    text = output.read_text()
    assert "not expressed: " in text
    assert "phase margin" in text
    for word in {
        "linorobot2": ("#define K_P", "#define K_I"),
        "ros_arduino_bridge": ("int Kp = ", "// Ko: ", "#define PID_RATE 30  // 33 ms"),
        "arduino_pid": ("SetOutputLimits(-255, 255)", "rear_left_pid"),
        "ros2_controllers": ("pid_controller/PidController",),
    }[name]:
        assert word in text
    if name == "ros2_controllers":
        tree = yaml.safe_load(text)["pid_controller"]["ros__parameters"]
        assert tree["gains"]["rear_right_wheel_joint"]["p"] > 0
        assert len(tree["dof_names"]) == 4
    assert tune([str(MOTORS), "--export", name, "--output", str(output)]) == 2
    assert "exists" in capsys.readouterr().err


def test_integer_gains_report_their_steady_state_error():
    target = FORMATS["ros_arduino_bridge"]
    loop = Loop(
        sample_time=1 / 30, counts_per_revolution=11.0, speed_source="difference", gear_ratio=30.0
    )
    loop = replace(loop, noise_voltage=3.0)
    one = design(BENCH.estimate_of(BENCH.TABLE_1["rear_left"]), loop, samples=60, **TARGETS)
    gains = target.convert(one)
    numbers = gains.numbers
    # Integer division gives zero for errors below Ko/Kp ticks.
    rest = math.ceil(numbers["Ko"] / numbers["Kp"]) * 2 * np.pi / 11 * 30
    assert gains.resting_error <= rest
    assert check(one, gains).resting_error > 0


def test_unsupported_control_interval_is_refused_with_the_nearest_rate(tmp_path, capsys):
    for name, rate, nearest in (
        ("arduino_pid", "300", "--rate 333.333"),
        ("ros_arduino_bridge", "30", "--rate 30.303"),  # integer 1000 / 30
    ):
        assert tune([str(MOTORS), "--export", name, "--rate", rate]) == 1
        assert nearest in capsys.readouterr().err


def test_a_wheel_blocked_at_full_speed_does_not_overflow_16_bits():
    target = FORMATS["ros_arduino_bridge"]
    loop = Loop(sample_time=0.033, counts_per_revolution=4000.0, speed_source="difference")
    one = design(BENCH.estimate_of(BENCH.TABLE_1["front_left"]), loop, samples=60, **TARGETS)
    numbers = target.convert(one).numbers
    fastest = BENCH.SUPPLY / BENCH.combinations(BENCH.TABLE_1["front_left"])[0]
    assert 0 < numbers["Kd"] * fastest * 4000 / (2 * math.pi) * 0.033 <= 32767


@pytest.mark.parametrize("name", FORMATS)
def test_identification_texts_cannot_escape_comments_in_exports(tmp_path, capsys, name):
    hostile = "a\\\n#define EVIL 1"
    finding = {"code": "x", "severity": "warning", "message": hostile, "evidence": {}, "advice": ""}
    document = identification_document({"robot1/left": estimate()})
    document["motors"]["robot1/left"] |= {"findings": [finding], "sources": [hostile]}
    (tmp_path / "identification.json").write_text(json.dumps(document))
    given = ["--supply", "12", "--counts-per-revolution", "500", "--accept-unreliable"]
    assert tune([str(tmp_path), "--export", name, *given]) == 0
    text = capsys.readouterr().out
    assert not [line for line in text.splitlines() if line.startswith("#define EVIL")]
    assert not [line for line in text.splitlines() if line.endswith("\\")]
    assert "robot1/left_pid" not in text  # not a C identifier
