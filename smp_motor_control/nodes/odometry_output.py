# SPDX-License-Identifier: Apache-2.0
"""Publishers of odom, joint_states and, if tf2_msgs is installed, /tf."""

import math
from collections.abc import Mapping

import numpy as np
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry as OdometryMessage
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import JointState

from smp_motor_control import get_joint_name
from smp_motor_control.body.odometry import Odometry
from smp_motor_control.body.wheel_travel import WheelSample
from smp_motor_control.nodes.skid_steer_settings import Settings

UNOBSERVED_VARIANCE = 1e6  # of height, roll and pitch
SIDEWAYS_VARIANCE = 1e-3  # of the sideways velocity of a skidding body [m^2/s^2]
MIN_VARIANCE = 1e-6  # of a velocity, for filters that divide by it


def frame_prefix(enable: bool, prefix: str, namespace: str) -> str:
    """Return the prefix of the frame names."""
    inner = (prefix or namespace).strip("/") if enable else ""
    return f"{inner}/" if inner else ""


class OdometryOutput:
    """Publishers of odometry and joint states."""

    def __init__(self, node: Node, settings: Settings) -> None:
        prefix = frame_prefix(
            settings.tf_frame_prefix_enable, settings.tf_frame_prefix, node.get_namespace()
        )
        self._wheels = (*settings.left_wheel_names, *settings.right_wheel_names)
        self._span = settings.velocity_rolling_window_size / settings.publish_rate
        self._odometry = OdometryMessage()
        self._odometry.header.frame_id = prefix + settings.odom_frame_id
        self._odometry.child_frame_id = prefix + settings.base_frame_id
        self._publisher = node.create_publisher(OdometryMessage, "odom", 10)
        self._joints = node.create_publisher(JointState, "joint_states", 10)
        self._tf = None
        if not settings.enable_odom_tf:
            return
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            node.get_logger().info("tf2_msgs is not installed: /tf is not published")
            return
        self._tf = node.create_publisher(TFMessage, "/tf", 100)
        self._transform = TransformStamped(child_frame_id=self._odometry.child_frame_id)
        self._transforms = TFMessage(transforms=[self._transform])

    def publish(self, odometry: Odometry, stamp: float) -> None:
        message = self._odometry
        message.header.stamp = Time(nanoseconds=round(stamp * 1e9)).to_msg()
        pose, twist = message.pose, message.twist
        pose.pose.position.x, pose.pose.position.y = odometry.x, odometry.y
        half = math.remainder(odometry.heading, 2.0 * math.pi) / 2.0
        pose.pose.orientation.z, pose.pose.orientation.w = math.sin(half), math.cos(half)
        pose.covariance = _expand_covariance(odometry.covariance)
        twist.twist.linear.x, twist.twist.angular.z = odometry.linear, odometry.angular
        linear, angular = odometry.twist_variances(self._span)
        twist.covariance = _expand_covariance(
            np.diag([linear + MIN_VARIANCE, SIDEWAYS_VARIANCE, angular + MIN_VARIANCE])
        )
        self._publisher.publish(message)
        if self._tf is not None:
            self._transform.header = message.header
            self._transform.transform.translation.x = odometry.x
            self._transform.transform.translation.y = odometry.y
            self._transform.transform.rotation = pose.pose.orientation
            self._tf.publish(self._transforms)

    def publish_joints(self, wheels: Mapping[str, WheelSample], stamp: float) -> None:
        """Publish the joint states of the wheels with feedback so far."""
        heard = [w for w in self._wheels if w in wheels and math.isfinite(wheels[w].position)]
        if not heard:
            return
        message = JointState(
            name=[get_joint_name(wheel) for wheel in heard],
            position=[wheels[wheel].position for wheel in heard],
            velocity=[wheels[wheel].velocity for wheel in heard],
        )
        message.header.stamp = Time(nanoseconds=round(stamp * 1e9)).to_msg()
        self._joints.publish(message)


def _expand_covariance(planar: np.ndarray) -> np.ndarray:
    """Return the 6 x 6 covariance of (x, y, z, roll, pitch, yaw), row-major."""
    matrix = np.diag([0.0, 0.0, UNOBSERVED_VARIANCE, UNOBSERVED_VARIANCE, UNOBSERVED_VARIANCE, 0.0])
    matrix[np.ix_((0, 1, 5), (0, 1, 5))] = planar
    return matrix.ravel()
