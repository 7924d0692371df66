"""What the tests of nodes share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import rclpy
from body_peer import GEOMETRY, Peer
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node


@pytest.fixture
def node(ros_domain: int) -> Iterator[Node]:
    context = Context()
    rclpy.init(context=context, domain_id=ros_domain)
    made = rclpy.create_node("tester", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(made)
    made.spin = lambda: executor.spin_once(timeout_sec=0.01)  # type: ignore[attr-defined]
    yield made
    executor.shutdown()
    made.destroy_node()
    rclpy.shutdown(context=context)


@pytest.fixture
def peer(ros_domain: int) -> Iterator[Peer]:
    peer = Peer(ros_domain)
    yield peer
    peer.executor.shutdown()
    peer.node.destroy_node()
    rclpy.shutdown(context=peer.context)


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
