# SPDX-License-Identifier: Apache-2.0
"""Motor files are read, and invalid ones are refused with a message."""

from pathlib import Path

import pytest

from smp_motor_control import WHEELS
from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.file import load_motors

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
