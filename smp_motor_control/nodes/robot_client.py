# SPDX-License-Identifier: Apache-2.0
"""Client of a running robot: wheels, services, parameters, lifecycle and graph.

It is used as a context manager.  Names are relative to the robot's namespace, which the ROS
arguments set (``--ros-args -r __ns:=/robot1``).  Paused controllers and gains on trial are restored
at the end of the block, or by :mod:`smp_motor_control.nodes.guard` if the tool is killed.
"""

import contextlib
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String

from smp_interfaces.msg import MotorState
from smp_motor_control import get_controller_name
from smp_motor_control.errors import SmpError
from smp_motor_control.nodes.executor import LeanExecutor
from smp_motor_control.nodes.guard import Guard
from smp_motor_control.nodes.publishers import (
    UNKNOWN_NODE,
    PublisherWatch,
    are_publishers_known,
    describe_two_publishers,
)
from smp_motor_control.nodes.runtime import LATCHED, STREAM_SUBSCRIBER, seconds, steady_timer

TIMEOUT_S = 10.0  # time-out of services and topics; on a busy machine discovery takes seconds

RETRY_PERIOD_S = 0.25
"""Period at which a request is repeated, as the answer is lost if the node has not yet discovered
this client; requests must be idempotent."""

POLL_PERIOD_S = 0.02
DISCOVERY_S = 1.0  # discovery time on an idle machine
MAX_SEARCHES, EQUAL_SEARCHES = 15, 4
"""Largest number of searches for wheels, and equal results in a row that end them."""

HALT_S = 1.5  # halt after which the last commands of others have timed out
GET, SET = "get_parameters", "set_parameters_atomically"

_RESULTING_STATE = {"configure": "inactive", "activate": "active", "deactivate": "inactive"}


class RobotError(SmpError):
    """The robot refused a request or did not answer."""

    exit_code = 1


