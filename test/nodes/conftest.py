# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the tests of nodes."""

from collections.abc import Iterator

import pytest
from body_peer import GEOMETRY, Peer
from rclpy.node import Node
from wheel_robot import DomainNode


@pytest.fixture
def node(ros_domain: int) -> Iterator[Node]:
    one = DomainNode(ros_domain, "tester")
    one.node.spin = one.spin  # type: ignore[attr-defined]
    yield one.node
    one.close()


@pytest.fixture
def peer(ros_domain: int) -> Iterator[Peer]:
    peer = Peer(ros_domain)
    yield peer
    peer.close()


@pytest.fixture
def skid_steer(process, peer, eventually):
    def run(*more: str, listens: str = "cmd_vel"):
        started = process("skid_steer", "--ros-args", *GEOMETRY, *more)
        eventually(
            lambda: peer.node.count_subscribers(listens) and peer.setpoints_found(),
            deadline=20.0,
            step=peer.spin,
            message=started.output,
        )
        return started

    peer.setpoints_found = lambda: peer.node.count_publishers("wheel_setpoints")
    return run
