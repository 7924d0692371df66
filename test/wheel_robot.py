# SPDX-License-Identifier: Apache-2.0
"""Nodes of tests in their own ROS domain, and the peer that drives and stores the wheels."""

import contextlib
import copy
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from smp_interfaces.msg import MotorCommand, MotorState, PidState
from smp_motor_control import WHEELS

STREAM = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
PERIOD = 0.02
CONFIG = Path(__file__).resolve().parents[1] / "config"


def two_wheeled(folder: Path) -> tuple[Path, Path]:
    """Write motors and gains of a robot of two wheels: those of the paper's first two."""
    names = {"front_left": "left", "front_right": "right"}
    (document,) = yaml.safe_load((CONFIG / "motors_paper.yaml").read_text()).values()
    motors = document["ros__parameters"]["motors"]
    document["ros__parameters"]["motors"] = {to: motors[name] for name, to in names.items()}
    gains = yaml.safe_load((CONFIG / "gains.yaml").read_text())
    tree = {f"/**/{to}/wheel_pid": gains[f"/**/{name}/wheel_pid"] for name, to in names.items()}
    files = folder / "motors_of_two.yaml", folder / "gains_of_two.yaml"
    files[0].write_text(yaml.safe_dump({"/**/motor_plant": document}))
    files[1].write_text(yaml.safe_dump(tree))
    return files


