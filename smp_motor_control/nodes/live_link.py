# SPDX-License-Identifier: Apache-2.0
"""Streams of a running robot in batches, and commands to it under a watchdog.

A :class:`LiveLink` works in a timer of the client's node, which runs whenever the client waits.
"""

import math
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from smp_interfaces.msg import MotorDescription, MotorParameters, MotorState, PidState
from smp_motor_control import get_controller_name, get_joint_name
from smp_motor_control.arrays import Array
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.executor import PolledSubscriptions
from smp_motor_control.nodes.robot_client import RobotClient

COLUMNS = ("voltage", "current", "speed", "setpoint", "reference", "prediction")
"""Quantities of a wheel: [V], [A] and [rad/s, wheel]; NaN if unknown."""

SLOT_S = 0.005  # interval of the common time grid; the last sample in it counts
MAX_LATE_SLOTS = 4  # delay of one wheel's samples after another's [slots]
MAX_OFFSET_SLOTS = 200  # longest lag of a stream; a longer one shows a clock that was set
FRAME_S = 1 / 30  # period of batches and of commands
HISTORY_S = 60.0  # length of the stored history
COMMAND_TIMEOUT_S = 0.3  # age at which a command expires
WATCH_TIMEOUT_S = 0.5  # longest time between two checks of the page that drives
BODY_TIMEOUT_S = 0.6  # from the last command to the body until skid_steer is idle
ZERO_TIME_S = 1.0  # duration of zero commands after a drive
DIAGNOSTICS_TIMEOUT_S = 3.0  # age at which a report is dropped

_STREAM_QOS = QoSProfile(depth=500, reliability=ReliabilityPolicy.BEST_EFFORT)

Plan = Sequence[tuple[float, float]]
"""Set-points of a wheel: seconds since the begin, and rad/s from then on."""


