# SPDX-License-Identifier: Apache-2.0
"""Converts velocity commands of the body to set-points of its wheels and publishes odometry.

It publishes /tf if tf2_msgs is installed.
"""

import math
import time
from collections import deque
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry as OdometryMessage
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import Imu, JointState

from smp_interfaces.msg import MotorState
from smp_motor_control import get_joint_name
from smp_motor_control.body.command import BodyCommand, Verdict
from smp_motor_control.body.odometry import MIN_STEP_S, Odometry
from smp_motor_control.body.wheel_travel import WheelFeedback, WheelSample
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.publishers import PublisherWatch, describe_two_publishers, with_watch
from smp_motor_control.nodes.settings import Parameters
from smp_motor_control.nodes.skid_steer_settings import Settings
from smp_motor_control.wheel.stop import StopRule

IMPLAUSIBLE_RATIO = 4.0  # wheel speed relative to its maximum that shows a counter reset
DEFAULT_MAX_SPEED = 250.0  # plausible speed without a limit [rad/s]
REPORT_TIME_S = 1.5  # time for which a refused command is reported, at least once
LOOK_PERIOD_S = 0.2  # period of checking the publishers of cmd_vel
OWN_SETPOINTS = 32  # number of own set-points that are recognised when received
YIELD_S = 0.3  # time for which an idle body is silent after another node's set-points
STALLED_PERIODS = 3.0
"""Delay in periods after which a step is skipped once, to process queued messages first."""

UNOBSERVED_VARIANCE = 1e6  # of height, roll and pitch
SIDEWAYS_VARIANCE = 1e-3  # of the sideways velocity of a skidding body [m^2/s^2]
MIN_VARIANCE = 1e-6  # of a velocity, for filters that divide by it

_TWISTS = {"geometry_msgs/msg/TwistStamped": TwistStamped, "geometry_msgs/msg/Twist": Twist}


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


