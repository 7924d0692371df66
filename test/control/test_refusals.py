# SPDX-License-Identifier: Apache-2.0
"""Invalid parameter values and motor files are refused with their name."""

import math
from collections.abc import Iterator
from pathlib import Path

import pytest

from smp_motor_control import WHEELS
from smp_motor_control.body.command import BodyCommand
from smp_motor_control.body.kinematics import SkidSteer
from smp_motor_control.body.odometry import Odometry
from smp_motor_control.encoder import Encoder
from smp_motor_control.errors import ParameterError
from smp_motor_control.motor import MotorParameters
from smp_motor_control.motor.file import load_motors
from smp_motor_control.motor.hardware import DriveSettings
from smp_motor_control.motor.parameters import MotorModel
from smp_motor_control.nodes.teleop_wheels import Speeds
from smp_motor_control.observer import ObserverNoise
from smp_motor_control.pid import PidGains
from smp_motor_control.reference.profile import ProfileLimits
from smp_motor_control.wheel.faults import FaultLimits
from smp_motor_control.wheel.loop import LoopSettings

NAN, INF = math.nan, math.inf
MOTOR = dict(resistance=1.0, inductance=0.1, motor_constant=0.1, inertia=1e-5, viscous_friction=0.0)
AXLE = dict(wheel_separation=0.5, left_radius=0.1, right_radius=0.125)
TABLE = [
    # class, other arguments, parameter names, and values that each of them refuses
    (MotorParameters, MOTOR, "resistance", (0.0, True)),
    (MotorParameters, MOTOR, "inertia", (-1e-6, 0.0)),
    (MotorParameters, MOTOR, "motor_constant", (NAN,)),
    (MotorParameters, MOTOR, "inductance", (-1.0,)),
    (MotorParameters, MOTOR, "coulomb_friction", (INF,)),
    (MotorParameters, MOTOR, "viscous_friction", ("much",)),
    (MotorModel, dict(dc_gain=25.0, time_constant=0.05),
     "dc_gain time_constant static_voltage delay", (-1.0, NAN, INF)),
    (ObserverNoise, {}, "load voltage count", (0.0, -1.0, NAN, INF)),
    (Encoder, {}, "counts_per_revolution", (0.0, 0.9e-3, 1.1e9, NAN, -500.0)),
    (DriveSettings, {}, "pwm_steps", (-1,)),
    (DriveSettings, {}, "current_noise", (NAN,)),
    (PidGains, {}, "p tracking_time_constant feedforward_velocity",
     (NAN, INF, -INF, "1", None, True)),
    (PidGains, {}, "error_deadband derivative_filter_time_constant feedforward_static", (-0.1,)),
    (ProfileLimits, {}, "velocity acceleration jerk", (0.0, -1.0, NAN)),
    (LoopSettings, {}, "stop_time", (0.04, 0.0, -1.0, 10.1, INF, NAN)),
    (LoopSettings, {}, "reference_delay", (math.nextafter(10.0, INF), -5e-324, NAN)),
    (LoopSettings, {}, "reference_delay_uncertainty", (math.nextafter(1.0, INF), -5e-324, NAN)),
    (LoopSettings, {}, "transition_time", (math.nextafter(60.0, INF), -5e-324, NAN)),
    (FaultLimits, {},
     "current_limit current_time stall_voltage stall_velocity stall_time runaway_time "
     "tracking_tolerance tracking_time", (-1e-9, INF, NAN)),
    (SkidSteer, dict(wheel_separation=0.4, wheel_radius=0.1),
     "wheel_separation wheel_radius wheel_separation_multiplier max_wheel_speed",
     (0.0, -1.0, NAN)),
    (Odometry, AXLE, "wheel_separation left_radius right_radius", (0.0, -0.1, NAN, INF)),
    (Odometry, AXLE, "travel_noise turn_noise", (-1e-9, NAN, INF)),
    (Odometry, AXLE, "window", (0,)),
    (Odometry, AXLE, "max_wheel_speed", (0.0, NAN)),
    (BodyCommand, {}, "timeout", (-0.1, NAN, INF)),
    (Speeds, {}, "linear angular wheel step timeout", (0.0, -1.0, NAN, INF)),
]  # fmt: skip


def cases() -> Iterator[object]:
    for make, others, names, values in TABLE:
        for name in names.split():
            yield pytest.param(make, others, name, values, id=f"{make.__name__}.{name}")


@pytest.mark.parametrize(("make", "others", "name", "values"), list(cases()))
def test_invalid_value_is_refused_with_its_name(make, others, name, values):
    for value in values:
        with pytest.raises(ParameterError, match=name):
            make(**{**others, name: value})


