"""Wheels driven through changes of their set-points, past skid_steer, with zero at the end."""

from __future__ import annotations

import time
from collections.abc import Sequence

from sensor_msgs.msg import JointState

from smp_interfaces.msg import PidState
from smp_motor_control import joint_of
from smp_motor_control.nodes.conventions import STREAM_PUBLISHER
from smp_motor_control.nodes.robot_client import LOOK, PATIENCE, RobotClient, RobotError

QUIET = 0.5
"""Time in which nobody else may send set-points [s]."""


def drive_steps(
    client: RobotClient, steps: Sequence[tuple[str, float, float]], wheels: Sequence[str]
) -> list[tuple[str, float, float]]:
    """Drive all wheels through steps of (name, rad/s, s), and stop them whatever happens.

    Returns
    -------
    list of (str, float, float)
        Name, begin and end of each by the stamps [s].
    """
    _refuse_rivals(client)
    publisher = client.node.create_publisher(JointState, "wheel_setpoints", STREAM_PUBLISHER)
    message = JointState(name=[joint_of(wheel) for wheel in wheels])

    def send(speed: float) -> None:
        message.header.stamp = client.node.get_clock().now().to_msg()
        message.velocity = [float(speed)] * len(wheels)
        publisher.publish(message)

    heard = dict.fromkeys(wheels, False)
    topics = {f"{w}/pid_state": lambda m, w=w: heard.update({w: m.setpoint == 0.0}) for w in wheels}
    times = []
    try:
        with client.listen(PidState, topics):
            end = time.monotonic() + PATIENCE
            while not all(heard.values()):
                if time.monotonic() > end:
                    silent = ", ".join(f"{w}/pid_state" for w, h in heard.items() if not h)
                    raise RobotError(f"standstill is commanded, but {silent} is silent")
                send(0.0)
                client.spin(LOOK)
        for name, speed, duration in steps:
            begin, last = _now(client), time.monotonic() + duration
            while (left := last - time.monotonic()) > 0:
                send(speed)
                client.spin(min(LOOK, left))
            times.append((name, begin, _now(client)))
    finally:
        for _ in range(3):
            send(0.0)
            client.spin(LOOK)
        client.node.destroy_publisher(publisher)
    return times


def _now(client: RobotClient) -> float:
    return float(client.node.get_clock().now().nanoseconds * 1e-9)


def _refuse_rivals(client: RobotClient) -> None:
    """Raise where somebody else drives."""
    heard: list[JointState] = []
    with client.listen(JointState, {"wheel_setpoints": heard.append}):
        client.until(lambda: bool(heard), QUIET)
    if heard:
        topic = client.node.resolve_topic_name("wheel_setpoints")
        named = client.node.get_publishers_info_by_topic(topic)
        who = ", ".join(sorted({one.node_name for one in named})) or "somebody"
        raise RobotError(f"wheel_setpoints: {who} drives the wheels; let it rest first")
