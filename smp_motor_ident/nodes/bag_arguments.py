# SPDX-License-Identifier: Apache-2.0
"""Shared code of `record` and `play`: choice of topics, message classes by name, QoS."""

import argparse
import importlib
import re
from dataclasses import dataclass
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from smp_motor_control.errors import SmpError


def message_class(type_name: str) -> Any | None:
    """Return the class of ``package/msg/Name``; None where it is not installed."""
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


@dataclass(frozen=True)
class Choice:
    """Which topics are wanted."""

    names: frozenset[str] = frozenset()
    pattern: re.Pattern[str] | None = None
    exclude: re.Pattern[str] | None = None
    hidden: bool = False

    def wants(self, topic: str) -> bool:
        if not self.hidden and any(part.startswith("_") for part in topic.split("/")):
            return topic in self.names
        if self.exclude and self.exclude.fullmatch(topic):
            return False
        if not self.names and not self.pattern:
            return True
        return topic in self.names or bool(self.pattern and self.pattern.fullmatch(topic))


def chosen(arguments: argparse.Namespace, hidden: bool) -> Choice:
    wanted = _pattern("--regex", arguments.regex)
    unwanted = _pattern("--exclude", arguments.exclude)
    return Choice(frozenset(arguments.topics), wanted, unwanted, hidden)


def _pattern(option: str, text: str) -> re.Pattern[str] | None:
    """Return a compiled regular expression; None where none is given."""
    try:
        return re.compile(text) if text else None
    except re.error as error:
        raise SmpError(f"{option} {text!r} is not a regular expression: {error}") from None
