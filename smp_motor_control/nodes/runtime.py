# SPDX-License-Identifier: Apache-2.0
"""Start, spin and stop of nodes; QoS, timers, stamps and diagnostics.

A node's ``main`` is ``partial(run, "name", TheNode)``.  :func:`run` calls the node's ``on_stop()``,
if defined, before it destroys the node for any reason: SIGINT, SIGTERM, SIGQUIT, SIGHUP (a closed
terminal), SIGTSTP (Ctrl-Z: a suspended node cannot stop its wheels), :func:`finish`, or an
exception in a callback.
"""

import math
import os
import re
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.timer import Timer

from smp_motor_control.entry import was_interrupted_on_import
from smp_motor_control.errors import SmpError
from smp_motor_control.nodes.executor import LeanExecutor

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

# REP-2003: reliable publishers and best-effort subscribers are compatible with any other node.
# No liveliness lease is offered: it can lock up when another process ends (see the decision
# docs/decisions/when-a-wheel-stops.md).
STREAM_PUBLISHER = QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE)
"""Commands, states and set-points, which the next message replaces."""

STREAM_SUBSCRIBER = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Subscriber of :data:`STREAM_PUBLISHER` and of any other publisher."""

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""Descriptions; late subscribers get the last one."""

REPEATED_SIGNAL_S = 1.0
"""Time in which signals are one request to stop: a terminal, its shell, launch and systemd may each
send one. A later signal exits at once."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGQUIT, signal.SIGHUP, signal.SIGTSTP)


def _wake_only(*_: object) -> None:
    """Do nothing: :meth:`_Stop._read_signals` handles the signal."""


class _Stop:
    """Stop request of nodes and of the signal thread."""

    def __init__(self) -> None:
        self.requested = threading.Event()
        self.exit_code = 0
        self.wake: Callable[[], None] = lambda: None

    def request(self, exit_code: int = 0) -> None:
        if not self.requested.is_set():
            self.exit_code = exit_code
            self.requested.set()
            self.wake()

    def watch_signals(self) -> None:
        """Let signals request the stop while the main thread waits.

        Python runs handlers in the main thread, which may be blocked in DDS; the C handler writes
        to a pipe, which a thread reads.
        """
        inlet, outlet = os.pipe()
        os.set_blocking(outlet, False)
        for number in _SIGNALS:
            # nohup ignores SIGHUP.
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, _wake_only)
        signal.set_wakeup_fd(outlet, warn_on_full_buffer=False)
        threading.Thread(target=self._read_signals, args=(inlet,), daemon=True).start()

    def ignore_signals(self) -> None:
        """Ignore repeated signals while Python ends, which would end the process by them."""
        for number in _SIGNALS:
            if signal.getsignal(number) is _wake_only:
                signal.signal(number, signal.SIG_IGN)

    def _read_signals(self, inlet: int) -> None:
        first = math.inf
        while number := os.read(inlet, 1):
            if signal.getsignal(number[0]) is not _wake_only:  # the node has its own handler
                continue
            first = min(first, time.monotonic())
            if time.monotonic() - first > REPEATED_SIGNAL_S:
                os._exit(1)
            self.request()


_stop = _Stop()


def finish(exit_code: int = 0) -> None:
    """End the node after the present callback."""
    _stop.request(exit_code)


def run(name: str, make: Callable[[], Node], argv: list[str] | None = None) -> int:
    """Run a node until a signal and stop it cleanly; return the exit code."""
    global _stop
    _stop = stop = _Stop()
    # rclpy's own handlers would shut down the context before the final zero command.
    stop.watch_signals()
    if was_interrupted_on_import():
        return 0
    arguments = [name, *(sys.argv[1:] if argv is None else argv)]
    node: Node | None = None
    try:
        _init(arguments)
        if other := rclpy.utilities.remove_ros_args(arguments)[1:]:
            raise SmpError(f"unknown argument {other[0]!r}; parameters follow --ros-args")
        node = make()
        return _spin(node, stop)
    except SmpError as error:
        return _fail(name, str(error), error.exit_code)
    except ExternalShutdownException:
        return 0
    except Exception as error:
        if node is None and type(error).__name__ in _USAGE_ERRORS:
            return _fail(name, _one_line(str(error)), 2)
        traceback.print_exc()
        return _fail(name, f"stopped by {type(error).__name__}: {_one_line(str(error))}", 1)
    finally:
        _close(node)
        stop.ignore_signals()


_USAGE_ERRORS = (
    *("RCLError", "RCLInvalidROSArgsError", "UnknownROSArgsError"),
    *("InvalidParameterTypeException", "InvalidParameterValueException"),
    *(
        "InvalidNodeNameException",
        "InvalidNamespaceException",
        "InvalidTopicNameException",
        "ParameterAlreadyDeclaredException",
    ),
)


def _init(arguments: list[str]) -> None:
    """Initialise rclpy without its duplicate error output."""
    sys.stderr.flush()
    kept = os.dup(2)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _spin(node: Node, stop: _Stop) -> int:
    executor = LeanExecutor()
    executor.add_node(node)
    guard = node.create_guard_condition(lambda: None)
    stop.wake = guard.trigger
    try:
        while not stop.requested.is_set():
            executor.spin_once()
    finally:
        executor.shutdown()
    return stop.exit_code


def _one_line(text: str) -> str:
    """Return a message of rcl in one line, without its source location."""
    return " ".join(re.sub(r", at /?\S+:\d+", "", text).split())


def _fail(name: str, message: str, exit_code: int) -> int:
    print(f"{name}: {message}", file=sys.stderr, flush=True)
    return exit_code


def _close(node: Node | None) -> None:
    try:
        if node is not None:
            getattr(node, "on_stop", lambda: None)()
            node.destroy_node()
    finally:
        rclpy.try_shutdown()


def refuse_impossible_transitions(node: LifecycleNode) -> None:
    """Refuse invalid transitions; rclpy would raise in the service callback and end the node."""
    service = node._service_change_state
    change = service.callback

    def guarded(request: Any, response: Any) -> Any:
        try:
            return change(request, response)
        except rclpy._rclpy_pybind11.RCLError as error:
            node.get_logger().warning(_one_line(str(error)))
            response.success = False
            return response

    service.callback = guarded


def send_last(publisher: Publisher, message: Any) -> None:
    """Publish a last message and wait until reliable subscribers acknowledge it."""
    publisher.publish(message)
    publisher.wait_for_all_acked(Duration(seconds=0.3))
    # Best-effort subscribers do not acknowledge: give the datagram time to leave the process.
    time.sleep(0.02)


def steady_timer(node: Node, period: float, callback: Callable[[], None]) -> Timer:
    """Return a timer on the steady clock, independent of ROS time."""
    return node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def nanoseconds(stamp: Any) -> int:
    """Return a stamp in nanoseconds; 0 without a stamp."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def seconds(stamp: Any) -> float:
    """Return a ``builtin_interfaces/Time`` as seconds."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


class Diagnostics:
    """Publish a node's health on ``/diagnostics`` every second and on changes."""

    def __init__(
        self,
        node: Node,
        assess: Callable[[], tuple[bytes, str, Mapping[str, object]]],
        hardware_id: str = "",
    ) -> None:
        self._node = node
        self._assess = assess
        self._name = node.get_fully_qualified_name().lstrip("/")
        self._hardware_id = hardware_id
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._timer = steady_timer(node, 1.0, self._tick)
        self.due = False  # whether the present report is the periodic one

    def _tick(self) -> None:
        self.due = True
        self.publish()
        self.due = False

    def destroy(self) -> None:
        """Stop publishing and destroy the publisher."""
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)

    def publish(self) -> None:
        level, message, values = self._assess()
        clock = self._node.get_clock()
        if clock.ros_time_is_active and clock.now().nanoseconds == 0:
            level = max(level, WARN)
            message = f"use_sim_time is set, but /clock is not published; {message}"
        status = DiagnosticStatus(
            level=level, name=self._name, message=message, hardware_id=self._hardware_id
        )
        status.values = [KeyValue(key=key, value=_text(value)) for key, value in values.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = clock.now().to_msg()
        self._publisher.publish(array)


def _text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