@pytest.mark.parametrize(
    ("make", "others", "name", "values"),
    [
        (LoopSettings, {}, "reference_delay", (0.0, 10.0)),
        (LoopSettings, {}, "reference_delay_uncertainty", (0.0, 1.0)),
        (LoopSettings, {}, "transition_time", (0.0, 60.0)),
        (Odometry, AXLE, "travel_noise", (0.0,)),
        (Odometry, AXLE, "turn_noise", (0.0,)),
        (Odometry, AXLE, "window", (1,)),
        (Odometry, AXLE, "max_wheel_speed", (1e-3,)),
        *((FaultLimits, {}, name, (0.0,)) for name in FaultLimits.__dataclass_fields__),
    ],
)
def test_value_at_its_limit_is_accepted(make, others, name, values):
    for value in values:
        made = make(**{**others, name: value})
        assert getattr(made, name, value) == value


PAPER = Path(__file__).parents[2] / "config" / "motors_paper.yaml"
GOOD = """/motor_plant:
  ros__parameters:
    rate: 200.0
    motors:
      front_left: {resistance: 12.9, inductance: 0.31, motor_constant: 0.011, inertia: 1e-6,
                   viscous_friction: 2.4e-5, gear_ratio: 65.5, encoder_bits: 16}
"""


def write_motor_file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "motors.yaml"
    path.write_text(text)
    return path


def test_motor_configuration_matches_table_1_of_the_paper():
    motors = load_motors(PAPER, WHEELS)
    assert tuple(motors) == WHEELS
    first = motors["front_left"]
    # Table 1, motor 1: J, K, L, R, b.
    assert first.parameters.inertia == 1.13e-6
    assert first.parameters.motor_constant == 0.011029
    assert first.parameters.inductance == 0.30994
    assert first.parameters.resistance == first.resistance == 12.919
    assert first.parameters.viscous_friction == 2.40e-5
    assert first.gearbox.ratio == 65.5 and first.encoder.counts_per_revolution == 500.0


def test_exponent_without_decimal_point_is_read_as_number(tmp_path):
    entry = load_motors(write_motor_file(tmp_path, GOOD))["front_left"]
    assert entry.parameters.inertia == 1e-6
    assert entry.encoder.bits == 16 and entry.supply_voltage == 12.0


def test_motor_given_by_combinations_has_unknown_current(tmp_path):
    text = GOOD[: GOOD.index("front_left")] + (
        "front_left: {dc_gain: 25.0, time_constant: 0.05, static_voltage: 0.4, delay: 0.002}\n"
    )
    entry = load_motors(write_motor_file(tmp_path, text))["front_left"]
    assert entry.parameters.dc_gain == pytest.approx(25.0, rel=1e-12)
    assert entry.parameters.static_voltage == pytest.approx(0.4, rel=1e-12)
    assert not entry.knows_current and entry.delay == 0.002


def test_dotted_names_equal_nested_keys(tmp_path):
    text = "motor_plant:\n  ros__parameters:\n    motors.rear_left.dc_gain: 20.0\n"
    text += "    motors.rear_left.time_constant: 0.1\n"
    assert (
        load_motors(write_motor_file(tmp_path, text))["rear_left"].parameters.time_constant == 0.1
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("inertia: 1e-6", "inertia: -1e-6"), "front_left: inertia is -1e-06"),
        (("inertia: 1e-6", "inertia: heavy"), "front_left: inertia is 'heavy'"),
        (("inertia: 1e-6", "inertia: .nan"), "front_left: inertia is nan"),
        (("inertia: 1e-6", "inertia: true"), "front_left: inertia is True"),
        (("inertia: 1e-6,", ""), "front_left: inertia is missing"),
        (("inertia:", "inertja:"), "unknown key 'inertja'"),
        (("encoder_bits: 16", "encoder_bits: 70"), "encoder_bits"),
        (("encoder_bits: 16", "encoder_bits: 7.5"), "encoder_bits"),
        (("gear_ratio: 65.5", "gear_ratio: 0"), "gear ratio"),
        (("front_left", "front left"), "wheel name 'front left'"),
        (("motors:", "engines:"), "has no motors"),
        (("{", "["), "is not YAML"),
    ],
)
def test_invalid_motor_file_is_refused_in_one_line_with_file_and_value(tmp_path, change, words):
    path = write_motor_file(tmp_path, GOOD.replace(*change))
    with pytest.raises(ParameterError) as caught:
        load_motors(path)
    message = str(caught.value)
    assert words in message and "motors.yaml" in message and "\n" not in message


def test_missing_motor_and_missing_file_are_reported(tmp_path):
    with pytest.raises(ParameterError, match=r"rear_right is missing; has front_left"):
        load_motors(write_motor_file(tmp_path, GOOD), ["front_left", "rear_right"])
    with pytest.raises(ParameterError, match=r"nowhere\.yaml: cannot be read"):
        load_motors(tmp_path / "nowhere.yaml")
