# SPDX-License-Identifier: Apache-2.0
"""Timed drive of the wheels, which ends with zero set-points."""

import time
from collections.abc import Callable, Sequence

from sensor_msgs.msg import JointState

from smp_interfaces.msg import PidState
from smp_motor_control import get_joint_name
from smp_motor_control.nodes.robot_client import TIMEOUT_S, RobotClient, RobotError
from smp_motor_control.nodes.runtime import STREAM_PUBLISHER

COMMAND_PERIOD_S = 0.02
STANDSTILL_S = 1.0  # minimum standstill before a drive
QUIET_TIME_S = 0.5  # time without set-points of other nodes before a drive


def drive_wheels(
    client: RobotClient, steps: Sequence[tuple[str, float, float]], wheels: Sequence[str]
) -> None:
    """Drive all wheels, from standstill, through steps of (name, rad/s, s); stop in any case."""
    _refuse_other_senders(client)
    publisher = client.node.create_publisher(JointState, "wheel_setpoints", STREAM_PUBLISHER)
    message = JointState(name=[get_joint_name(wheel) for wheel in wheels])

    def send(speed: float) -> None:
        message.header.stamp = client.node.get_clock().now().to_msg()
        message.velocity = [float(speed)] * len(wheels)
        publisher.publish(message)

    try:
        _command_standstill(client, lambda: send(0.0), wheels)
        for _, speed, duration in steps:
            end = time.monotonic() + duration
            while (left := end - time.monotonic()) > 0:
                send(speed)
                client.spin(min(COMMAND_PERIOD_S, left))
    finally:
        for _ in range(3):
            send(0.0)
            client.spin(COMMAND_PERIOD_S)
        client.node.destroy_publisher(publisher)


def _command_standstill(
    client: RobotClient, send_zero: Callable[[], None], wheels: Sequence[str]
) -> None:
    """Command standstill until all wheels confirm it; discovery may take a while."""
    heard = dict.fromkeys(wheels, 0.0)

    def take(wheel: str, message: PidState) -> None:
        if message.setpoint == 0.0:
            heard[wheel] = time.monotonic()

    settled = time.monotonic() + STANDSTILL_S
    with client.listen_to_wheels(PidState, "pid_state", wheels, take):
        while time.monotonic() < settled or min(heard.values()) < settled:
            if time.monotonic() > settled + TIMEOUT_S:
                silent = [f"{w}/pid_state" for w in wheels if heard[w] < settled]
                raise RobotError(
                    f"no message on {', '.join(silent)} at standstill; is wheel_pid active?"
                )
            send_zero()
            client.spin(COMMAND_PERIOD_S)


def _refuse_other_senders(client: RobotClient) -> None:
    """Raise when another node sends set-points."""
    heard: list[JointState] = []
    with client.listen(JointState, {"wheel_setpoints": heard.append}):
        client.until(lambda: bool(heard), QUIET_TIME_S)
    if heard:
        topic = client.node.resolve_topic_name("wheel_setpoints")
        senders = client.node.get_publishers_info_by_topic(topic)
        who = ", ".join(sorted({one.node_name for one in senders})) or "another node"
        raise RobotError(f"wheel_setpoints: {who} drives the wheels; stop it first")
