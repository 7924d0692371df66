"""What the tests of nodes share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import rclpy
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
