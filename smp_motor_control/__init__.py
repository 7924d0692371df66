# SPDX-License-Identifier: Apache-2.0
"""Control of DC-motor wheels: motor, encoder, PID, profiles and kinematics as pure mathematics.

Only :mod:`smp_motor_control.nodes` uses ROS.
"""

import re
from collections.abc import Sequence

from smp_motor_control.errors import ParameterError

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
"""The paper's wheels, motors 1 to 4: the default names."""

LEFT, RIGHT = WHEELS[::2], WHEELS[1::2]


def get_joint_name(wheel: str) -> str:
    """Return the name of a wheel's joint in set-points and joint states."""
    return f"{wheel}_wheel_joint"


def get_controller_name(wheel: str) -> str:
    """Return the name of a wheel's controller node, relative to the robot's namespace."""
    return f"{wheel}/wheel_pid"


MAX_NAME_LENGTH = 100
"""Maximum length of a wheel's name; a topic may have 247 (rmw/validate_full_topic_name.h)."""


def check_wheel_names(names: Sequence[str]) -> None:
    """Raise for names that are not valid in a topic and for duplicates."""
    for name in names:
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) or len(name) > MAX_NAME_LENGTH:
            raise ParameterError(
                f"wheel name {name!r}; it must be letters, digits and _ after a letter, at most "
                f"{MAX_NAME_LENGTH}, as in a topic"
            )
    if twice := sorted({name for name in names if list(names).count(name) > 1}):
        raise ParameterError(f"a wheel is named twice: {', '.join(twice)}; rename one")
