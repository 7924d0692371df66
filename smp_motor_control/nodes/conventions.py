"""What all nodes do alike: QoS, timers that nothing stops, names, stamps."""

import time
from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.timer import Timer

# REP-2003: streams are published reliably and taken best effort, so that both a stock
# reliable subscriber and a stock best-effort publisher find a partner in our nodes.
# No lease of liveliness is offered: what keeps it can lock up with the end of another process
# (docs/decisions/when-a-wheel-stops.md).
STREAM_PUBLISHER = QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE)
"""Commands, states, set-points: what is outdated by the next message."""

STREAM_SUBSCRIBER = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
"""The other end of :data:`STREAM_PUBLISHER`, and of any stock publisher."""

LATCHED = QoSProfile(
    depth=1,
    history=HistoryPolicy.KEEP_LAST,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""Descriptions: the last one is kept for whoever comes late."""


def send_last(publisher: Publisher, message: Any) -> None:
    """Publish a last message and wait until those who take it reliably have it."""
    publisher.publish(message)
    publisher.wait_for_all_acked(Duration(seconds=0.3))
    # Best-effort readers acknowledge nothing: give the datagram time to leave the process.
    time.sleep(0.02)


def steady_timer(node: Node, period: float, callback: Callable[[], None]) -> Timer:
    """Return a timer that neither simulated nor corrected time can stop."""
    return node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def nanoseconds(stamp: Any) -> int:
    """Return a stamp in whole nanoseconds; 0 where none was given."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def seconds(stamp: Any) -> float:
    """Return a ``builtin_interfaces/Time`` as seconds."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)
