"""Every node in simulated time: a clock that is missing is named, one that is there is followed."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from smp_interfaces.msg import MotorCommand, MotorState

NODES = {
    "motor_plant": (),
    "front_left/wheel_pid": ("-r", "__ns:=/front_left"),
    "skid_steer": (),
    "identifier": (),
    "serial_driver": ("-p", "wheel_names:=[another]", "-p", "device:=/dev/none"),
    "excite": ("-p", "wheel_names:=[nobody]", "-p", "wait:=1000.0"),
}
MISSING = "nothing is heard on /clock"


def test_a_missing_clock_is_named_by_every_node_and_a_present_one_followed(
    process: Callable[..., Any], node: Node, eventually: Callable[..., None]
) -> None:
    said: dict[str, str] = {}

    def listen(message: DiagnosticArray) -> None:
        said.update({status.name: status.message for status in message.status})

    node.create_subscription(DiagnosticArray, "/diagnostics", listen, 50)
    states: list[MotorState] = []
    node.create_subscription(MotorState, "front_left/motor_state", states.append, 10)
    commands: list[MotorCommand] = []
    node.create_subscription(MotorCommand, "front_left/motor_command", commands.append, 10)
    for name, more in NODES.items():
        executable = name.rpartition("/")[2]
        process(executable, "--ros-args", "-p", "use_sim_time:=true", *more)
    eventually(lambda: all(MISSING in said.get(n, "") for n in NODES), 30.0, node.spin, str(said))

    sender = node.create_publisher(Clock, "/clock", 10)
    steps = itertools.count(1000 * 200)  # of 5 ms

    def tick() -> None:
        message, k = Clock(), next(steps)
        message.clock.sec, message.clock.nanosec = k // 200, k % 200 * 5_000_000
        sender.publish(message)
        node.spin()

    eventually(lambda: not any(MISSING in said[n] for n in NODES), 10.0, tick, str(said))
    states.clear()
    commands.clear()
    eventually(lambda: len(states) > 5 and len(commands) > 5, 10.0, tick)
    now = next(steps) // 200
    assert all(1000 <= m.header.stamp.sec <= now for m in (*states, *commands))
