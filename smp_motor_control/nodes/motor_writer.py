# SPDX-License-Identifier: Apache-2.0
"""Both ends of a wheel's command topic, with the ownership of the wheel."""

import math
import os
import time
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.node import Node
from std_msgs.msg import String

from smp_interfaces.msg import MotorCommand, MotorDescription, MotorState
from smp_motor_control import get_joint_name
from smp_motor_control.nodes import runtime
from smp_motor_control.wheel.lease import Lease

_FINAL_ZEROS = 3


class MotorWriter:
    """Publisher of a wheel's commands; see :class:`~smp_motor_control.wheel.lease.Lease`."""

    def __init__(self, node: Node, prefix: str = "") -> None:
        self._node = node
        # The process id distinguishes two processes with the same node name.
        self._name = f"{node.get_fully_qualified_name()}#{os.getpid()}"
        self._message = MotorCommand()
        self._message.header.frame_id = self._name
        self.publisher = node.create_publisher(
            MotorCommand, f"{prefix}motor_command", runtime.STREAM_PUBLISHER
        )
        self._owners = node.create_subscription(
            String, f"{prefix}motor_owner", self._heard, runtime.LATCHED
        )
        self.owner = ""  # another writer that owns the wheel

    def _heard(self, message: String) -> None:
        self.owner = "" if message.data == self._name else message.data

    def send(self, voltage: float, stamp: Any = None) -> None:
        """Command a voltage [V] with the stamp of the sample it answers, or now."""
        message = self._message
        message.header.stamp = self._node.get_clock().now().to_msg() if stamp is None else stamp
        message.voltage = voltage
        self.publisher.publish(message)

    def stop(self) -> None:
        """Command zero repeatedly, as best-effort readers may lose a datagram."""
        for _ in range(_FINAL_ZEROS - 1):
            self.send(0.0)
            time.sleep(0.005)
        self.send(0.0)
        runtime.send_last(self.publisher, self._message)

    def destroy(self) -> None:
        self._node.destroy_publisher(self.publisher)
        self._node.destroy_subscription(self._owners)


def report_refused_writers(leases: Mapping[str, Lease]) -> str:
    """Return a message on the writers refused since the previous call, by wheel; else nothing."""
    found = [f"{wheel}: {', '.join(sorted(one.refused))}" for wheel, one in leases.items()
             if one.refused]  # fmt: skip
    for one in leases.values():
        one.refused = {}
    return f"refused, another node owns the wheel: {'; '.join(found)}" if found else ""


class MotorDriver:
    """The driver's end: obeys the owner of the wheel, publishes its name and reports the state.

    ``obey`` is called with the time on a steady clock [s] and the voltage [V]; :meth:`report`
    publishes ``state``.
    """

    def __init__(
        self,
        node: Node,
        wheel: str,
        timeout: float,
        obey: Callable[[float, float], Any],
        description: MotorDescription,
    ) -> None:
        self._clock, self._obey = node.get_clock(), obey
        self.lease = Lease(timeout)
        self.state = MotorState(current=math.nan)
        self.state.header.frame_id = description.joint_name = get_joint_name(wheel)
        self._owner = "?"
        self._owners = node.create_publisher(String, f"{wheel}/motor_owner", runtime.LATCHED)
        self._states = node.create_publisher(
            MotorState, f"{wheel}/motor_state", runtime.STREAM_PUBLISHER
        )
        # Keep a reference, or the publisher is destroyed with its latched message.
        self._descriptions = node.create_publisher(
            MotorDescription, f"{wheel}/motor_description", runtime.LATCHED
        )
        self._descriptions.publish(description)
        node.create_subscription(
            MotorCommand, f"{wheel}/motor_command", self._heard, runtime.STREAM_SUBSCRIBER
        )

    def _heard(self, message: MotorCommand) -> None:
        now = time.monotonic()
        stamps = runtime.nanoseconds(message.header.stamp), self._clock.now().nanoseconds
        if self.lease.take(message.header.frame_id, message.voltage, now, *stamps):
            self._obey(now, message.voltage)

    def report(self, stamp: Any) -> None:
        """Publish ``state`` with a stamp."""
        self.state.header.stamp = stamp
        self._states.publish(self.state)

    def publish_owner(self, now: float) -> None:
        """Publish the owner of the wheel when it changes."""
        owner = self.lease.owner(now)
        if owner != self._owner:
            self._owner = owner
            self._owners.publish(String(data=owner))
