"""What all nodes share: start, spin, stop with a zero command, diagnostics, QoS, real time.

A node's ``main`` is ``return run("name", lambda: TheNode(), argv)``.  The node may define
``on_stop()``, which :func:`run` calls before it destroys the node whatever the reason of
leaving: SIGINT, SIGTERM, :func:`finish`, or an exception in a callback.
"""

from __future__ import annotations

import contextlib
import gc
import os
import re
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import rclpy
from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.timer import Timer

from smp_motor_control.errors import SmpError
from smp_motor_control.nodes.executor import LeanExecutor

# REP-2003: streams are published reliably and taken best effort, so that both a stock
# reliable subscriber and a stock best-effort publisher find a partner in our nodes.
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

OK, WARN, ERROR, STALE = (
    DiagnosticStatus.OK,
    DiagnosticStatus.WARN,
    DiagnosticStatus.ERROR,
    DiagnosticStatus.STALE,
)

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class _Stop:
    """Why and when to leave the spin, for nodes and for the signal thread."""

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
        """Let signals request the stop, whatever the main thread is waiting in.

        Python runs handlers in the main thread, which DDS may keep waiting; the C handler
        below it writes to a pipe at once, and a thread reads that.
        """
        inlet, outlet = os.pipe()
        os.set_blocking(outlet, False)
        for number in _SIGNALS:
            signal.signal(number, lambda *_: None)
        signal.set_wakeup_fd(outlet, warn_on_full_buffer=False)
        threading.Thread(target=self._read_signals, args=(inlet,), daemon=True).start()

    def _read_signals(self, inlet: int) -> None:
        while number := os.read(inlet, 1):
            if number[0] not in _SIGNALS:  # such as SIGCONT, handled by a node itself
                continue
            if self.requested.is_set():
                os._exit(1)
            self.request()


_stop = _Stop()


def finish(exit_code: int = 0) -> None:
    """End the node after the present callback, as a node that has done its work does.

    Parameters
    ----------
    exit_code : int
        Of the process.
    """
    _stop.request(exit_code)


def run(name: str, make: Callable[[], Node], argv: list[str] | None = None) -> int:
    """Start a node, spin it until a signal, and stop it cleanly.

    Parameters
    ----------
    name : str
        Of the executable, for messages.
    make : callable
        Returns the node; called after ``rclpy.init``.
    argv : list of str, optional
        Arguments without the program's name; None takes those of the process.

    Returns
    -------
    int
        0 after a signal or :func:`finish`; 2 when the node refuses to start, with one line
        on standard error; 1 after an unexpected exception.
    """
    global _stop
    _stop = stop = _Stop()
    # rclpy's own handlers would shut the context down, and with it the way to send a zero.
    stop.watch_signals()
    arguments = [name, *(sys.argv[1:] if argv is None else argv)]
    node: Node | None = None
    try:
        _init(arguments)
        _refuse_other_arguments(arguments)
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


_USAGE_ERRORS = (
    "RCLError",
    "RCLInvalidROSArgsError",
    "UnknownROSArgsError",
    "InvalidParameterTypeException",
    "InvalidParameterValueException",
    "InvalidNodeNameException",
    "InvalidNamespaceException",
    "ParameterAlreadyDeclaredException",
)


def _init(arguments: list[str]) -> None:
    """Initialise rclpy without the second telling, on standard error, of what it raises."""
    sys.stderr.flush()
    kept = os.dup(2)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _refuse_other_arguments(arguments: list[str]) -> None:
    other = rclpy.utilities.remove_ros_args(arguments)[1:]
    if other:
        raise SmpError(f"unknown argument {other[0]!r}; parameters follow --ros-args")


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
    """Return what a message of rcl says, without where in its sources it says so."""
    return " ".join(re.sub(r", at /?\S+:\d+", "", text).split())


def _fail(name: str, message: str, exit_code: int) -> int:
    print(f"{name}: {message}", file=sys.stderr, flush=True)
    return exit_code


def _close(node: Node | None) -> None:
    try:
        if node is not None:
            on_stop = getattr(node, "on_stop", None)
            if on_stop is not None:
                on_stop()
            node.destroy_node()
    finally:
        rclpy.try_shutdown()


def send_last(publisher: Publisher, message: Any, timeout: float = 0.3) -> None:
    """Publish a last message and wait until those who take it reliably have it.

    Parameters
    ----------
    publisher : rclpy.publisher.Publisher
        Of the topic.
    message : object
        Such as a zero command.
    timeout : float
        Longest wait [s].
    """
    publisher.publish(message)
    publisher.wait_for_all_acked(Duration(seconds=timeout))
    # Best-effort readers acknowledge nothing: give the datagram time to leave the process.
    time.sleep(0.02)


