# SPDX-License-Identifier: Apache-2.0
"""Shared code of `record` and `play`: message classes by name, QoS."""

import importlib
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy


def message_class(type_name: str) -> Any | None:
    """Return the class of ``package/msg/Name``; None if it is not installed."""
    package, _, rest = type_name.partition("/")
    name = rest.rpartition("/")[2]
    try:
        found = getattr(importlib.import_module(f"{package}.msg"), name)
        found.__class__.__import_type_support__()
    except Exception:  # a package that was built for another ROS may fail in any way
        return None
    return found


def quality(depth: int, reliable: bool, latched: bool) -> QoSProfile:
    """Return the QoS for taking raw messages, or sending them again."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
