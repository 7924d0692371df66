# SPDX-License-Identifier: Apache-2.0
"""Every node in simulated time: it reports a missing clock and follows a present one."""

import itertools
import time
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from smp_interfaces.msg import MotorCommand, MotorState

GAINS = Path(__file__).resolve().parents[2] / "config" / "gains.yaml"

NODES = {
    "motor_plant": (),
    "front_left/wheel_pid": ("-r", "__ns:=/front_left"),
    "skid_steer": (),
    "identifier": (),
    "serial_driver": ("-p", "wheel_names:=[another]", "-p", "device:=/dev/none"),
    "excite": ("-p", "wheel_names:=[nobody]", "-p", "wait:=1000.0"),
}
MISSING = "/clock is not published"


def test_every_node_reports_a_missing_clock_and_follows_a_published_one(process, node, eventually):
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


class Pace:
    """Publishes a clock of another pace, every 5 ms of its own time at most."""

    def __init__(self, node: Node, factor: float) -> None:
        self.node, self.factor, self.now = node, factor, 5000.0
        self.sender = node.create_publisher(Clock, "/clock", 10)
        self.setpoints = node.create_publisher(JointState, "wheel_setpoints", 10)
        self.real = time.monotonic()

    def step(self) -> None:
        before, self.real = self.real, time.monotonic()
        # Skipped time on a busy machine is not made up for.
        self.now += min(self.factor * (self.real - before), 0.005)
        message = Clock()
        message.clock.sec, message.clock.nanosec = int(self.now), int(self.now % 1 * 1e9)
        self.sender.publish(message)
        self.setpoints.publish(JointState(name=["front_left_wheel_joint"], velocity=[1.0]))
        self.node.spin()


def stamp(message: MotorState) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_simulated_motors_move_in_simulated_time(process, node, eventually, factor):
    """The wheel turns at 1 rad/s of simulated time at any pace, without a fault."""
    states: list[MotorState] = []
    said: dict[str, str] = {}
    node.create_subscription(MotorState, "front_left/motor_state", states.append, 100)
    take = lambda m: said.update({one.name: one.message for one in m.status})  # noqa: E731
    node.create_subscription(DiagnosticArray, "/diagnostics", take, 50)
    simulated = ("-p", "use_sim_time:=true")
    process("motor_plant", "--ros-args", *simulated)
    process(
        "wheel_pid", "--ros-args", *simulated, "-r", "__ns:=/front_left", "--params-file", GAINS
    )
    pace = Pace(node, factor)
    turning = lambda: bool(states) and abs(states[-1].velocity - 1.0) < 0.1  # noqa: E731
    eventually(turning, 30.0, pace.step, str(said))
    begun = states[-1]
    eventually(lambda: stamp(states[-1]) - stamp(begun) > 3.0, 30.0, pace.step)
    passed = stamp(states[-1]) - stamp(begun)
    assert (states[-1].position - begun.position) / passed == pytest.approx(1.0, abs=0.02)
    assert said["front_left/wheel_pid"].startswith("driving")

    # Setting the clock back, as by replaying a log, does not move the motor.
    before, pace.now = len(states), pace.now - 60.0
    last = states[-1].position
    eventually(lambda: len(states) > before + 5, 20.0, pace.step)
    assert abs(states[-1].position - last) < 0.5
    # A stopped clock stops the motors and their feedback.
    quiet = len(states)
    end = time.monotonic() + 0.5
    while time.monotonic() < end:
        node.spin()
    assert len(states) <= quiet + 3
