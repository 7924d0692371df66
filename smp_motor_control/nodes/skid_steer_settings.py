# SPDX-License-Identifier: Apache-2.0
"""Parameters of skid_steer, named as in diff_drive_controller where equivalent."""

from dataclasses import dataclass

from smp_motor_control import LEFT, RIGHT, check_wheel_names
from smp_motor_control.body.command import HeadingHold
from smp_motor_control.body.kinematics import SkidSteer
from smp_motor_control.body.speed_limiter import SpeedLimiter
from smp_motor_control.errors import ParameterError
from smp_motor_control.fields import described, fixed, nested
from smp_motor_control.wheel.stop import MAX_STOP_TIME_S


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Parameters of the node, validated together."""

    left_wheel_names: tuple[str, ...] = fixed(LEFT, "Namespaces of the left wheels.")
    right_wheel_names: tuple[str, ...] = fixed(RIGHT, "Namespaces of the right wheels.")
    robot: SkidSteer = nested(
        SkidSteer(wheel_separation=0.4, wheel_radius=0.1, max_wheel_speed=2.9)
    )
    publish_rate: float = fixed(
        50.0, "Rate of set-points and odometry [Hz].", minimum=1.0, maximum=1000.0
    )
    cmd_vel_timeout: float = described(
        0.5, "Age of a command at which the body brakes [s]; 0: never.", minimum=0.0
    )
    stop_time: float = described(
        1.0, "Time after a zero command, or after the command's time-out, at which the wheels' "
        "set-points are zero regardless of the limits [s].", minimum=0.05, maximum=MAX_STOP_TIME_S,
    )  # fmt: skip
    use_stamped_vel: bool = fixed(
        True, "Preferred type of cmd_vel: TwistStamped (true) or Twist (false)."
    )
    feedback_timeout: float = described(
        0.5, "Time without feedback after which a wheel is reported [s].", minimum=0.01
    )
    open_loop: bool = described(False, "Odometry from commands instead of wheels.")
    velocity_rolling_window_size: int = fixed(
        10, "Number of steps over which the reported velocity is averaged.", minimum=1
    )
    odom_frame_id: str = fixed("odom", "Frame of the odometry.")
    base_frame_id: str = fixed("base_link", "Frame of the body.")
    tf_frame_prefix_enable: bool = fixed(
        True, "Prefix the frames with tf_frame_prefix, or else the namespace."
    )
    tf_frame_prefix: str = fixed("", "Prefix of the frames.")
    enable_odom_tf: bool = fixed(True, "Publish odom to base on /tf.")
    travel_noise: float = described(
        1e-4, "Variance of a side's travel per metre [m^2/m].", minimum=0.0
    )
    turn_noise: float = described(
        1e-2, "Variance of the heading per radian of turning [rad^2/rad].", minimum=0.0
    )
    heading_hold: bool = described(False, "Correct the heading by the yaw of the topic imu.")
    hold: HeadingHold = nested(HeadingHold())
    imu_timeout: float = described(0.2, "Age from which a yaw is ignored [s].", minimum=0.01)
    linear: SpeedLimiter = nested(SpeedLimiter(), prefix="linear.x.")
    angular: SpeedLimiter = nested(SpeedLimiter(), prefix="angular.z.")

    def __post_init__(self) -> None:
        for name in ("left_wheel_names", "right_wheel_names"):
            if not any(getattr(self, name)):
                raise ParameterError(f"{name} is empty; name at least one wheel")
        check_wheel_names((*self.left_wheel_names, *self.right_wheel_names))
