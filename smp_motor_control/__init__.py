"""Running DC-motor wheels: motor, encoder, PID, profiles and kinematics as pure mathematics.

ROS nodes that wrap them live in :mod:`smp_motor_control.nodes`; nothing else here knows ROS.
"""

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
"""The paper's four wheels in its order, motors 1 to 4: of a robot that names no others."""

LEFT, RIGHT = WHEELS[::2], WHEELS[1::2]


def joint_of(wheel: str) -> str:
    """Return the joint of a wheel, as set-points and joint states name it."""
    return f"{wheel}_wheel_joint"


def controller_of(wheel: str) -> str:
    """Return the node that controls a wheel, below the robot's namespace."""
    return f"{wheel}/wheel_pid"
