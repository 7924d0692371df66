# SPDX-License-Identifier: Apache-2.0
"""A node with invalid settings reports them in one line and exits with code 2."""

import pytest

from smp_motor_control.errors import ParameterError
from smp_motor_control.nodes import excite, serial_driver

WHEEL = "-r __ns:=/front_left"
REFUSED = [
    ("excite", "-p amplitude:=20.0", "must not exceed max_voltage"),
    ("excite", "-p signal:=noise", "known are sine"),
    ("excite", "-p wheels:=[left] -p wait:=0.2", "no subscriber on /left/motor_command"),
    ("excite", "-p duration:=-1.0", "duration is -1.0"),
    ("identifier", "-p window:=3.0", "window is 3"),
    ("motor_plant", "-p rate:=fast", "rate is 'fast'"),
    ("motor_plant", "-p motors_file:=/nowhere.yaml", "/nowhere.yaml: cannot be read"),
    ("motor_plant", "--params-file /nowhere.yaml", "/nowhere.yaml"),
    ("serial_driver", "-p wheel_names:=[left,left]", "serial_driver: a wheel is named twice"),
    ("serial_driver", "-p supply_voltage:=-12.0", "serial_driver: supply_voltage is -12"),
    ("skid_steer", "-p wheel_radius:=-0.1", "wheel_radius"),
    ("skid_steer", "-p angular.z.max_velocity:=1.0 -p angular.z.min_velocity:=2.0", "angular.z"),
    ("skid_steer", "-p use_stamped_vel:=3", "use_stamped_vel"),
    ("skid_steer", "-p left_wheel_names:=[a,front_right]", "named twice"),
    ("teleop_wheels", "", "not a terminal"),
    ("wheel_pid", "", "joint_name is empty"),
    ("wheel_pid", f"-p i:=-100.0 {WHEEL}", "i is -100; it must be in [0,"),
    ("wheel_pid", f"-p i_clamp_max:=-1.0 {WHEEL}", "i_clamp_m"),
]


@pytest.mark.parametrize(("node", "given", "words"), REFUSED)
def test_node_refuses_invalid_settings_in_one_line(process, node, given, words):
    started = process(node, "--ros-args", *given.split())
    assert started.wait(20.0) == 2
    (line,) = started.output.strip().splitlines()
    assert words in line


@pytest.mark.parametrize(
    ("node", "given", "words"),
    [
        (excite, {"wheel_names": ("left", "left")}, "named twice: left"),
        (excite, {"wheels": ("left", "left")}, "named twice: left"),
        (excite, {"wheels": ("front left",)}, "wheel name 'front left'"),
        (excite, {"wheels": ("",)}, "wheel name ''"),
        (excite, {"wheel_names": ("all/", "b")}, "wheel name 'all/'"),
        (serial_driver, {"wheel_names": ("left", "left")}, "a wheel is named twice: left"),
        (serial_driver, {"wheel_names": ()}, "wheel_names is empty"),
        (serial_driver, {"wheel_names": ("",)}, "wheel name ''"),
        (serial_driver, {"wheel_names": ("front left",)}, "wheel name 'front left'"),
        (serial_driver, {"wheel_names": ("1st",)}, "wheel name '1st'"),
        (serial_driver, {"wheel_names": ("a/../b",)}, "wheel name"),
        (serial_driver, {"wheel_names": ("a" * 300,)}, "at most 100"),
        (serial_driver, {"baud": 0}, "baud is 0"),
        (serial_driver, {"baud": -9600}, "baud is -9600"),
        (serial_driver, {"gear_ratio": -1.0}, "gear ratio is -1.0"),
        (serial_driver, {"gear_ratio": 0.0}, "gear ratio is 0.0"),
        (serial_driver, {"encoder_bits": 1}, "encoder_bits is 1"),
    ],
)
def test_invalid_wheel_names_and_hardware_settings_are_refused(node, given, words):
    with pytest.raises(ParameterError, match=words):
        node.Settings(**given)