class SkidSteerNode(Node):
    """Node of the body, on a steady timer."""

    def __init__(self) -> None:
        super().__init__("skid_steer")
        self._ros_parameters = Parameters(self, Settings, self._configure)
        settings = self._ros_parameters.settings
        robot = settings.robot
        self._command = BodyCommand()
        self._stop = StopRule()
        self._left, self._right = settings.left_wheel_names, settings.right_wheel_names
        self._unstamped: dict[str, bool] = {}
        size = settings.velocity_rolling_window_size
        window = size / settings.publish_rate
        self._feedback = WheelFeedback(self._left, self._right, window=window)
        body = robot.effective_separation, robot.left_radius, robot.right_radius
        self._odometry = Odometry(*body, size)
        self._configure(settings)
        self._past_commands = [(0.0, 0.0), (0.0, 0.0)]  # (linear, angular) of the last two steps
        self._sent: deque[int] = deque(maxlen=OWN_SETPOINTS)  # stamps of the last set-points
        self._others_at = -math.inf  # time of another node's last set-points
        self._speed_scale = 1.0
        self._late = False
        self._refused, self._refused_at = "", -math.inf
        self._yaw, self._yaw_time, self._imu_stamp = math.nan, -math.inf, -math.inf
        self._last_tick, self._last_stamp = time.monotonic(), self._now()
        self._connect(settings)

    def _connect(self, settings: Settings) -> None:
        wheels = (*self._left, *self._right)
        self._setpoint = JointState(name=[get_joint_name(wheel) for wheel in wheels])
        self._setpoints = self.create_publisher(
            JointState, "wheel_setpoints", runtime.STREAM_PUBLISHER
        )
        self._output = OdometryOutput(self, settings)
        best_effort = runtime.STREAM_SUBSCRIBER
        self.create_subscription(JointState, "wheel_setpoints", self._on_setpoints, best_effort)
        self._preferred = TwistStamped if settings.use_stamped_vel else Twist
        self._ignored_type = ""
        self._listen_to(self._preferred)
        self._type_timer = runtime.steady_timer(self, LOOK_PERIOD_S, self._follow_type)
        self._states = {wheel: PublisherWatch() for wheel in wheels}
        for wheel in wheels:
            self.create_subscription(
                MotorState, f"{wheel}/motor_state", partial(self._on_state, wheel), best_effort
            )
        self.create_subscription(Imu, "imu", self._on_imu, best_effort)
        self._timer = runtime.steady_timer(self, 1.0 / settings.publish_rate, self._on_timer)
        self._diagnostics = runtime.Diagnostics(self, self._assess)

    def _listen_to(self, kind: type) -> None:
        take = self._on_stamped if kind is TwistStamped else self._on_twist
        self._kind = kind
        self._commands = PublisherWatch()
        self._cmd_vel = self.create_subscription(
            kind, "cmd_vel", with_watch(self._commands, take), runtime.STREAM_SUBSCRIBER
        )

    def _follow_type(self) -> None:
        """Subscribe to the published type of cmd_vel; a process can have one type per topic."""
        if self._cmd_vel is None:
            self._listen_to(self._kind)
            return
        infos = self.get_publishers_info_by_topic(self._cmd_vel.topic_name)
        there = {_TWISTS[info.topic_type] for info in infos if info.topic_type in _TWISTS}
        others = there - {self._kind}
        if others and (self._kind not in there or self._preferred in others):
            # The middleware releases the old type in this round; subscribe in the next.
            self.destroy_subscription(self._cmd_vel)
            self._cmd_vel, self._kind = None, others.pop()
            self.get_logger().info(f"cmd_vel is read as {self._kind.__name__}")
            others = there - {self._kind}
        self._ignored_type = others.pop().__name__ if others else ""

    def _configure(self, settings: Settings) -> None:
        robot = settings.robot
        self._robot = robot
        self._linear, self._angular = settings.linear, settings.angular
        self._command.configure(settings.cmd_vel_timeout)
        self._feedback.max_speed = IMPLAUSIBLE_RATIO * min(robot.max_wheel_speed, DEFAULT_MAX_SPEED)
        self._hold = settings.hold
        body = robot.effective_separation, robot.left_radius, robot.right_radius
        self._odometry.configure(*body, settings.travel_noise, settings.turn_noise)

    def _now(self) -> float:
        return self.get_clock().now().nanoseconds * 1e-9

    def _on_stamped(self, message: TwistStamped) -> None:
        stamp = runtime.seconds(message.header.stamp)
        self._on_command(message.twist, None if stamp == 0.0 else self._now() - stamp)

    def _on_twist(self, message: Twist) -> None:
        self._on_command(message, 0.0)

    def _on_command(self, twist: Twist, age: float | None) -> None:
        verdict = self._command.receive(twist.linear.x, twist.angular.z, age, time.monotonic())
        if verdict is Verdict.ZERO_STAMP:
            self.get_logger().warning(f"cmd_vel {verdict.value}", once=True)
        elif verdict is not Verdict.ACCEPTED:
            self._refused, self._refused_at = verdict.value, time.monotonic()
            old = f" ({age:.3f} s)" if verdict is Verdict.STALE else ""
            self.get_logger().warning(f"cmd_vel {verdict.value}{old}", throttle_duration_sec=1.0)

    def _on_setpoints(self, message: JointState) -> None:
        """Note set-points of other nodes, which an idle body leaves alone."""
        if runtime.nanoseconds(message.header.stamp) not in self._sent:
            self._others_at = time.monotonic()

    def _should_yield(self, now: float) -> bool:
        """Return whether the body is idle while another node sends set-points."""
        idle = self._command.timed_out(now) and not any(self._past_commands[0])
        return idle and now - self._others_at < YIELD_S

    def _on_state(self, wheel: str, message: MotorState, info: Mapping[str, Any]) -> None:
        watch = self._states[wheel]
        restarted = watch.hear(info)
        if watch.has_two_publishers:
            return  # the two cannot be distinguished
        stamp = runtime.seconds(message.header.stamp)
        self._unstamped[wheel] = not stamp
        sample = WheelSample(stamp or self._now(), message.position, message.velocity)
        self._feedback.receive(wheel, sample, time.monotonic(), restarted)

    def _on_imu(self, message: Imu) -> None:
        """Take the yaw from the orientation or, without one, integrate the yaw rate."""
        now, stamp = time.monotonic(), runtime.seconds(message.header.stamp)
        if message.orientation_covariance[0] != -1.0:
            q = message.orientation
            norm = q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z
            yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), norm - 2.0 * (q.y * q.y + q.z * q.z))
            self._yaw = yaw if 0.25 < norm < 4.0 else math.nan
        else:
            dt = stamp - self._imu_stamp
            rate = message.angular_velocity.z
            fresh = 0.0 < dt < self._ros_parameters.settings.imu_timeout and math.isfinite(rate)
            before = self._yaw if math.isfinite(self._yaw) else 0.0
            self._yaw = before + rate * dt if fresh else before
        self._imu_stamp, self._yaw_time = stamp, now

    def _on_timer(self) -> None:
        now, stamp = time.monotonic(), self._now()
        settings = self._ros_parameters.settings
        late = now - self._last_tick > STALLED_PERIODS / settings.publish_rate
        self._late, self._last_tick = late and not self._late, now
        if self._late:
            return
        # Simulated time may run at any pace.
        dt = min(max(stamp - self._last_stamp, 0.0), 5.0 / settings.publish_rate)
        jumped, self._last_stamp = stamp < self._last_stamp, stamp
        if dt < MIN_STEP_S and not jumped:
            return
        asked = self._command.at(now)
        if asked is not None and not self._should_yield(now):
            self._drive(asked, max(dt, MIN_STEP_S), now)
        if settings.open_loop:
            updated = asked is not None and self._odometry.update_open_loop(
                *self._past_commands[0], dt
            )
        else:
            travel = self._feedback.take(now, settings.feedback_timeout)
            updated = travel is not None and self._odometry.update_from_travel(*travel)
        if updated:
            self._output.publish(self._odometry, stamp)
        self._output.publish_joints(self._feedback.latest, stamp)

    def _drive(self, asked: tuple[float, float], dt: float, now: float) -> None:
        """Limit the command, correct the heading and publish the set-points."""
        linear, angular = self._limit(asked, dt, now)
        share = self._robot.compute_speed_scale(linear, angular)
        linear, angular = linear * share, angular * share
        self._past_commands = [(linear, angular), self._past_commands[0]]
        corrected = self._hold_heading(linear, angular, dt, now)
        left, right = self._robot.limit_wheel_speeds(linear, corrected)
        self._speed_scale = share
        self._setpoint.header.stamp = self.get_clock().now().to_msg()
        self._sent.append(runtime.nanoseconds(self._setpoint.header.stamp))
        self._setpoint.velocity = [left] * len(self._left) + [right] * len(self._right)
        self._setpoints.publish(self._setpoint)

    def _limit(self, asked: tuple[float, float], dt: float, now: float) -> tuple[float, float]:
        """Return the command limited by acceleration, jerk and the stop rule."""
        self._stop.note_setpoint(max(map(abs, asked)), now)
        if self._stop.is_overdue(now, self._ros_parameters.settings.stop_time):
            return 0.0, 0.0
        (v0, w0), (v1, w1) = self._past_commands
        linear = self._linear.limit(asked[0], v0, v1, dt).value
        return linear, self._angular.limit(asked[1], w0, w1, dt).value

    def _hold_heading(self, linear: float, angular: float, dt: float, now: float) -> float:
        settings = self._ros_parameters.settings
        known = now - self._yaw_time <= settings.imu_timeout
        if not settings.heading_hold or not known or (linear == 0.0 and angular == 0.0):
            self._hold.reset()
            return angular
        return self._hold.step(angular, self._yaw, dt)

    def _assess(self) -> tuple[bytes, str, dict[str, object]]:
        settings, now = self._ros_parameters.settings, time.monotonic()
        (linear, angular), asked = self._past_commands[0], self._command.at(now)
        values: dict[str, object] = {
            "linear velocity": linear,
            "angular velocity": angular,
            "command age": self._command.age(now),
            "scaled to": self._speed_scale,
            "heading hold": settings.heading_hold,
        }
        problems = self._problems(settings, now)
        if problems:
            return max(level for level, _ in problems), "; ".join(t for _, t in problems), values
        if asked is None:
            return runtime.OK, "waiting for the first cmd_vel", values
        if self._command.timed_out(now):
            return runtime.OK, "idle: no cmd_vel", values
        if self._speed_scale < 1.0:
            share = 100.0 * self._speed_scale
            return runtime.OK, f"driving at {share:.0f} % of cmd_vel: wheel speed limit", values
        return runtime.OK, "driving", values

    def _problems(self, settings: Settings, now: float) -> list[tuple[bytes, str]]:
        """Return the present problems with their levels."""
        problems = []
        commanded = self._command.at(now) is not None
        silent = self._feedback.silent(now, settings.feedback_timeout)
        if silent and not settings.open_loop and (commanded or self._feedback.latest):
            wheels = ", ".join(
                f"{wheel} ({'never' if math.isinf(age) else f'{age:.1f} s'})"
                for wheel, age in silent.items()
            )
            problems.append((runtime.ERROR, f"no feedback from {wheels}; check the wheels' driver"))
        for wheel, watch in self._states.items():
            if watch.has_two_publishers:
                problems.append(
                    (runtime.ERROR, describe_two_publishers(self, f"{wheel}/motor_state"))
                )
        if self._commands.has_two_publishers:
            problems.append((runtime.WARN, describe_two_publishers(self, "cmd_vel")))
        faults = [f"{wheel}: {what}" for wheel, what in self._feedback.problems.items()]
        faults += [
            f"{wheel}: motor_state has no stamp; its driver must set it"
            for wheel, no in self._unstamped.items()
            if no
        ]
        if faults and not settings.open_loop:
            problems.append((runtime.WARN, "; ".join(faults)))
        if now - self._refused_at < REPORT_TIME_S:
            problems.append((runtime.WARN, f"cmd_vel {self._refused}"))
        if self._ignored_type:
            text = (
                f"cmd_vel is also published as {self._ignored_type}, which is ignored; stop one of "
                "the publishers"
            )
            problems.append((runtime.WARN, text))
        if commanded and self._command.timed_out(now) and any(self._past_commands[0]):
            problems.append((runtime.WARN, "cmd_vel timed out: braking"))
        if commanded and not settings.cmd_vel_timeout:
            text = "cmd_vel_timeout is 0: the body keeps driving when cmd_vel ends"
            problems.append((runtime.WARN, text))
        if settings.heading_hold and now - self._yaw_time > settings.imu_timeout:
            problems.append((runtime.WARN, "heading is not held: no imu"))
        return problems

    def on_stop(self) -> None:
        """Command zero if this node has commanded the wheels."""
        if self._setpoint.velocity:
            self._setpoint.header.stamp = self.get_clock().now().to_msg()
            self._setpoint.velocity = [0.0] * len(self._setpoint.name)
            runtime.send_last(self._setpoints, self._setpoint)


main = partial(runtime.run, "skid_steer", SkidSteerNode)
