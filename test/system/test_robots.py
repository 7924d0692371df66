# SPDX-License-Identifier: Apache-2.0
"""Robots from the launch file, and several, each with all executables in its namespace."""

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from wheel_robot import DomainNode, two_wheeled

from smp_motor_control import WHEELS
from smp_motor_control.errors import ParameterError
from smp_motor_control.parameter_file import read_node_parameters, require_nodes

ROOT = Path(__file__).resolve().parents[2]
Process = Callable[..., Any]

SPEEDS = {"robot1": 0.1, "robot2": -0.15}
"""Speeds of the two bodies [m/s]."""


def begin(process: Process, robot: str, sides: tuple[str, str], motors: Path, gains: Path) -> None:
    process("motor_plant", "--ros-args", "-r", f"__ns:=/{robot}", "-p", f"motors_file:={motors}")
    left, right = (side.split() for side in sides)
    for wheel in (*left, *right):
        place = ("-r", f"__ns:=/{robot}/{wheel}", "--params-file", gains)
        process("wheel_pid", "--ros-args", *place)
    named = [f"{s}_wheel_names:=[{', '.join(n)}]" for s, n in (("left", left), ("right", right))]
    options = ("-r", f"__ns:=/{robot}", "-p", named[0], "-p", named[1])
    process("skid_steer", "--ros-args", *options)


def test_two_robots_with_two_and_four_wheels_drive_independently(
    process, eventually, tmp_path, ros_domain
):
    begin(process, "robot1", ("left", "right"), *two_wheeled(tmp_path))
    lefts, rights = " ".join(WHEELS[::2]), " ".join(WHEELS[1::2])
    config = ROOT / "config"
    begin(process, "robot2", (lefts, rights), config / "motors_paper.yaml", config / "gains.yaml")
    driver = DomainNode(ros_domain, "driver")
    node = driver.node
    seen: dict[str, list[Odometry]] = {robot: [] for robot in SPEEDS}
    senders = {}
    for robot, kept in seen.items():
        node.create_subscription(Odometry, f"/{robot}/odom", kept.append, 10)
        senders[robot] = node.create_publisher(TwistStamped, f"/{robot}/cmd_vel", 10)

    def settled() -> bool:
        return all(
            seen[robot] and abs(seen[robot][-1].twist.twist.linear.x - speed) < 0.1 * abs(speed)
            for robot, speed in SPEEDS.items()
        )

    def drive() -> None:
        for robot, speed in SPEEDS.items():
            message = TwistStamped()
            message.header.stamp = node.get_clock().now().to_msg()
            message.twist.linear.x = speed
            senders[robot].publish(message)
        driver.spin_for(0.02)

    eventually(settled, 60.0, drive)
    last = seen["robot1"][-1]
    assert (last.header.frame_id, last.child_frame_id) == ("robot1/odom", "robot1/base_link")
    driver.close()


LAUNCH = Path(__file__).parents[2] / "launch" / "smp.launch.py"


def test_launch_file_starts_plant_wheels_and_body_of_any_robot(tmp_path):
    pytest.importorskip("launch_ros", reason="ros2 launch is not among the wheels")
    from launch.actions import LogInfo
    from launch_ros.actions import Node

    from launch import LaunchContext

    spec = importlib.util.spec_from_file_location("smp_launch", LAUNCH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    context = LaunchContext()
    for entity in module.generate_launch_description().entities[:-1]:
        entity.execute(context)
    started = module.start(context)  # plus a remark where no URDF is published
    executables = [one.node_executable for one in started if isinstance(one, Node)]
    assert executables.count("wheel_pid") == 4
    assert {"motor_plant", "skid_steer"} <= set(executables)
    body = tmp_path / "body.yaml"
    names = "left_wheel_names: [front_left], right_wheel_names: [front_right]"
    body.write_text(f"/**/skid_steer: {{ros__parameters: {{{names}}}}}\n")
    context.launch_configurations.update(body=str(body), hardware="external")
    started = module.start(context)
    executables = [one.node_executable for one in started if isinstance(one, Node)]
    assert executables.count("wheel_pid") == 2  # those of the robot's one file
    assert "gains for the motors of the paper" in str(
        [part.text for one in started if isinstance(one, LogInfo) for part in one.msg]
    )
    context.launch_configurations["left_wheels"] = "left, left"
    with pytest.raises(ParameterError, match="named twice: left"):
        module.start(context)
    context.launch_configurations["left_wheels"] = "unknown"
    with pytest.raises(ParameterError, match="has no parameters for /unknown/wheel_pid"):
        module.start(context)


def test_parameter_file_applies_to_nodes_in_any_namespace(tmp_path):
    gains = LAUNCH.parents[1] / "config" / "gains.yaml"
    require_nodes(gains, [f"/{wheel}/wheel_pid" for wheel in WHEELS])
    require_nodes(gains, [f"/a/b/{wheel}/wheel_pid" for wheel in WHEELS])
    with pytest.raises(ParameterError, match="has no parameters for /front_left/motor_plant"):
        require_nodes(gains, ["/front_left/motor_plant"])
    with pytest.raises(ParameterError, match="cannot be read"):
        require_nodes(tmp_path / "none.yaml", [])


def test_node_parameters_are_read_from_any_namespace(tmp_path):
    file = tmp_path / "robot.yaml"
    file.write_text(
        "/**: {ros__parameters: {use_sim_time: true}}\n"
        "/robot1/skid_steer: {ros__parameters: {left_wheel_names: [left]}}\n"
        "/**/excite: {ros__parameters: {wheel_names: [left, right]}}\n"
    )
    found = read_node_parameters(file, "skid_steer")
    assert found == {"use_sim_time": True, "left_wheel_names": ["left"]}


def test_launch_file_compiles_and_names_existing_files():
    text = LAUNCH.read_text()
    compile(text, LAUNCH.name, "exec")
    root = LAUNCH.parents[1]
    for name in ("motors_paper.yaml", "gains.yaml", "skid_steer.yaml"):
        assert name in text
        assert (root / "config" / name).exists()
