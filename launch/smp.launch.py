# SPDX-License-Identifier: Apache-2.0
"""Starts a robot: simulated motors or real ones, a controller for each wheel, skid_steer.

    ros2 launch smp_motor_control smp.launch.py                                   # simulated
    ros2 launch smp_motor_control smp.launch.py hardware:=external params_file:=gains.yaml
    ros2 launch smp_motor_control smp.launch.py namespace:=robot1 left_wheels:=left \\
        right_wheels:=right motors:=motors.yaml params_file:=gains.yaml

With ``hardware:=external`` something else must publish ``<wheel>/motor_state`` and
``<wheel>/motor_description`` and take ``<wheel>/motor_command`` in the robot's namespace.
The wheels are those of ``left_wheels`` and ``right_wheels``, or else of ``left_wheel_names`` and
``right_wheel_names`` in the file of skid_steer (``body``), or else the paper's four.
"""

from pathlib import Path

from ament_index_python import get_search_paths
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription
from smp_motor_control import LEFT, RIGHT, check_wheel_names
from smp_motor_control.body.description import robot_description
from smp_motor_control.parameter_file import read_node_parameters, require_nodes

PACKAGE = "smp_motor_control"
STATE_PUBLISHER = "share/robot_state_publisher"
SIZES = {"wheel_separation": "separation", "wheel_radius": "radius"}
CONFIG = [FindPackageShare(PACKAGE), "/config/"]

ARGUMENTS = {
    "namespace": ("", "Namespace of the robot, such as robot1"),
    "hardware": ("simulated", "simulated: motor_plant; external: your driver runs"),
    "left_wheels": ("", f"Names of the left wheels; else those of body, else {','.join(LEFT)}"),
    "right_wheels": ("", f"Names of the right wheels; else those of body, else {','.join(RIGHT)}"),
    "params_file": ([*CONFIG, "gains.yaml"], "Parameters of the wheels, as written by tune"),
    "body": ([*CONFIG, "skid_steer.yaml"], "Parameters of skid_steer"),
    "motors": ([*CONFIG, "motors_paper.yaml"], "Motors of the simulation"),
    "rate": ("200.0", "Samples per second of the simulation"),
    "skid_steer": ("true", "Start skid_steer"),
    "description": ("true", "Start robot_state_publisher, if it is installed"),
    "use_stamped_vel": ("true", "Prefer TwistStamped to Twist if both are published"),
    "autostart": ("true", "Activate the wheels' controllers at start"),
    "use_sim_time": ("false", "Take the time from /clock"),
    "log_level": ("info", "debug, info, warn, error"),
}


def start(context, *_) -> list:
    """Return the nodes; invalid arguments stop the launch."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    if given["hardware"] not in ("simulated", "external"):
        raise RuntimeError(f"hardware is {given['hardware']!r}; it must be simulated or external")
    geometry = read_node_parameters(given["body"], "skid_steer")
    sides = [
        [name.strip() for name in given[f"{side}_wheels"].split(",") if name.strip()]
        or list(geometry.get(f"{side}_wheel_names", usual))
        for side, usual in (("left", LEFT), ("right", RIGHT))
    ]
    robot = "/" + given["namespace"].strip("/") if given["namespace"].strip("/") else ""
    wheels = [wheel for side in sides for wheel in side]
    check_wheel_names(wheels)
    require_nodes(given["params_file"], [f"{robot}/{wheel}/wheel_pid" for wheel in wheels])
    common = {"use_sim_time": is_true(given, "use_sim_time")}

    def node(name: str, parameters: list, place: str = "", **more: object) -> Node:
        return Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=f"{robot}{place}",
            parameters=[*parameters, common],
            arguments=["--ros-args", "--log-level", given["log_level"]],
            output="screen",
            **more,
        )

    autostart = {"autostart": is_true(given, "autostart")}
    again = {"respawn": True, "respawn_delay": 0.5}
    gains = [given["params_file"], autostart]
    nodes = [node("wheel_pid", gains, f"/{wheel}", **again) for wheel in wheels]
    if given["hardware"] == "simulated":
        plant = {"motors_file": given["motors"], "rate": number(given, "rate")}
        nodes.append(node("motor_plant", [plant]))
    if is_true(given, "skid_steer"):
        body = {
            "left_wheel_names": sides[0],
            "right_wheel_names": sides[1],
            "use_stamped_vel": is_true(given, "use_stamped_vel"),
        }
        nodes.append(node("skid_steer", [given["body"], body]))
        if is_true(given, "description"):
            nodes += describe(sides, geometry, robot, common)
    paper_gains = Path(FindPackageShare(PACKAGE).perform(context), "config", "gains.yaml")
    if given["hardware"] == "external" and Path(given["params_file"]) == paper_gains:
        nodes.append(LogInfo(msg=f"{given['params_file']}: gains for the motors of the paper; "
                                 "params_file:= gives yours"))  # fmt: skip
    return nodes


def describe(sides: list, geometry: dict, robot: str, common: dict) -> list:
    """Return the actions that publish the frames of the wheels."""
    if not any(Path(p, STATE_PUBLISHER).is_dir() for p in get_search_paths()):
        return [LogInfo(msg="robot_state_publisher is not installed: no frames of the wheels")]
    sizes = {to: geometry[name] for name, to in SIZES.items() if name in geometry}
    text = ParameterValue(robot_description(*sides, **sizes), value_type=str)
    prefix = f"{robot.strip('/')}/" if robot else ""
    return [
        Node(
            package="robot_state_publisher",
            executable="robot_state_publisher",
            namespace=robot,
            parameters=[{"robot_description": text, "frame_prefix": prefix}, common],
        )
    ]


def number(given: dict, name: str) -> float:
    """Return a numeric argument."""
    try:
        return float(given[name])
    except ValueError:
        raise RuntimeError(f"{name} is {given[name]!r}; it must be a number") from None


def is_true(given: dict, name: str) -> bool:
    """Return a boolean argument."""
    value = given[name].lower()
    if value not in ("true", "false"):
        raise RuntimeError(f"{name} is {given[name]!r}; it must be true or false")
    return value == "true"


def generate_launch_description() -> LaunchDescription:
    """Return arguments and nodes."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])
