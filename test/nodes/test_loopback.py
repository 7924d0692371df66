# SPDX-License-Identifier: Apache-2.0
"""No node of a test, or of the demo, can be reached from another computer."""

import os
import socket
import struct
from pathlib import Path

from smp_motor_ident.cli.processes import loopback_environment


def bound_addresses(pid: int) -> set[str]:
    """Return the addresses to which a process has bound UDP sockets, as ``ss -lunp`` does."""
    links = (os.readlink(link) for link in Path(f"/proc/{pid}/fd").iterdir() if link.is_symlink())
    sockets = {link[8:-1] for link in links if link.startswith("socket:[")}
    found = set()
    for table, kind in (("udp", socket.AF_INET), ("udp6", socket.AF_INET6)):
        for row in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            address, inode = row.split()[1].partition(":")[0], row.split()[9]
            if inode in sockets:
                words = [address[k : k + 8] for k in range(0, len(address), 8)]
                raw = b"".join(struct.pack("=I", int(word, 16)) for word in words)
                found.add(socket.inet_ntop(kind, raw))
    return found


def test_nodes_bind_to_loopback_and_discover_each_other(process, node, eventually):
    names = [("motor_plant",), ("skid_steer",), ("record", "--output", "bag")]
    wheels = [("wheel_pid", "--ros-args", "-r", f"__ns:=/front_{s}") for s in ("left", "right")]
    started = [process(*command) for command in (*names, *wheels)]
    there = {"motor_plant", "skid_steer", "record", "wheel_pid"}
    eventually(lambda: there <= set(node.get_node_names()), 20.0, node.spin)
    for one in started:
        assert bound_addresses(one.pid) == {"127.0.0.1"}, one.command


def test_other_middleware_gets_only_the_ros_discovery_range(monkeypatch):
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")
    assert loopback_environment() == {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
