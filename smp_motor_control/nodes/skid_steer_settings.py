"""Parameters of skid_steer, named as those of diff_drive_controller where they mean the same."""

from collections.abc import Sequence
from dataclasses import dataclass

from smp_motor_control import LEFT, RIGHT, check_wheel_names
from smp_motor_control.body.heading import HeadingHold
from smp_motor_control.body.kinematics import SkidSteer
from smp_motor_control.body.speed_limiter import SpeedLimiter
from smp_motor_control.errors import ParameterError
from smp_motor_control.fields import described, fixed, nested
from smp_motor_control.wheel.stop import LONGEST_STOP


def check_wheels(left: Sequence[str], right: Sequence[str]) -> None:
    """Refuse wheels that cannot be a body's."""
    for side, names in (("left", left), ("right", right)):
        if not any(names):
            raise ParameterError(f"{side}_wheel_names is empty; a side has at least one wheel")
    check_wheel_names((*left, *right))


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Parameters of the node, validated together."""

    left_wheel_names: tuple[str, ...] = fixed(LEFT, "Wheels of the left side: their namespaces.")
    right_wheel_names: tuple[str, ...] = fixed(RIGHT, "Wheels of the right side: their namespaces.")
    robot: SkidSteer = nested(
        SkidSteer(wheel_separation=0.4, wheel_radius=0.1, max_wheel_speed=2.9)
    )
    publish_rate: float = fixed(
        50.0, "Set-points and odometry per second [Hz].", minimum=1.0, maximum=1000.0
    )
    cmd_vel_timeout: float = described(
        0.5, "Age of a command at which the body brakes [s]; 0: never.", minimum=0.0
    )
    stop_time: float = described(
        1.0, "Time after a command of zero, or after the last one's time-out, at which the wheels "
        "are asked to stand whatever the limits [s].", minimum=0.05, maximum=LONGEST_STOP,
    )  # fmt: skip
    use_stamped_vel: bool = fixed(
        True, "Which of two publishers is followed: TwistStamped (true) or Twist (false)."
    )
    feedback_timeout: float = described(
        0.5, "Silence of a wheel that is reported [s].", minimum=0.01
    )
    open_loop: bool = described(False, "Odometry from commands instead of wheels.")
    velocity_rolling_window_size: int = fixed(
        10, "Steps that the reported velocity is averaged over.", minimum=1
    )
    odom_frame_id: str = fixed("odom", "Frame of the odometry.")
    base_frame_id: str = fixed("base_link", "Frame of the body.")
    tf_frame_prefix_enable: bool = fixed(
        True, "Prefix the frames with tf_frame_prefix, or else the namespace."
    )
    tf_frame_prefix: str = fixed("", "Prefix of the frames.")
    enable_odom_tf: bool = fixed(True, "Publish odom to base on /tf.")
    travel_noise: float = described(
        1e-4, "Variance that one metre of a side's travel adds [m^2/m].", minimum=0.0
    )
    turn_noise: float = described(
        1e-2, "Variance of the heading that one radian of turning adds [rad^2/rad].", minimum=0.0
    )
    heading_hold: bool = described(False, "Correct the heading by the yaw of the topic imu.")
    hold: HeadingHold = nested(HeadingHold())
    imu_timeout: float = described(0.2, "Age at which a yaw is not used [s].", minimum=0.01)
    linear: SpeedLimiter = nested(SpeedLimiter(), prefix="linear.x.")
    angular: SpeedLimiter = nested(SpeedLimiter(), prefix="angular.z.")

    def __post_init__(self) -> None:
        check_wheels(self.left_wheel_names, self.right_wheel_names)
