# SPDX-License-Identifier: Apache-2.0
"""Print the nodes' topics, services and parameters: ``python scripts/nodes.py > docs/nodes.md``.

Each node is created as by its executable, and inspected.
"""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable
from typing import Any
from unittest.mock import Mock

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from smp_motor_control import WHEELS
from smp_motor_control.fields import Described, parameters_in
from smp_motor_control.nodes import teleop_wheels
from smp_motor_control.nodes.excite import Excite
from smp_motor_control.nodes.motor_plant import MotorPlant
from smp_motor_control.nodes.serial_driver import SerialDriver
from smp_motor_control.nodes.skid_steer import SkidSteerNode
from smp_motor_control.nodes.wheel_pid import WheelPid
from smp_motor_ident.nodes.identifier import Identifier

NODES: tuple[tuple[str, Callable[[], Node]], ...] = (
    ("/front_left", WheelPid),
    ("/", SkidSteerNode),
    ("/", MotorPlant),
    ("/", SerialDriver),
    ("/", Excite),
    ("/", teleop_wheels.TeleopWheels),
    ("/", Identifier),
)

EVERY_NODES = (
    "/parameter_events",
    "/rosout",
    "/clock",
    "/tf",  # only where tf2_msgs is installed; the page says so
)
PARAMETER_SERVICES = ("rcl_interfaces/", "type_description_interfaces/")

HEAD = """# Nodes

Topics, services and parameters of every node, printed from the code by `python scripts/nodes.py`.
Units are SI. Names are relative to the robot's namespace (`-r __ns:=/robot1`), and `wheel_pid` runs
in that of its wheel (`-r __ns:=/robot1/front_left`). All robots share names with a leading slash.
All nodes answer the usual parameter services and write to `/rosout`. `skid_steer` also reads
`cmd_vel` as `geometry_msgs/msg/Twist` if that is published, and publishes `/tf` if `tf2_msgs` is
installed. The arguments of `record` and `play` name their topics (`--help`).

With `use_sim_time`, stamps, ages and the intervals of odometry and control follow `/clock`, as do
the motors of `motor_plant`; a missing `/clock` is reported on `/diagnostics`. Time-outs and the
signals of `excite` run in real time. A stopped clock therefore disables no watchdog, and a clock so
slow that feedback exceeds `feedback_timeout` stops the wheels.
"""


def type_name(kind: Any) -> str:
    """Return the name that ``ros2 topic`` and ``ros2 service`` print."""
    package, folder, *_ = kind.__module__.split(".")
    return f"{package}/{folder}/{kind.__name__}"


def quality(profile: QoSProfile) -> str:
    """Return the QoS that a peer must match."""
    best_effort = profile.reliability == ReliabilityPolicy.BEST_EFFORT
    latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    return ("best effort" if best_effort else "reliable") + (", transient local" if latched else "")


def relative(name: str, node: Node) -> str:
    """Return a full name as within the robot's namespace, for any of its wheels."""
    own = f"{node.get_namespace().rstrip('/')}/{node.get_name()}/"
    if name.startswith(own):
        return "~/" + name.removeprefix(own)
    if name == "/diagnostics":
        return name
    first, slash, rest = name.lstrip("/").partition("/")
    return f"<wheel>/{rest}" if slash and first in WHEELS else name.lstrip("/")


def topics(node: Node) -> list[str]:
    """Return rows of topics and services."""
    rows = [
        (relative(end.topic_name, node), way, type_name(end.msg_type), quality(end.qos_profile))
        for way, ends in (("publishes", node.publishers), ("subscribes", node.subscriptions))
        for end in ends
        if end.topic_name not in EVERY_NODES
    ]
    rows += [
        (relative(node.resolve_service_name(s.srv_name), node), "serves", type_name(s.srv_type), "")
        for s in node.services
        if not type_name(s.srv_type).startswith(PARAMETER_SERVICES)
    ]
    return ["| name | | type | quality of service |", "| --- | --- | --- | --- |"] + [
        f"| `{name}` | {way} | `{kind}` | {how} |" for name, way, kind, how in sorted(set(rows))
    ]


def limits(entry: Described) -> str:
    """Return the range of a parameter."""
    low, high = (f"{end:g}" if math.isfinite(end) else "" for end in (entry.minimum, entry.maximum))
    if low and high:
        return f"{low} to {high}"
    return f"at least {low}" if low else high and f"at most {high}"


def parameters(settings: type) -> list[str]:
    """Return rows of parameters."""
    rows = ["| parameter | default | range | |", "| --- | --- | --- | --- |"]
    for name, entry in parameters_in(settings).items():
        text = entry.text.rstrip(".") + ("; fixed at start" if entry.read_only else "")
        default = list(entry.default) if isinstance(entry.default, tuple) else entry.default
        rows.append(f"| `{name}` | `{default!r}` | {limits(entry)} | {text} |")
    return rows


def section(namespace: str, make: Callable[[], Node]) -> str:
    """Return the part of one node."""
    rclpy.init(args=["--ros-args", "-r", f"__ns:={namespace}", "--log-level", "fatal"])
    try:
        node = make()
        if isinstance(node, WheelPid):
            node.trigger_configure()
        module = sys.modules[type(node).__module__]
        first = str(inspect.getdoc(module)).split("\n")[0]
        lines = [
            f"## {node.get_name()}",
            "",
            first,
            "",
            *topics(node),
            "",
            *parameters(module.Settings),
        ]
        node.destroy_node()
        return "\n".join(lines) + "\n"
    finally:
        rclpy.shutdown()


def page() -> str:
    """Return all nodes as a page of Markdown."""
    teleop_wheels.Terminal = Mock()  # scripts have no terminal
    return "\n".join([HEAD, *(section(*node) for node in NODES)])


if __name__ == "__main__":
    sys.stdout.write(page())
