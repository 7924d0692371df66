# SPDX-License-Identifier: Apache-2.0
"""Another node on a wheel: two publishers are reported, and a foreign controller is paused."""

import math
import threading
from collections.abc import Iterator

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from wheel_robot import DomainNode, spinning

from smp_interfaces.msg import MotorCommand, MotorState
from smp_motor_control.nodes.publishers import DECISIVE_FALLS, PublisherWatch
from smp_motor_control.nodes.robot_client import RobotClient, RobotError
from smp_motor_control.nodes.runtime import LATCHED

WHEELS = ("left", "right")
STUCK = ["--ros-args", "-r", "__ns:=/left", "-p", "p:=2.0", "-p", "stall_time:=0.0",
         "-p", "tracking_time:=0.0"]  # fmt: skip
"""Arguments of a wheel_pid that tolerates a wheel that never turns."""
BOTH = "/left/motor_state comes from /driver and /forgotten at once; end one of them"


class Driver(DomainNode):
    """Publishes the states of two wheels at a fixed position."""

    def __init__(self, domain: int, name: str, position: float) -> None:
        super().__init__(domain, name)
        make = self.node.create_publisher
        self.states = [make(MotorState, f"{wheel}/motor_state", 10) for wheel in WHEELS]
        self.setpoints = make(JointState, "wheel_setpoints", 10)
        self.position, self.stamped, self.speed = position, True, 0.0

    def publish(self) -> None:
        message = MotorState(position=self.position, velocity=self.speed, current=math.nan)
        if self.stamped:
            message.header.stamp = self.node.get_clock().now().to_msg()
        for publisher in self.states:
            publisher.publish(message)

    def ask(self, speed: float) -> None:
        self.setpoints.publish(JointState(name=["left_wheel_joint"], velocity=[speed]))


class Robot:
    """A driver, optionally a second, forgotten one, and the nodes' diagnostics."""

    def __init__(self, domain: int) -> None:
        self.driver = Driver(domain, "driver", 1.0)
        self.forgotten: Driver | None = None
        self.domain = domain
        self.said: dict[str, str] = {}
        self.voltages: list[float] = []
        node = self.driver.node
        node.create_subscription(DiagnosticArray, "/diagnostics", self.take, 100)
        heard = lambda message: self.voltages.append(message.voltage)  # noqa: E731
        node.create_subscription(MotorCommand, "left/motor_command", heard, 100)

    def take(self, message: DiagnosticArray) -> None:
        self.said.update({one.name: one.message for one in message.status})

    def run(self) -> None:
        self.driver.publish()
        self.driver.ask(1.0)
        if self.forgotten is not None:
            self.forgotten.publish()
        self.driver.spin()

    def forget(self) -> None:
        self.forgotten = Driver(self.domain, "forgotten", 9.0)

    def end_the_forgotten(self) -> None:
        assert self.forgotten is not None
        self.forgotten.close()
        self.forgotten = None


@pytest.fixture
def robot(ros_domain: int) -> Iterator[Robot]:
    robot = Robot(ros_domain)
    yield robot
    robot.driver.close()
    if robot.forgotten is not None:
        robot.forgotten.close()


def parameter_arguments(*parameters: str) -> list[str]:
    return ["--ros-args", *(part for one in parameters for part in ("-p", one))]


@pytest.fixture
def readers(process) -> None:
    """Start the nodes that read the states of the wheels."""
    process("wheel_pid", *STUCK)
    process(
        "skid_steer", *parameter_arguments("left_wheel_names:=[left]", "right_wheel_names:=[right]")
    )
    process("identifier", *parameter_arguments("wheels:=[left]", "period:=0.5"))


def test_every_reader_reports_both_publishers_and_the_wheel_stops(
    process, robot, readers, eventually
):
    recorder = process("record", "--output", "bag")
    nodes = ("left/wheel_pid", "skid_steer", "identifier")
    eventually(lambda: set(nodes) <= set(robot.said), 20.0, robot.run)
    eventually(lambda: robot.voltages and robot.voltages[-1] > 0.0, 20.0, robot.run)
    assert not any("at once" in message for message in robot.said.values())

    robot.forget()
    for name in nodes:
        eventually(lambda name=name: BOTH in robot.said[name], 20.0, robot.run, robot.said[name])
    eventually(lambda: BOTH in recorder.output, 20.0, robot.run, recorder.output)
    assert robot.said["left/wheel_pid"].startswith("two publishers of motor_state: 0 V")
    robot.voltages.clear()
    eventually(lambda: len(robot.voltages) > 20, 5.0, robot.run)
    assert set(robot.voltages) == {0.0}

    robot.end_the_forgotten()
    for name in nodes:
        eventually(lambda name=name: "at once" not in robot.said[name], 20.0, robot.run)
    eventually(lambda: robot.voltages[-1] > 0.0, 20.0, robot.run)


