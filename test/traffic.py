# SPDX-License-Identifier: Apache-2.0
"""Topics and bags for the tests of record and play."""

import time
from pathlib import Path
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import Reader

from smp_interfaces.msg import MotorState

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
BEGIN = time.time_ns()
RELIABLE = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(
    depth=5, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


def state(number: int) -> MotorState:
    message = MotorState()
    # The instant of sampling, 1 ms apart however late a busy machine publishes.
    stamp = BEGIN + number * 10**6
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    message.header.frame_id = "x_wheel_joint"
    message.voltage, message.velocity, message.encoder_count = 0.01 * number, 1.0, number
    return message


def raw(message: Any) -> bytes:
    """Serialize as DDS delivers it: in whole words (a string may end in the middle of one)."""
    data = bytes(serialize_message(message))
    return data + bytes(-len(data) % 4)


def so_far(bag: Path) -> dict[str, list[bytes]]:
    """Read a bag that is being written; its end may be torn in the middle of a write."""
    try:
        return contents(bag)
    except Exception:  # any error of a reader in a torn file: look again
        return {}


def all_states(found: dict[str, list[bytes]]) -> list[int]:
    """Count each wheel's messages; the bag also holds log messages of nodes."""
    return [len(found.get(f"/{wheel}/motor_state", [])) for wheel in WHEELS]


def contents(bag: Path) -> dict[str, list[bytes]]:
    """Read a bag with rosbags."""
    found: dict[str, list[bytes]] = {}
    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            found.setdefault(connection.topic, []).append(bytes(data))
    return found


def publish_steadily(publishers, count, rate, make=state):
    """Publish at a rate; catch up after delays, and skip nothing."""
    sent = []
    begin = time.monotonic()
    for k in range(count):
        time.sleep(max(0.0, begin + k / rate - time.monotonic()))
        data = raw(make(k))
        sent.append(data)
        for publisher in publishers:
            publisher.publish(data)  # padding bytes between aligned fields are random
    return sent