def decode_numbers(messages: Sequence[bytes], count: int) -> tuple[Array, Array]:
    """Return stamps [s] and the first ``count`` numbers of serialized messages with a header.

    References
    ----------
    OMG DDSI-RTPS 2.5, section 10 (CDR, little endian): numbers of 8 bytes follow the frame's name
    at a multiple of 8 after the encapsulation of 4 bytes.
    """
    length = len(messages[-1])
    alike = [one for one in messages if len(one) == length]
    data = np.frombuffer(b"".join(alike), np.uint8).reshape(len(alike), length)
    name = int.from_bytes(messages[-1][12:16], "little")
    begin = 4 + -(-(12 + name) // 8) * 8
    seconds, nanoseconds = (data[:, k : k + 4].copy().view("<u4")[:, 0] for k in (4, 8))
    numbers = data[:, begin : begin + 8 * count].copy().view("<f8")
    return seconds + 1e-9 * nanoseconds, numbers


class History:
    """The last minute of all wheels on a common time grid, shape (slots, wheels, columns)."""

    def __init__(self, wheels: int) -> None:
        self._rows = np.full((int(HISTORY_S / SLOT_S), wheels, len(COLUMNS)), math.nan)
        self.newest = self._taken = self.origin = -1  # slots: newest, last taken, first of all

    def add(self, wheel: int, columns: slice, stamps: Array, values: Array) -> None:
        """Put samples of one wheel into their slots."""
        slots = (stamps / SLOT_S).astype(np.int64)
        size, newest = len(self._rows), int(slots[-1])
        if self.newest < 0 or not -MAX_OFFSET_SLOTS <= newest - self.newest < size:
            self._rows[:] = math.nan  # the first samples, or the clock was set
            self.newest = self._taken = newest
            self.origin = newest if self.origin < 0 else self.origin
        elif newest > self.newest:
            self._rows[np.arange(self.newest + 1, newest + 1) % size] = math.nan
            self.newest = newest
        self._rows[slots % size, wheel, columns] = values

    def take(self) -> tuple[Array, Array]:
        """Return slots since the last call and their rows, without rows that hold nothing."""
        end = max(self.newest - MAX_LATE_SLOTS, self._taken)
        slots, self._taken = np.arange(self._taken + 1, end + 1), end
        rows = self._rows[slots % len(self._rows)]
        some = np.isfinite(rows[:, :, :3]).any(axis=(1, 2))
        return slots[some], rows[some]

    def since(self, slot: int) -> tuple[Array, Array]:
        """Return the slots from ``slot`` on, and their rows."""
        first = max(slot, self.newest - len(self._rows) + 1)
        slots = np.arange(first, self.newest + 1)
        return slots, self._rows[slots % len(self._rows)]


class LiveLink:
    """Streams and commands of the wheels of one robot.

    The listener has ``on_frame(slots, rows)`` for a batch of samples, shape (slots,) and
    (slots, wheels, columns), ``on_learned(wheel, message)`` for ``MotorParameters``,
    ``interrupt()`` to end an excitation at once, ``on_halt(reason)`` once the wheels were
    stopped, and ``on_tick()`` for every period.
    """

    def __init__(self, client: RobotClient, wheels: Sequence[str], listener: Any) -> None:
        self._client, self.wheels, self._listener = client, tuple(wheels), listener
        self.history = History(len(wheels))
        self.hardware: dict[str, MotorDescription] = {}
        self.diagnostics: dict[str, tuple[float, int, str]] = {}
        self.armed = self.controlled = False  # whether commands pass; controllers are active
        self.watched_at = -math.inf  # time of the last check of the page that drives
        self._halt, self.halts = "", 0  # reason of a halt that is due; number of halts
        self._plans: tuple[float, Mapping[str, Plan]] | None = None
        self._body = (0.0, 0.0, -math.inf)  # m/s, rad/s, when commanded
        node = client.node
        self._streams = [
            (kind, numbers, k, columns, node.create_subscription(
                kind, f"{wheel}/{topic}", lambda _: None, _STREAM_QOS, raw=True,
                callback_group=PolledSubscriptions(),
            ))
            for k, wheel in enumerate(wheels)
            for kind, topic, numbers, columns in (
                (MotorState, "motor_state", 3, slice(0, 3)),
                (PidState, "pid_state", 2, slice(3, 5)),
            )
        ]  # fmt: skip
        for wheel in wheels:
            for kind, topic, take in (
                (MotorDescription, "motor_description", partial(self.hardware.__setitem__, wheel)),
                (MotorParameters, "motor_parameters", partial(listener.on_learned, wheel)),
            ):
                node.create_subscription(kind, f"{wheel}/{topic}", take, runtime.LATCHED)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        self._twist = TwistStamped()
        self._twist.header.frame_id = "base_link"
        self._setpoint = JointState(name=[get_joint_name(wheel) for wheel in wheels])
        stream = runtime.STREAM_PUBLISHER
        self.twists = node.create_publisher(TwistStamped, "cmd_vel", stream)
        self._setpoints = node.create_publisher(JointState, "wheel_setpoints", stream)
        self._switches = [
            node.create_client(ChangeState, f"{get_controller_name(wheel)}/change_state")
            for wheel in wheels
        ]
        runtime.steady_timer(node, FRAME_S, self._on_timer)

    def halt(self, reason: str) -> None:
        """Stop the wheels within a period and refuse commands until they are armed again."""
        self._halt, self.halts = self._halt or reason, self.halts + 1
        if self.armed:
            self._listener.interrupt()

    def drive(self, linear: float, angular: float) -> None:
        """Command the body [m/s], [rad/s]; it stops when no further command comes."""
        if self.armed and math.isfinite(linear + angular):
            self._body = linear, angular, time.monotonic()

    def follow(self, plans: Mapping[str, Plan]) -> None:
        """Send set-points by plans, and zero to the other wheels, until :meth:`end_plans`."""
        if self.armed:
            self._plans = time.monotonic(), plans

    def end_plans(self) -> None:
        """End what :meth:`follow` began with a set-point of zero."""
        if self._plans is not None:
            self._plans = None
            self._send_setpoints({})

    def is_body_idle(self) -> bool:
        """Return whether skid_steer, after the last command to the body, yields the wheels."""
        return time.monotonic() - self._body[2] > COMMAND_TIMEOUT_S + ZERO_TIME_S + BODY_TIMEOUT_S

    def _on_timer(self) -> None:
        now = time.monotonic()
        if self.armed and now - self.watched_at > WATCH_TIMEOUT_S:
            self.halt(f"the page was not checked for {WATCH_TIMEOUT_S:g} s")
        if self._halt:
            self._stop_wheels()
        linear, angular, at = self._body
        if now - at < COMMAND_TIMEOUT_S + ZERO_TIME_S:
            fresh = self.armed and now - at < COMMAND_TIMEOUT_S
            self._send_twist(*((linear, angular) if fresh else (0.0, 0.0)))
        if self._plans is not None:
            begun, plans = self._plans
            self._send_setpoints({
                wheel: next((v for t, v in reversed(plan) if now - begun >= t), 0.0)
                for wheel, plan in plans.items()
            })  # fmt: skip
        try:
            self._read()
            self._listener.on_tick()
        except Exception as error:  # keep running, to stop the wheels
            self.halt(f"the streams failed with {error!r}")

    def _read(self) -> None:
        for kind, numbers, wheel, columns, stream in self._streams:
            messages, handle = [], stream.handle
            with handle:
                while (taken := handle.take_message(kind, True)) is not None:
                    messages.append(taken[0])
            if messages:
                self.history.add(wheel, columns, *decode_numbers(messages, numbers))
        if self.history.newest >= 0:
            slots, rows = self.history.take()
            if slots.size:
                self._listener.on_frame(slots, rows)

    def _stop_wheels(self) -> None:
        reason, self._halt = self._halt, ""
        if not (self.armed or self.controlled):
            return  # the wheels are not ours to stop
        self.armed, self._plans = False, None
        self._body = (0.0, 0.0, self._body[2])  # zero for as long as it would have driven
        self._send_setpoints({})
        if self.controlled:
            self.controlled = False
            request = ChangeState.Request(
                transition=Transition(id=Transition.TRANSITION_DEACTIVATE)
            )
            for switch in self._switches:
                if switch.service_is_ready():
                    switch.call_async(request)
        self._listener.on_halt(reason)

    def _send_twist(self, linear: float, angular: float) -> None:
        self._twist.header.stamp = self._client.node.get_clock().now().to_msg()
        self._twist.twist.linear.x, self._twist.twist.angular.z = linear, angular
        self.twists.publish(self._twist)

    def _send_setpoints(self, speeds: Mapping[str, float]) -> None:
        self._setpoint.header.stamp = self._client.node.get_clock().now().to_msg()
        self._setpoint.velocity = [float(speeds.get(wheel, 0.0)) for wheel in self.wheels]
        self._setpoints.publish(self._setpoint)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        now = time.monotonic()
        for one in message.status:
            self.diagnostics[one.name] = now, ord(one.level), one.message
        for name, (at, *_) in list(self.diagnostics.items()):
            if now - at > DIAGNOSTICS_TIMEOUT_S:
                del self.diagnostics[name]
