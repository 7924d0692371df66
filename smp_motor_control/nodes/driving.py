"""Drives of the body, or of the wheels past skid_steer, by segments, with zero at the end."""

import time
from collections.abc import Callable, Sequence
from typing import Any

from geometry_msgs.msg import TwistStamped
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState

from smp_interfaces.msg import PidState
from smp_motor_control import joint_of
from smp_motor_control.nodes.robot_client import PATIENCE, RobotClient, RobotError
from smp_motor_control.nodes.runtime import STREAM_PUBLISHER

REPEAT = 0.02  # interval at which a command is repeated [s]
STANDSTILL = 1.0  # standstill that is commanded before a drive at least [s]
QUIET = 0.5  # time in which nobody else may send set-points [s]

Times = list[tuple[str, float, float]]
"""Name, begin and end of each segment, by the stamps [s]."""


def drive_body(
    client: RobotClient, segments: Sequence[tuple[str, float, float, float]], wheels: Sequence[str]
) -> Times:
    """Drive through segments of (name, m/s, rad/s, s), and stop whatever happens."""
    publisher = client.node.create_publisher(TwistStamped, "cmd_vel", 1)

    def send(linear: float, angular: float) -> None:
        message = TwistStamped()
        message.header.stamp = client.node.get_clock().now().to_msg()
        message.header.frame_id = "base_link"
        message.twist.linear.x, message.twist.angular.z = float(linear), float(angular)
        publisher.publish(message)

    if not client.until(lambda: publisher.get_subscription_count() > 0, PATIENCE):
        raise RobotError(f"nobody listens on {publisher.topic_name}: start skid_steer")
    return _drive(client, publisher, send, segments, wheels)


def drive_wheels(
    client: RobotClient, steps: Sequence[tuple[str, float, float]], wheels: Sequence[str]
) -> Times:
    """Drive all wheels through steps of (name, rad/s, s), and stop them whatever happens."""
    _refuse_rivals(client)
    publisher = client.node.create_publisher(JointState, "wheel_setpoints", STREAM_PUBLISHER)
    message = JointState(name=[joint_of(wheel) for wheel in wheels])

    def send(speed: float) -> None:
        message.header.stamp = client.node.get_clock().now().to_msg()
        message.velocity = [float(speed)] * len(wheels)
        publisher.publish(message)

    return _drive(client, publisher, send, steps, wheels)


def _drive(
    client: RobotClient,
    publisher: Publisher,
    send: Callable[..., None],
    segments: Sequence[tuple[Any, ...]],
    wheels: Sequence[str],
) -> Times:
    """Send the values of segments of (name, values ..., s) from a standstill on."""
    zero = [0.0] * (len(segments[0]) - 2)
    times = []
    try:
        _stand(client, lambda: send(*zero), wheels)
        for name, *values, duration in segments:
            begin, end = _now(client), time.monotonic() + duration
            while (left := end - time.monotonic()) > 0:
                send(*values)
                client.spin(min(REPEAT, left))
            times.append((name, begin, _now(client)))
    finally:
        for _ in range(3):
            send(*zero)
            client.spin(REPEAT)
        client.node.destroy_publisher(publisher)
    return times


def _stand(client: RobotClient, send_zero: Callable[[], None], wheels: Sequence[str]) -> None:
    """Command standstill until the wheels hear it: who just joined is still being found."""
    heard = dict.fromkeys(wheels, 0.0)

    def take(wheel: str, message: PidState) -> None:
        if message.setpoint == 0.0:
            heard[wheel] = time.monotonic()

    followed = time.monotonic() + STANDSTILL
    with client.listen_to_wheels(PidState, "pid_state", wheels, take):
        while time.monotonic() < followed or min(heard.values()) < followed:
            if time.monotonic() > followed + PATIENCE:
                silent = [f"{w}/pid_state" for w in wheels if heard[w] < followed]
                raise RobotError(f"standstill is commanded, but {', '.join(silent)} is silent")
            send_zero()
            client.spin(REPEAT)


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
