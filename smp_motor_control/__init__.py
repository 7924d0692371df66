"""Running DC-motor wheels: motor, encoder, PID, profiles and kinematics as pure mathematics.

ROS nodes that wrap them live in :mod:`smp_motor_control.nodes`; nothing else here knows ROS.
"""

import re
from collections.abc import Sequence

from smp_motor_control.errors import ParameterError

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
"""The paper's four wheels in its order, motors 1 to 4: of a robot that names no others."""

LEFT, RIGHT = WHEELS[::2], WHEELS[1::2]


def joint_of(wheel: str) -> str:
    """Return the joint of a wheel, as set-points and joint states name it."""
    return f"{wheel}_wheel_joint"


def controller_of(wheel: str) -> str:
    """Return the node that controls a wheel, below the robot's namespace."""
    return f"{wheel}/wheel_pid"


LONGEST_NAME = 100
"""Characters of a wheel's name: a whole topic may have 247 (rmw/validate_full_topic_name.h)."""


def check_wheel_names(names: Sequence[str]) -> None:
    """Refuse names that cannot be parts of topics, and a wheel that is named twice."""
    for name in names:
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) or len(name) > LONGEST_NAME:
            raise ParameterError(
                f"wheel name {name!r}: must be letters, digits and _ after a letter, at most "
                f"{LONGEST_NAME}, as in a topic"
            )
    if twice := sorted({name for name in names if list(names).count(name) > 1}):
        raise ParameterError(f"a wheel is named twice: {', '.join(twice)}")
