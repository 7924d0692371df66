# SPDX-License-Identifier: Apache-2.0
"""Peer of skid_steer in tests: it sends commands and feedback, and stores its messages."""

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.time import Time
from sensor_msgs.msg import Imu, JointState
from wheel_robot import DomainNode

from smp_interfaces.msg import MotorState

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
JOINTS = [f"{wheel}_wheel_joint" for wheel in WHEELS]
GEOMETRY = [
    part
    for setting in (
        "wheel_separation:=0.4",
        "wheel_radius:=0.1",
        "max_wheel_velocity:=100.0",
        "publish_rate:=100.0",
    )
    for part in ("-p", setting)
]


class Peer(DomainNode):
    """The rest of the robot: sends commands and feedback, stores messages of skid_steer."""

    def __init__(self, domain: int) -> None:
        super().__init__(domain, "peer")
        self.setpoints: list[JointState] = []
        self.odometry: list[Odometry] = []
        self.joints: list[JointState] = []
        self.diagnostics: list = []
        node = self.node
        node.create_subscription(JointState, "wheel_setpoints", self.setpoints.append, 100)
        node.create_subscription(Odometry, "odom", self.odometry.append, 100)
        node.create_subscription(JointState, "joint_states", self.joints.append, 100)
        node.create_subscription(
            DiagnosticArray, "/diagnostics", lambda m: self.diagnostics.extend(m.status), 100
        )
        self.stamped = node.create_publisher(TwistStamped, "cmd_vel", 10)
        self.plain = node.create_publisher(Twist, "cmd_vel_plain", 10)
        self.imu = node.create_publisher(Imu, "imu", 10)
        self.states = {w: node.create_publisher(MotorState, f"{w}/motor_state", 10) for w in WHEELS}
        self.begun: Time | None = None

    def command(self, v: float, w: float = 0.0, age: float = 0.0, zero_stamp: bool = False) -> None:
        message = TwistStamped()
        if not zero_stamp:
            now = self.node.get_clock().now() - rclpy.duration.Duration(seconds=age)
            message.header.stamp = now.to_msg()
        message.twist.linear.x, message.twist.angular.z = v, w
        self.stamped.publish(message)

    def feed(self, wheel: str, position: float, velocity: float = 0.0) -> None:
        self._feed(wheel, position, velocity, self.node.get_clock().now())

    def feed_all(self, left: float, right: float) -> None:
        for wheel in WHEELS:
            self.feed(wheel, left if wheel.endswith("left") else right)

    def roll(self, speed: float) -> None:
        """Send the positions of wheels with this speed [rad/s] at the stamped instant."""
        now = self.node.get_clock().now()
        self.begun = self.begun or now
        for wheel in WHEELS:
            self._feed(wheel, speed * (now - self.begun).nanoseconds * 1e-9, speed, now)

    def _feed(self, wheel: str, position: float, velocity: float, stamp: Time) -> None:
        message = MotorState(position=position, velocity=velocity)
        message.header.stamp = stamp.to_msg()
        self.states[wheel].publish(message)

    def speeds(self) -> dict[str, float]:
        """Return the newest set-point of each wheel; empty before the first."""
        if not self.setpoints:
            return {}
        last = self.setpoints[-1]
        return dict(zip(last.name, last.velocity, strict=True))

    def drives(self, left: float, right: float, tolerance: float = 1e-9) -> bool:
        speeds = self.speeds()
        return bool(speeds) and all(
            abs(speeds[joint] - (left if "left" in joint else right)) <= tolerance
            for joint in JOINTS
        )

    def diagnosis(self, text: str) -> bool:
        return any(s.name == "skid_steer" and text in s.message for s in self.diagnostics)


def repeatedly(peer: Peer, send, condition, eventually, deadline: float = 5.0) -> None:
    """Send until a condition holds: the first messages may precede the connection."""

    def step() -> None:
        send()
        peer.spin_for(0.03)

    eventually(condition, deadline=deadline, step=step)
