"""ROS nodes that no other computer reaches."""

import os

from smp_motor_control.motor.file import shared

FAST_DDS = "rmw_fastrtps"
"""The middleware that the profile is for: that of Jazzy, where none is chosen."""


def environment() -> dict[str, str]:
    """Return the environment in which nodes discover, and bind, on this computer alone.

    The range LOCALHOST of ROS limits who is discovered: Fast DDS binds to every interface all the
    same, which its profile ends.
    """
    if not os.environ.get("RMW_IMPLEMENTATION", FAST_DDS).startswith(FAST_DDS):
        return {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(shared("loopback.xml")),
    }
