# SPDX-License-Identifier: Apache-2.0
"""Environment for ROS nodes on the loopback interface only."""

import os

from smp_motor_control.motor.file import find_config

FAST_DDS = "rmw_fastrtps"  # jazzy's default middleware, for which the profile is written


def loopback_environment() -> dict[str, str]:
    """Return variables that restrict discovery and sockets to this computer.

    ROS's range LOCALHOST restricts discovery only; Fast DDS needs the profile to bind to loopback.
    """
    if not os.environ.get("RMW_IMPLEMENTATION", FAST_DDS).startswith(FAST_DDS):
        return {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(find_config("loopback.xml")),
    }
