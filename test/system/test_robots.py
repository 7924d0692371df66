# SPDX-License-Identifier: Apache-2.0
"""Several robots: every executable in the robot's namespace, wheels one level below."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from domain_node import DomainNode
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from wheel_robot import two_wheeled

from smp_motor_control import WHEELS

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
