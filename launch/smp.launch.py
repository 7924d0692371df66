"""Starts the robot: simulated motors or real ones, four wheel controllers, skid_steer.

    ros2 launch smp_motor_control smp.launch.py                         # simulated
    ros2 launch smp_motor_control smp.launch.py sim:=false gains:=gains.yaml
    ros2 launch smp_motor_control smp.launch.py motors:=out/motors.yaml rate:=500.0

With ``sim:=false`` something else must publish ``/<wheel>/motor_state``,
``/<wheel>/motor_description`` and take ``/<wheel>/motor_command``.
"""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription
from smp_motor_control import WHEELS

PACKAGE = "smp_motor_control"


def generate_launch_description() -> LaunchDescription:
    """Return plant, wheels and skid_steer."""
    share = [FindPackageShare(PACKAGE), "/config/"]
    use_sim_time = {
        "use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    }
    arguments = [
        DeclareLaunchArgument("sim", default_value="true", description="Simulate the motors"),
        DeclareLaunchArgument(
            "motors",
            default_value=[*share, "motors_paper.yaml"],
            description="Motor file for the simulation",
        ),
        DeclareLaunchArgument(
            "gains", default_value=[*share, "gains.yaml"], description="Parameters of wheel_pid"
        ),
        DeclareLaunchArgument(
            "body",
            default_value=[*share, "skid_steer.yaml"],
            description="Parameters of skid_steer",
        ),
        DeclareLaunchArgument("rate", default_value="200.0", description="Samples per second"),
        DeclareLaunchArgument("skid_steer", default_value="true", description="Start skid_steer"),
        DeclareLaunchArgument("use_sim_time", default_value="false"),
    ]
    plant = Node(
        package=PACKAGE,
        executable="motor_plant",
        name="motor_plant",
        parameters=[
            {
                "motors_file": LaunchConfiguration("motors"),
                "rate": ParameterValue(LaunchConfiguration("rate"), value_type=float),
            },
            use_sim_time,
        ],
        condition=IfCondition(LaunchConfiguration("sim")),
        output="screen",
    )
    wheels = [
        Node(
            package=PACKAGE,
            executable="wheel_pid",
            name="wheel_pid",
            namespace=wheel,
            parameters=[LaunchConfiguration("gains"), use_sim_time],
            output="screen",
            respawn=True,
            respawn_delay=0.5,
        )
        for wheel in WHEELS
    ]
    body = Node(
        package=PACKAGE,
        executable="skid_steer",
        name="skid_steer",
        parameters=[LaunchConfiguration("body"), use_sim_time],
        condition=IfCondition(LaunchConfiguration("skid_steer")),
        output="screen",
    )
    return LaunchDescription([*arguments, plant, *wheels, body])
