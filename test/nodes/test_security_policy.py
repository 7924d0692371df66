# SPDX-License-Identifier: Apache-2.0
"""security/policy.xml allows each node the topics it uses, and few nodes the motor commands."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import rclpy
from rclpy.node import Node
from std_msgs.msg import String

from smp_motor_control import WHEELS
from smp_motor_control.nodes import live_link, teleop_wheels
from smp_motor_control.nodes.excite import Excite
from smp_motor_control.nodes.motor_plant import MotorPlant
from smp_motor_control.nodes.serial_driver import SerialDriver
from smp_motor_control.nodes.skid_steer import SkidSteerNode
from smp_motor_control.nodes.wheel_pid import WheelPid
from smp_motor_ident.nodes.identifier import Identifier

POLICY = ElementTree.parse(Path(__file__).resolve().parents[2] / "security" / "policy.xml")
Allowed = dict[str, set[str]]


def wheel_pid() -> Node:
    node = WheelPid()
    node.trigger_configure()
    return node


def lab() -> Node:
    node = rclpy.create_node("lab")
    live_link.LiveLink(SimpleNamespace(node=node), WHEELS, Mock())
    for wheel in WHEELS:  # as RobotClient.paused does
        node.create_subscription(String, f"{wheel}/motor_owner", lambda _: None, 1)
    return node


NODES: list[tuple[str, Callable[[], Node]]] = [
    *((f"/{wheel}", wheel_pid) for wheel in WHEELS),
    ("/", SkidSteerNode), ("/", teleop_wheels.TeleopWheels), ("/", SerialDriver), ("/", MotorPlant),
    ("/", Excite), ("/", Identifier), ("/", lab),
]  # fmt: skip


def read_policy() -> dict[str, Allowed]:
    """Return the policy's rules: full names by the node's path and by the kind of access."""
    result: dict[str, Allowed] = {}
    for context in POLICY.iter("context"):
        (profile,) = context.iter("profile")
        namespace, name = profile.attrib["ns"].rstrip("/"), profile.attrib["node"]
        path = f"{namespace}/{name}"
        assert context.attrib["path"] == path
        access: Allowed = {"publish": set(), "subscribe": set(), "reply": set(), "request": set()}
        for group in profile:
            ((kind, rule),) = group.attrib.items()
            assert rule == "ALLOW" and group.tag in ("topics", "services")
            for entry in group:
                text = str(entry.text).replace("~", path)
                access[kind].add(text if text.startswith("/") else f"{namespace}/{text}")
        result[path] = access
    return result


def list_access(make: Callable[[], Node], namespace: str, domain: int) -> tuple[str, Allowed]:
    """Make a node and return its publications, subscriptions and services."""
    rclpy.init(args=["--ros-args", "-r", f"__ns:={namespace}"], domain_id=domain)
    try:
        node = make()
        access = {
            "publish": {p.topic_name for p in node.publishers},
            "subscribe": {s.topic_name for s in node.subscriptions},
            "reply": {node.resolve_service_name(s.srv_name) for s in node.services},
        }
        path = f"{node.get_namespace().rstrip('/')}/{node.get_name()}"
        node.destroy_node()
        return path, access
    finally:
        rclpy.shutdown()


@pytest.mark.parametrize(("namespace", "make"), NODES[3:], ids=lambda x: getattr(x, "__name__", ""))
def test_policy_allows_exactly_the_topics_a_node_uses(namespace, make, ros_domain, monkeypatch):
    monkeypatch.setattr(teleop_wheels, "Terminal", Mock())  # tests have no terminal
    path, access = list_access(make, namespace, ros_domain)
    rules = read_policy()[path]
    for kind, names in access.items():
        assert names <= rules[kind], f"{path} may not {kind} {names - rules[kind]}"
    # No more than these, except the topics of rcl and of packages not installed here.
    always = {"/clock", "/parameter_events", "/rosout", "/tf"}
    for kind in ("publish", "subscribe"):
        spare = {n for n in rules[kind] - access[kind] - always if "transition_event" not in n}
        assert not spare, f"{path} never uses {spare}"


def test_wheels_have_equal_rights_and_few_nodes_may_command_them():
    rules = read_policy()
    wheels = [
        {
            k: {n.replace(f"/{w}/", "/wheel/") for n in v}
            for k, v in rules[f"/{w}/wheel_pid"].items()
        }
        for w in WHEELS
    ]
    assert all(one == wheels[0] for one in wheels)

    def publishers(topic: str) -> set[str]:
        return {path for path, rule in rules.items() if topic in rule["publish"]}

    for wheel in WHEELS:
        tools = {"/excite", "/commission"}
        assert publishers(f"/{wheel}/motor_command") == {f"/{wheel}/wheel_pid", *tools}
        assert publishers(f"/{wheel}/motor_state") == {"/serial_driver", "/motor_plant"}
        askers = {
            p for p, rule in rules.items() if f"/{wheel}/wheel_pid/change_state" in rule["request"]
        }
        assert askers == {"/commission", "/lab", "/tune", "/robot_guard"}
        resetting = {
            p for p, rule in rules.items() if f"/{wheel}/wheel_pid/reset" in rule["request"]
        }
        assert resetting == {"/operator"}, "a latched wheel waits for a person"
    drivers = {"/skid_steer", "/teleop_wheels", "/commission", "/lab"}
    assert publishers("/wheel_setpoints") == drivers
    assert publishers("/cmd_vel") == {"/teleop_wheels", "/lab"}
