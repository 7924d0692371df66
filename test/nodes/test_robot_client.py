# SPDX-License-Identifier: Apache-2.0
"""The client of a running robot while the ROS graph of a wheel is discovered step by step."""

import threading

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from std_msgs.msg import String

from smp_motor_control.nodes.robot_client import RobotClient, RobotError
from smp_motor_control.nodes.runtime import LATCHED


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

    def spin() -> None:
        while not ended.is_set():
            node.spin()

    ended = threading.Event()
    thread = threading.Thread(target=spin)
    thread.start()
    yield wheel
    ended.set()
    thread.join()


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