class DomainNode:
    """Node, context and executor, made and ended together."""

    def __init__(self, domain: int, name: str) -> None:
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context, domain_id=domain)
        self.node = rclpy.create_node(name, context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self._clients: dict[str, Any] = {}

    def spin(self) -> None:
        self.executor.spin_once(timeout_sec=0.005)

    def hear(self, topic: str, kind: type) -> list[Any]:
        """Return the messages of a topic, those sent earlier and kept for late readers first."""
        heard: list[Any] = []
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(kind, topic, heard.append, latched)
        return heard

    def spin_for(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.spin()

    def set(self, node: str, **values: object) -> tuple[bool, str]:
        """Set parameters atomically; names have __ for a dot."""
        parameters = [
            Parameter(name.replace("__", "."), value=value).to_parameter_msg()
            for name, value in values.items()
        ]
        request = SetParametersAtomically.Request(parameters=parameters)
        name = f"/{node}/set_parameters_atomically"
        result = self._call(SetParametersAtomically, name, request).result
        return result.successful, result.reason

    def _call(self, kind: object, name: str, request: object) -> object:
        # Clients are stored, as each new one must be discovered again.
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
        client = self._clients[name]
        assert client.wait_for_service(10.0)
        future = client.call_async(request)
        end = time.monotonic() + 10.0
        while not future.done() and time.monotonic() < end:
            self.spin()
        if not future.done():
            pytest.fail(f"{name} does not answer")
        return future.result()

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@contextlib.contextmanager
def spinning(spin: Callable[[], object]) -> Iterator[None]:
    """Call ``spin`` over and over in a thread."""
    ended = threading.Event()

    def run() -> None:
        while not ended.is_set():
            spin()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


class Relay:
    """Relays one wheel's feedback, unchanged or with an injected fault."""

    def __init__(self, robot, wheel):
        self.robot = robot
        self.fault: Callable[[MotorState], Sequence[MotorState]] = lambda message: [message]
        self.delayed: list[tuple[float, MotorState]] = []
        self.publisher = robot.node.create_publisher(MotorState, f"/{wheel}/motor_state", 10)
        robot.node.create_subscription(MotorState, f"/{wheel}/raw_state", self.take, STREAM)

    def take(self, message: MotorState) -> None:
        self.robot.states["raw"].append(message)
        for one in self.fault(message):
            self.publisher.publish(one)

    def passes(self) -> None:
        self.fault = lambda message: [message]

    def changes(self, **fields: object) -> None:
        """Overwrite fields; a callable computes the new value from the old."""

        def change(message: MotorState) -> list[MotorState]:
            changed = copy.deepcopy(message)
            for name, value in fields.items():
                old = getattr(message, name)
                setattr(changed, name, value(old) if callable(value) else value)
            return [changed]

        self.fault = change

    def freezes(self) -> None:
        """Repeat count, position and velocity of the first sample under new stamps."""
        first: list[MotorState] = []

        def frozen(message: MotorState) -> list[MotorState]:
            first.append(message) if not first else None
            same = copy.deepcopy(first[0])
            same.header.stamp = message.header.stamp
            same.velocity, same.current = 0.0, message.current
            return [same]

        self.fault = frozen

    def delays(self, seconds: float) -> None:
        queue: list[tuple[float, MotorState]] = []

        def late(message: MotorState) -> list[MotorState]:
            now = time.monotonic()
            queue.append((now + seconds, message))
            ripe = [m for due, m in queue if due <= now]
            del queue[: len(ripe)]
            return ripe

        self.fault = late

    def shifts_stamps(self, seconds: float) -> None:
        def shifted(message: MotorState) -> list[MotorState]:
            moved = copy.deepcopy(message)
            total = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            total += round(seconds * 1e9)
            moved.header.stamp.sec, moved.header.stamp.nanosec = divmod(total, 10**9)
            return [moved]

        self.fault = shifted


class WheelRobot(DomainNode):
    """Publishes set-points while spinning and stores the wheels' states in a namespace."""

    def __init__(self, domain: int, space: str = "") -> None:
        super().__init__(domain, "robot")
        self.states: dict[str, list[MotorState]] = {w: [] for w in (*WHEELS, "raw")}
        self.commands: dict[str, list[MotorCommand]] = {w: [] for w in WHEELS}
        self.pid_states: list[PidState] = []
        self.diagnoses: list[tuple[float, str, bytes, str]] = []
        self.setpoint: float | None = None
        self._sent = 0.0
        node = self.node
        for wheel in WHEELS:
            kept = self.states[wheel].append
            node.create_subscription(MotorState, f"{space}/{wheel}/motor_state", kept, STREAM)
            sent = self.commands[wheel].append
            node.create_subscription(MotorCommand, f"{space}/{wheel}/motor_command", sent, STREAM)
        node.create_subscription(PidState, "/front_left/pid_state", self.pid_states.append, STREAM)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._diagnosed, 100)
        self.setpoints = node.create_publisher(JointState, f"{space}/wheel_setpoints", 10)
        self.feedback = {}
        self.load = node.create_publisher(Float64, "/front_left/load_torque", 10)

    def _diagnosed(self, array: DiagnosticArray) -> None:
        now = time.monotonic()
        self.diagnoses += [(now, s.name, s.level, s.message) for s in array.status]

    def spin(self) -> None:
        now = time.monotonic()
        if self.setpoint is not None and now - self._sent > PERIOD:
            self._sent = now
            self.send_setpoint(self.setpoint)
        self.executor.spin_once(timeout_sec=0.005)

    def send_setpoint(self, velocity: float, wheels: Sequence[str] = WHEELS) -> None:
        message = JointState(
            name=[f"{w}_wheel_joint" for w in wheels], velocity=[float(velocity)] * len(wheels)
        )
        message.header.stamp = self.node.get_clock().now().to_msg()
        self.setpoints.publish(message)

    def feed(self, wheel: str, stamp: int, **fields: object) -> None:
        """Publish feedback of one wheel stamped ``stamp`` [ns]."""
        if wheel not in self.feedback:
            self.feedback[wheel] = self.node.create_publisher(
                MotorState, f"/{wheel}/motor_state", 10
            )
        message = MotorState(**{"current": math.nan, **fields})
        message.header.frame_id = f"{wheel}_wheel_joint"
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        self.feedback[wheel].publish(message)

    def velocity(self, wheel: str, samples: int = 20) -> float:
        """Return the mean speed over the last samples, by position; NaN while there are too few."""
        last = self.states[wheel][-samples:]
        if len(last) < samples:
            return math.nan
        stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in last]
        return (last[-1].position - last[0].position) / (stamps[-1] - stamps[0])

    def named(self, node: str, text: str, since: float = 0.0) -> bool:
        """Return whether a node has reported a text on /diagnostics since an instant."""
        return any(t >= since and n == node and text in m for t, n, _, m in self.diagnoses)

    def last_diagnosis(self, node: str) -> str:
        return next((m for _, n, _, m in reversed(self.diagnoses) if n == node), "")

    def transition(self, node: str, name: str) -> bool:
        number = getattr(Transition, f"TRANSITION_{name.upper()}")
        request = ChangeState.Request(transition=Transition(id=number))
        return bool(self._call(ChangeState, f"/{node}/change_state", request).success)

    def trigger(self, node: str, service: str) -> str:
        """Call a ``std_srvs/Trigger`` of a node; return its message."""
        return str(self._call(Trigger, f"/{node}/{service}", Trigger.Request()).message)