class RobotClient:
    """Node that is spun only while one of its methods waits."""

    def __init__(
        self, arguments: Sequence[str] = (), name: str = "robot_client", guarded: bool = True
    ) -> None:
        self._arguments, self._name, self._guarded = list(arguments), name, guarded
        self._clients: dict[str, Any] = {}
        self.pending_restore: dict[str, Any] = {}
        self._guard: Guard | None = None

    def __enter__(self) -> "RobotClient":
        """Join the graph."""
        self._context = Context()
        rclpy.init(
            args=[self._name, *self._arguments],
            context=self._context,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.node = rclpy.create_node(self._name, context=self._context)
        self._executor = LeanExecutor(context=self._context)
        self._executor.add_node(self.node)
        steady_timer(self.node, POLL_PERIOD_S, lambda: None)  # wakes the executor
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the pending state and leave; the guard does what fails here."""
        try:
            with contextlib.suppress(SmpError):
                self.restore(self.pending_restore)
                self.set_pending_restore()
        finally:
            if self._guard is not None:
                self._guard.close()
            self._executor.shutdown()
            self.node.destroy_node()
            rclpy.try_shutdown(context=self._context)

    def until(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Spin until a condition holds; return False at the time-out [s]."""
        end = time.monotonic() + timeout
        while not condition():
            if time.monotonic() >= end or not self._context.ok():
                return False
            self._executor.spin_once()
        return True

    def spin(self, duration: float) -> None:
        self.until(lambda: False, duration)

    @contextlib.contextmanager
    def listen(
        self,
        kind: Any,
        topics: Mapping[str, Callable[[Any], None]],
        quality: QoSProfile = STREAM_SUBSCRIBER,
    ) -> Any:
        """Pass messages to callables by topic inside the block."""
        listen = self.node.create_subscription
        made = [listen(kind, topic, take, quality) for topic, take in topics.items()]
        try:
            yield
        finally:
            for subscription in made:
                self.node.destroy_subscription(subscription)

    def listen_to_wheels(
        self,
        kind: Any,
        topic: str,
        wheels: Iterable[str],
        take: Callable[..., object],
        quality: QoSProfile = STREAM_SUBSCRIBER,
    ) -> Any:
        """Call ``take(wheel, message)`` for a topic of every wheel inside the block.

        A callable with three arguments also gets the message's info.
        """
        topics = {f"{wheel}/{topic}": partial(take, wheel) for wheel in wheels}
        return self.listen(kind, topics, quality)

    def find_wheels(self) -> tuple[str, ...]:
        """Return the wheels whose hardware is discovered in the robot's namespace.

        On a busy machine they are discovered seconds apart: wait until no further one appears.
        """
        pattern = re.compile(re.escape(self._absolute_name("")) + r"(\w+)/motor_state")
        found: list[tuple[str, ...]] = []
        while len(found) < MAX_SEARCHES:
            self.spin(DISCOVERY_S)
            topics = sorted(name for name, _ in self.node.get_topic_names_and_types())
            found.append(tuple(match[1] for name in topics if (match := pattern.fullmatch(name))))
            if found[-1] and found[-EQUAL_SEARCHES:] == [found[-1]] * EQUAL_SEARCHES:
                break
        return found[-1]

    def wait_for_wheels(self, wheels: Sequence[str], timeout: float) -> dict[str, float]:
        """Wait until every wheel has reported for half a second; return their rates [Hz].

        Two publishers of a wheel and reports without a stamp are errors.
        """
        stamps: dict[str, list[float]] = {wheel: [] for wheel in wheels}
        watches = {wheel: PublisherWatch() for wheel in wheels}

        def take(wheel: str, message: MotorState, info: Mapping[str, Any]) -> None:
            watches[wheel].hear(info)
            stamp = seconds(message.header.stamp)
            if not stamp:
                raise RobotError(
                    f"{self._absolute_name(wheel)}/motor_state has no stamp; its driver must set "
                    "the time of sampling"
                )
            stamps[wheel].append(stamp)

        with self.listen_to_wheels(MotorState, "motor_state", wheels, take):
            heard = self.until(
                lambda: all(seen and seen[-1] - seen[0] > 0.5 for seen in stamps.values()), timeout
            )
        self._refuse_two_publishers(watches)
        if not heard:
            silent = [wheel for wheel, seen in stamps.items() if not seen or seen[-1] == seen[0]]
            topic = ", ".join(
                self._absolute_name(f"{wheel}/motor_state") for wheel in silent or wheels
            )
            raise RobotError(
                f"no message on {topic} within {timeout:.0f} s; is the hardware's driver running?"
            )
        return {w: (len(s) - 1) / (s[-1] - s[0]) for w, s in stamps.items()}

    def _refuse_two_publishers(self, watches: Mapping[str, PublisherWatch]) -> None:
        topics = [
            f"{wheel}/motor_state" for wheel, one in watches.items() if one.has_two_publishers
        ]
        if topics:
            self.until(
                lambda: all(are_publishers_known(self.node, one) for one in topics), DISCOVERY_S
            )
            raise RobotError(
                "; ".join(describe_two_publishers(self.node, topic) for topic in topics)
            )

    def runs_controller(self, wheel: str) -> bool:
        """Return whether a wheel's ``wheel_pid`` is discovered."""
        service = self.node.resolve_service_name(f"{get_controller_name(wheel)}/change_state")
        return bool(self.node.count_services(service))

    def wait_for_nodes(self, nodes: Sequence[str], timeout: float) -> None:
        """Wait for the parameter services of all nodes."""
        for node in nodes:
            if not self.until(
                self._client(SetParametersAtomically, f"{node}/{SET}").service_is_ready, timeout
            ):
                raise RobotError(
                    f"{self._absolute_name(node)} does not answer within {timeout:.0f} s; is it "
                    "running?"
                )

    def wait_for_listener(self, node: str, topics: Sequence[str], timeout: float) -> None:
        """Wait until a node subscribes to all topics."""
        look = self.node.get_subscriptions_info_by_topic

        def missing() -> list[str]:
            return [
                t for t in topics if node not in {i.node_name for i in look(self._absolute_name(t))}
            ]

        if not self.until(lambda: not missing(), timeout):
            raise RobotError(f"{node} does not subscribe to {', '.join(missing())}; is it running?")

    def _absolute_name(self, name: str) -> str:
        return f"{self.node.get_namespace().rstrip('/')}/{name}"

    def _client(self, kind: Any, name: str) -> Any:
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
        return self._clients[name]

    def call_services(
        self, kind: Any, requests: Mapping[str, Any], patience: float = TIMEOUT_S
    ) -> dict[str, Any]:
        """Call services concurrently; return the answers by service name."""
        clients = {name: self._client(kind, name) for name in requests}
        asked: dict[str, list[Any]] = {name: [] for name in requests}

        def answered(name: str) -> bool:
            return any(future.done() for future in asked[name])

        end = time.monotonic() + patience
        while not all(map(answered, requests)) and time.monotonic() < end:
            for name, request in requests.items():
                if not answered(name) and clients[name].service_is_ready():
                    asked[name].append(clients[name].call_async(request))
            self.until(
                lambda: all(map(answered, requests)), min(RETRY_PERIOD_S, end - time.monotonic())
            )
        for name, futures in asked.items():
            for future in futures:
                if not future.done():
                    clients[name].remove_pending_request(future)
        missing = [name for name in requests if not answered(name)]
        if missing:
            there = all(asked[name] for name in missing)
            what = "no answer" if there else "no such service"
            owners = sorted({name.rpartition("/")[0].rpartition("/")[2] for name in missing})
            hint = "" if there else f"; is {', '.join(owners)} running?"
            names = ", ".join(clients[name].srv_name for name in missing)
            raise RobotError(f"{names}: {what} within {patience:g} s{hint}")
        return {n: next(f for f in asked[n] if f.done()).result() for n in requests}

    def get_parameters(self, nodes: Mapping[str, Sequence[str]]) -> dict[str, dict[str, Any]]:
        """Return the parameters of nodes by name, without those that are not set."""
        requests = {f"{n}/{GET}": GetParameters.Request(names=list(p)) for n, p in nodes.items()}
        answers = self.call_services(GetParameters, requests)
        found: dict[str, dict[str, Any]] = {}
        for node, names in nodes.items():
            pairs = zip(names, answers[f"{node}/{GET}"].values, strict=False)
            there = [(n, v) for n, v in pairs if v.type != ParameterType.PARAMETER_NOT_SET]
            found[node] = {name: parameter_value_to_python(value) for name, value in there}
        return found

    def set_parameters(
        self, nodes: Mapping[str, Mapping[str, Any]], patience: float = TIMEOUT_S
    ) -> None:
        """Set parameters of nodes, atomically for each node."""
        requests = {}
        for node, values in nodes.items():
            given = [Parameter(n, value=v).to_parameter_msg() for n, v in values.items()]
            requests[f"{node}/{SET}"] = SetParametersAtomically.Request(parameters=given)
        answers = self.call_services(SetParametersAtomically, requests, patience)
        results = {node: answers[f"{node}/{SET}"].result for node in nodes}
        why = {node: result.reason for node, result in results.items() if not result.successful}
        if why:
            refused = (
                f"{self._absolute_name(n)} refused the parameters: {r}" for n, r in why.items()
            )
            raise RobotError("; ".join(refused))

    def get_states(self, nodes: Sequence[str]) -> dict[str, str]:
        """Return the states of lifecycle nodes, such as ``active``."""
        answers = self.call_services(
            GetState, {f"{n}/get_state": GetState.Request() for n in nodes}
        )
        return {node: answers[f"{node}/get_state"].current_state.label for node in nodes}

    def change_states(self, nodes: Sequence[str], transition: str) -> None:
        """Perform a transition of lifecycle nodes: ``configure``, ``activate``, ...

        Success is judged by the state: a node that has already made the transition refuses it.
        """
        number = getattr(Transition, f"TRANSITION_{transition.upper()}")
        request = ChangeState.Request(transition=Transition(id=number))
        left, states = list(nodes), {}
        for _ in range(3):
            if left:
                self.call_services(ChangeState, {f"{node}/change_state": request for node in left})
                states = self.get_states(left)
                left = [node for node in left if states[node] != _RESULTING_STATE[transition]]
        if left:
            listed = ", ".join(f"{self._absolute_name(node)} ({states[node]})" for node in left)
            raise RobotError(f"refused to {transition}: {listed}")

    def set_pending_restore(self, **pending_restore: Any) -> None:
        """Note the state to restore, before it is changed.

        ``halt`` names controllers to deactivate first, ``gains`` parameters of nodes, ``active``
        the controllers to activate.
        """
        self.pending_restore = pending_restore
        if self._guarded and self._guard is None and pending_restore:
            self._guard = Guard(self._arguments)
        if self._guard is not None:
            self._guard.note(pending_restore)

    def prepare(self, pending_restore: Mapping[str, Any]) -> None:
        """Connect to the controllers that :meth:`restore` halts; discovery takes time."""
        for name in _deactivation_requests(pending_restore):
            self._client(ChangeState, name)

    def restore(self, pending_restore: Mapping[str, Any]) -> None:
        """Halt the wheels, set the previous gains and activate the controllers that were active."""
        if pending_restore.get("halt"):
            with contextlib.suppress(RobotError):  # a missing controller must not prevent the rest
                self.call_services(ChangeState, _deactivation_requests(pending_restore), HALT_S)
            self.spin(HALT_S)
        if pending_restore.get("gains"):
            self.set_parameters(pending_restore["gains"])
        if pending_restore.get("active"):
            wheels = [node.partition("/")[0] for node in pending_restore["active"]]
            # Wait until other commanding nodes have ended.
            self.until(lambda: not any(map(self.find_other_commanders, wheels)), 2.0)
            self.change_states(pending_restore["active"], "activate")

    def find_other_commanders(self, wheel: str) -> list[str]:
        """Return the nodes that command a wheel, without its controller and this client."""
        known = {"wheel_pid", self._name}
        return [name for name in self._commanders(wheel) if name not in known]

    def _commanders(self, wheel: str) -> list[str]:
        topic = self._absolute_name(f"{wheel}/motor_command")
        return [info.node_name for info in self.node.get_publishers_info_by_topic(topic)]

    @contextlib.contextmanager
    def paused(self, wheels: Sequence[str]) -> Any:
        """Deactivate the wheels' controllers inside the block; ensure that they are free."""
        owners: dict[str, str] = {}

        def take(wheel: str, message: String) -> None:
            owners[wheel] = message.data

        with self.listen_to_wheels(String, "motor_owner", wheels, take, LATCHED):
            # The endpoints of one node are discovered one after the other.
            self.spin(DISCOVERY_S)
            self.until(lambda: all(self._is_discovered(w, w in owners) for w in wheels), TIMEOUT_S)
            for wheel in wheels:
                if rival := self.find_other_commanders(wheel):
                    raise RobotError(
                        f"{self._absolute_name(wheel)}/motor_command: {', '.join(rival)} commands "
                        "the wheel and cannot be paused; end it first"
                    )
            # The graph or the driver shows which wheels have a controller.
            controlled = (
                wheel
                for wheel in wheels
                if "wheel_pid" in self._commanders(wheel) or "/wheel_pid#" in owners.get(wheel, "")
            )
            nodes = list(map(get_controller_name, controlled))
            active = [node for node, state in self.get_states(nodes).items() if state == "active"]
            self.set_pending_restore(active=active)
            try:
                self.change_states(active, "deactivate")
                # A node owns a wheel until its lease ends.
                if not self.until(lambda: not any(owners.values()), TIMEOUT_S):
                    held = ", ".join(
                        f"{self._absolute_name(w)} by {name}" for w, name in owners.items() if name
                    )
                    raise RobotError(f"still driven after {TIMEOUT_S:g} s: {held}; end it first")
            except RobotError:
                self.restore(self.pending_restore)
                self.set_pending_restore()
                raise
        try:
            yield
        finally:
            self.restore(self.pending_restore)
            self.set_pending_restore()

    def _is_discovered(self, wheel: str, owner_known: bool) -> bool:
        """Return whether all writers are named and the driver has published the owner."""
        if UNKNOWN_NODE in self._commanders(wheel):
            return False
        return owner_known or self.node.count_publishers(f"{wheel}/motor_owner") == 0


def _deactivation_requests(pending_restore: Mapping[str, Any]) -> dict[str, ChangeState.Request]:
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
    return {f"{node}/change_state": request for node in pending_restore.get("halt", ())}