def test_two_publishers_of_set_points_are_reported(process, robot, eventually):
    process("wheel_pid", "--ros-args", "-r", "__ns:=/left", "-p", "p:=2.0")
    eventually(lambda: "left/wheel_pid" in robot.said, 20.0, robot.run)
    robot.forget()
    assert robot.forgotten is not None
    robot.forgotten.publish = lambda: robot.forgotten.ask(-1.0)  # type: ignore[method-assign]
    both = "/wheel_setpoints comes from /driver and /forgotten at once"
    eventually(lambda: both in robot.said["left/wheel_pid"], 20.0, robot.run, str(robot.said))


def test_client_refuses_wheel_with_two_publishers(robot):
    with RobotClient(name="tool") as client:
        client.node.create_timer(0.01, robot.run)
        assert client.wait_for_wheels(WHEELS, 20.0)["left"] > 5.0
        robot.forget()
        with pytest.raises(RobotError, match="comes from /driver and /forgotten at once"):  # noqa: PT012
            for _ in range(20):
                client.wait_for_wheels(WHEELS, 20.0)


def test_unstamped_states_are_reported_and_refused_by_tools(robot, readers, eventually):
    robot.driver.stamped = False
    for name in ("left/wheel_pid", "skid_steer"):
        eventually(lambda name=name: "no stamp" in robot.said.get(name, ""), 20.0, robot.run)
    # The arrival replaces the stamp: the wheel is driven, and its feedback used.
    eventually(lambda: robot.voltages and robot.voltages[-1] > 0.0, 20.0, robot.run)
    assert "no feedback" not in robot.said["skid_steer"]
    with RobotClient(name="tool") as client:
        client.node.create_timer(0.01, robot.run)
        with pytest.raises(RobotError, match="/left/motor_state has no stamp"):
            client.wait_for_wheels(["left"], 20.0)


def test_single_fall_of_sequence_numbers_is_a_publisher_restart():
    watch = PublisherWatch()
    for start in range(DECISIVE_FALLS - 1):
        assert watch.hear({"publication_sequence_number": 1}) is bool(start)
        for k in range(2, 50):
            assert not watch.hear({"publication_sequence_number": k})
    assert not watch.has_two_publishers
    for k in range(50, 60):
        watch.hear({"publication_sequence_number": k})
        watch.hear({"publication_sequence_number": k})
    assert watch.has_two_publishers


def test_no_second_publisher_is_reported_without_sequence_numbers():
    watch = PublisherWatch()
    for _ in range(100):
        assert not watch.hear({"publication_sequence_number": None})
    assert not watch.has_two_publishers


class Wheel:
    """A driver that publishes the owner of its wheel, and the services of that controller."""

    def __init__(self, node) -> None:
        self.node, self.state = node, "active"
        self.owners = node.create_publisher(String, "/left/motor_owner", LATCHED)
        self.owners.publish(String(data="/left/wheel_pid#7"))

    def serve(self) -> None:
        self.node.create_service(GetState, "/left/wheel_pid/get_state", self._tell)
        self.node.create_service(ChangeState, "/left/wheel_pid/change_state", self._change)

    def _tell(self, _, answer):
        answer.current_state.label = self.state
        return answer

    def _change(self, request, answer):
        stops = request.transition.id == Transition.TRANSITION_DEACTIVATE
        self.state = "inactive" if stops else "active"
        self.owners.publish(String(data="" if stops else "/left/wheel_pid#7"))
        answer.success = True
        return answer


@pytest.fixture
def wheel(node):
    wheel = Wheel(node)
    with spinning(node.spin):
        yield wheel


def test_controller_known_only_to_driver_is_paused_and_reactivated(wheel):
    late = threading.Timer(2.0, wheel.serve)
    late.start()
    with RobotClient(name="tester_of_pause", guarded=False) as client:
        with client.paused(["left"]):
            assert wheel.state == "inactive"
        assert wheel.state == "active"
    late.join()


def test_pause_of_wheel_owned_by_another_node_is_refused_with_its_name(wheel, monkeypatch):
    monkeypatch.setattr("smp_motor_control.nodes.robot_client.TIMEOUT_S", 3.0)
    wheel.owners.publish(String(data="/teleop#9"))
    with (
        RobotClient(name="tester_of_pause", guarded=False) as client,
        pytest.raises(RobotError, match="/left by /teleop#9"),
        client.paused(["left"]),
    ):
        pass
