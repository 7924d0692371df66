# SPDX-License-Identifier: Apache-2.0
"""Processes of tests are reached on loopback alone, and end with their test."""

import os
import socket
import struct
from pathlib import Path

from threadpoolctl import threadpool_info

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


def is_running(pid: int) -> bool:
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return False
    return status.rpartition(")")[2].split()[0] != "Z"


def test_every_started_process_is_ended_with_its_children(process, eventually):
    # The child ignores the interrupt, as a hanging node would.
    parent = process("sh", "-c", "trap '' INT; sleep 60 & echo $!; wait")
    eventually(lambda: parent.output.endswith("\n"))
    child = int(parent.output)
    assert is_running(child)
    parent.end()
    eventually(lambda: not is_running(child), deadline=2.0)


def test_each_process_inherits_a_domain_of_its_own_on_loopback(process, ros_domain):
    shown = process("sh", "-c", "echo $ROS_DOMAIN_ID $FASTRTPS_DEFAULT_PROFILES_FILE")
    assert shown.wait(5.0) == 0
    domain, profile = shown.output.split()
    assert (domain, Path(profile).name) == (str(ros_domain), "loopback.xml")
    assert os.environ["ROS_DOMAIN_ID"] == str(ros_domain)


def test_linear_algebra_of_tests_has_one_thread():
    assert {pool["num_threads"] for pool in threadpool_info()} == {1}