def steady_timer(node: Node, period: float, callback: Callable[[], None]) -> Timer:
    """Return a timer that neither simulated nor corrected time can stop.

    Parameters
    ----------
    node : rclpy.node.Node
        Owner.
    period : float
        [s].
    callback : callable
        Called every period.

    Returns
    -------
    rclpy.timer.Timer
        Running.
    """
    return node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def wheel_of(node: Node) -> str:
    """Return the wheel whose namespace a node lives in.

    Parameters
    ----------
    node : rclpy.node.Node
        Such as ``/front_left/wheel_pid``, also below a robot's namespace.

    Returns
    -------
    str
        Such as ``front_left``; empty in the root namespace.
    """
    return str(node.get_namespace().rsplit("/", 1)[-1])


def share(path: str) -> Path:
    """Return a file of this package, installed or in its source tree.

    Parameters
    ----------
    path : str
        Such as ``config/motors_paper.yaml``.

    Returns
    -------
    Path
        Where it is.

    Raises
    ------
    SmpError
        When it is nowhere.
    """
    places = [Path(__file__).resolve().parents[2]]
    with contextlib.suppress(PackageNotFoundError):
        places.insert(0, Path(get_package_share_directory("smp_motor_control")))
    for place in places:
        if (place / path).exists():
            return place / path
    raise SmpError(f"{path} of smp_motor_control is not installed; build the package again")


def seconds(stamp: Any) -> float:
    """Return a ``builtin_interfaces/Time`` as seconds.

    Parameters
    ----------
    stamp : builtin_interfaces.msg.Time
        The stamp.

    Returns
    -------
    float
        [s]; good to some 0.1 us since 1970.
    """
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def refuse_impossible_transitions(node: LifecycleNode) -> None:
    """Answer a request for a transition that the present state does not have, and live on.

    rclpy raises in the service's callback instead, which ends the node.

    Parameters
    ----------
    node : rclpy.lifecycle.LifecycleNode
        Whose service is guarded.
    """
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


class Diagnostics:
    """Publishes a node's health on ``/diagnostics``, every second and at once on a change.

    Parameters
    ----------
    node : rclpy.node.Node
        Its full name is the status' name.
    assess : callable
        Returns ``(level, message, values)``: one of :data:`OK`, :data:`WARN`, :data:`ERROR`,
        :data:`STALE`, a line for people, and a mapping of names to values.
    hardware_id : str
        Such as the joint's name.

    Attributes
    ----------
    due : bool
        Whether ``assess`` is asked for the report of the second, and not for one between.
    """

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
        self.due = False

    def _tick(self) -> None:
        self.due = True
        self.publish()
        self.due = False

    def destroy(self) -> None:
        """Fall silent and give the topic back."""
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)

    def publish(self) -> None:
        """Publish the present health now."""
        level, message, values = self._assess()
        array = DiagnosticArray()
        array.header.stamp = self._node.get_clock().now().to_msg()
        array.status = [
            DiagnosticStatus(
                level=level,
                name=self._name,
                message=message,
                hardware_id=self._hardware_id,
                values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
            )
        ]
        self._publisher.publish(array)


def _text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def keep_time(node: Node, priority: int, affinity: tuple[int, ...]) -> list[str]:
    """Ask the system for what a control loop wants, and do without where it says no.

    Freezes what is allocated so far out of the garbage collector's sight and turns the
    collector off; :func:`collect_garbage` is then to be called where it does no harm.

    Parameters
    ----------
    node : rclpy.node.Node
        For its log.
    priority : int
        SCHED_FIFO priority, 1 to 99; 0 leaves the scheduler alone.
    affinity : tuple of int
        Processors to run on; empty for all.

    Returns
    -------
    list of str
        What was refused, a line each.
    """
    refused = []
    if priority > 0:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except (OSError, AttributeError) as error:
            refused.append(f"scheduling_priority {priority} not granted: {error}")
    if affinity:
        try:
            os.sched_setaffinity(0, affinity)
        except (OSError, ValueError, OverflowError) as error:
            refused.append(f"cpu_affinity {list(affinity)} not granted: {error}")
    for line in refused:
        node.get_logger().warning(f"{line}; running without it")
    gc.collect()
    gc.freeze()
    gc.disable()
    return refused


def collect_garbage() -> None:
    """Collect the few objects made since :func:`keep_time`, while the loop has time."""
    gc.collect()
