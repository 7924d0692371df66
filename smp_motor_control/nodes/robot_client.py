"""The one client of a running robot: its wheels, services, parameters, lifecycle and graph.

A tool holds it as a block.  Names are relative to the robot's namespace, which ROS arguments
give (``--ros-args -r __ns:=/robot1``).  What the client pauses or puts on trial is given back
when the block ends; :mod:`smp_motor_control.nodes.guard` does it where the tool was killed.
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
from smp_motor_control import controller_of
from smp_motor_control.errors import SmpError
from smp_motor_control.nodes.executor import LeanExecutor
from smp_motor_control.nodes.guard import Guard
from smp_motor_control.nodes.publishers import UNKNOWN, PublisherWatch, are_known, two_publishers
from smp_motor_control.nodes.runtime import LATCHED, STREAM_SUBSCRIBER, seconds, steady_timer

PATIENCE = 10.0
"""Longest wait for a service or a topic [s]; on a busy machine discovery takes seconds."""

AGAIN = 0.25
"""Time in which a service answers, or is asked again [s]: an answer is lost where the node has
not yet discovered this client, so no request may do harm twice."""

LOOK = 0.02  # interval at which a condition is looked at [s]
ENOUGH = 30  # states of a wheel that tell whether one node publishes them
DISCOVERY = 1.0  # time in which a free machine discovers what is there [s]
GET, SET = "get_parameters", "set_parameters_atomically"

_AFTER = {"configure": "inactive", "activate": "active", "deactivate": "inactive"}


class RobotError(SmpError):
    """What the robot did not answer or refused, in a line for the user."""

    exit_code = 1


class RobotClient:
    """A node beside the robot's, spun only while one of its methods waits."""

    def __init__(
        self, arguments: Sequence[str] = (), name: str = "robot_client", guarded: bool = True
    ) -> None:
        self._arguments, self._name, self._guarded = list(arguments), name, guarded
        self._clients: dict[str, Any] = {}
        self.owed: dict[str, Any] = {}
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
        steady_timer(self.node, LOOK, lambda: None)  # wakes the executor
        return self

    def __exit__(self, *_: object) -> None:
        """Give back what is owed, and leave; the guard does what fails here."""
        try:
            with contextlib.suppress(SmpError):
                self.give_back(self.owed)
                self.owe()
        finally:
            if self._guard is not None:
                self._guard.close()
            self._executor.shutdown()
            self.node.destroy_node()
            rclpy.try_shutdown(context=self._context)

    # Waiting -------------------------------------------------------------------------------

    def until(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Spin until a condition holds; return whether it did in time [s]."""
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
        """Hand messages to callables, by topic, inside the block."""
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
        """Hand messages of a topic of every wheel to a callable, behind the wheel's name.

        A callable of three arguments gets what the middleware knows of the message, too.
        """
        topics = {f"{wheel}/{topic}": partial(take, wheel) for wheel in wheels}
        return self.listen(kind, topics, quality)

    def find_wheels(self) -> list[str]:
        """Return the wheels whose hardware reports in the robot's namespace, after a second."""
        self.spin(DISCOVERY)
        pattern = re.compile(re.escape(self._full("")) + r"(\w+)/motor_state")
        topics = [name for name, _ in self.node.get_topic_names_and_types()]
        return [found[1] for name in sorted(topics) if (found := pattern.fullmatch(name))]

    def wait_for_wheels(self, wheels: Sequence[str], timeout: float) -> dict[str, float]:
        """Wait until every wheel has reported for half a second; return their rates [Hz].

        Wheels that two publishers report, and reports without a stamp, are errors.
        """
        stamps: dict[str, list[float]] = {wheel: [] for wheel in wheels}
        watches = {wheel: PublisherWatch() for wheel in wheels}

        def take(wheel: str, message: MotorState, info: Mapping[str, Any]) -> None:
            watches[wheel].hear(info)
            stamp = seconds(message.header.stamp)
            if not stamp:
                raise RobotError(
                    f"{self._full(wheel)}/motor_state has no stamp; its driver must fill in the "
                    "instant of sampling"
                )
            stamps[wheel].append(stamp)

        with self.listen_to_wheels(MotorState, "motor_state", wheels, take):
            heard = self.until(
                lambda: all(seen and seen[-1] - seen[0] > 0.5 for seen in stamps.values()), timeout
            )
        self._refuse_doubled(watches)
        if not heard:
            silent = [wheel for wheel, seen in stamps.items() if not seen or seen[-1] == seen[0]]
            topic = ", ".join(self._full(f"{wheel}/motor_state") for wheel in silent or wheels)
            raise RobotError(
                f"nothing heard on {topic} within {timeout:.0f} s; does the hardware's driver run?"
            )
        return {w: (len(s) - 1) / (s[-1] - s[0]) for w, s in stamps.items()}

    def refuse_second_reporters(self, wheels: Iterable[str]) -> None:
        """Raise where two nodes publish the state of one wheel, and name both."""
        watches = {wheel: PublisherWatch() for wheel in wheels}
        heard = dict.fromkeys(watches, 0)

        def take(wheel: str, message: MotorState, info: Mapping[str, Any]) -> None:
            watches[wheel].hear(info)
            heard[wheel] += 1

        def decided() -> bool:
            seen = min(heard.values(), default=ENOUGH) >= ENOUGH
            return seen or any(one.doubled for one in watches.values())

        with self.listen_to_wheels(MotorState, "motor_state", watches, take):
            self.until(decided, DISCOVERY)
        self._refuse_doubled(watches)

    def _refuse_doubled(self, watches: Mapping[str, PublisherWatch]) -> None:
        topics = [f"{wheel}/motor_state" for wheel, one in watches.items() if one.doubled]
        if topics:
            self.until(lambda: all(are_known(self.node, one) for one in topics), DISCOVERY)
            raise RobotError("; ".join(two_publishers(self.node, topic) for topic in topics))

    def runs_controller(self, wheel: str) -> bool:
        """Tell whether a wheel's ``wheel_pid`` has been discovered."""
        service = self.node.resolve_service_name(f"{controller_of(wheel)}/change_state")
        return bool(self.node.count_services(service))

    def wait_for_nodes(self, nodes: Sequence[str], timeout: float) -> None:
        """Wait until every node can be asked for its parameters."""
        for node in nodes:
            if not self.until(
                self._client(SetParametersAtomically, f"{node}/{SET}").service_is_ready, timeout
            ):
                raise RobotError(f"{self._full(node)} does not answer within {timeout:.0f} s")

    def wait_for_listener(self, node: str, topics: Sequence[str], timeout: float) -> None:
        """Wait until a node subscribes all of the topics."""
        look = self.node.get_subscriptions_info_by_topic

        def missing() -> list[str]:
            return [t for t in topics if node not in {i.node_name for i in look(self._full(t))}]

        if not self.until(lambda: not missing(), timeout):
            raise RobotError(f"{node} does not listen to {', '.join(missing())}")

    # Services ------------------------------------------------------------------------------

    def _full(self, name: str) -> str:
        return f"{self.node.get_namespace().rstrip('/')}/{name}"

    def _client(self, kind: Any, name: str) -> Any:
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
        return self._clients[name]

    def ask_all(
        self, kind: Any, requests: Mapping[str, Any], patience: float = PATIENCE
    ) -> dict[str, Any]:
        """Ask services at once; return the answers by the services' names."""
        clients = {name: self._client(kind, name) for name in requests}
        asked: dict[str, list[Any]] = {name: [] for name in requests}

        def answered(name: str) -> bool:
            return any(future.done() for future in asked[name])

        end = time.monotonic() + patience
        while not all(map(answered, requests)) and time.monotonic() < end:
            for name, request in requests.items():
                if not answered(name) and clients[name].service_is_ready():
                    asked[name].append(clients[name].call_async(request))
            self.until(lambda: all(map(answered, requests)), min(AGAIN, end - time.monotonic()))
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
        """Return the parameters of nodes by name; those that are not set are left out."""
        requests = {f"{n}/{GET}": GetParameters.Request(names=list(p)) for n, p in nodes.items()}
        answers = self.ask_all(GetParameters, requests)
        found: dict[str, dict[str, Any]] = {}
        for node, names in nodes.items():
            pairs = zip(names, answers[f"{node}/{GET}"].values, strict=False)
            there = [(n, v) for n, v in pairs if v.type != ParameterType.PARAMETER_NOT_SET]
            found[node] = {name: parameter_value_to_python(value) for name, value in there}
        return found

    def set_parameters(
        self, nodes: Mapping[str, Mapping[str, Any]], patience: float = PATIENCE
    ) -> None:
        """Set parameters of nodes, all of a node at once or none."""
        requests = {}
        for node, values in nodes.items():
            given = [Parameter(n, value=v).to_parameter_msg() for n, v in values.items()]
            requests[f"{node}/{SET}"] = SetParametersAtomically.Request(parameters=given)
        answers = self.ask_all(SetParametersAtomically, requests, patience)
        results = {node: answers[f"{node}/{SET}"].result for node in nodes}
        why = {node: result.reason for node, result in results.items() if not result.successful}
        if why:
            refused = (f"{self._full(n)} refused the parameters: {r}" for n, r in why.items())
            raise RobotError("; ".join(refused))

    def get_states(self, nodes: Sequence[str]) -> dict[str, str]:
        """Return the state of lifecycle nodes, such as ``active``."""
        answers = self.ask_all(GetState, {f"{n}/get_state": GetState.Request() for n in nodes})
        return {node: answers[f"{node}/get_state"].current_state.label for node in nodes}

    def change_states(self, nodes: Sequence[str], transition: str) -> None:
        """Have lifecycle nodes go through a transition: ``configure``, ``activate``, ...

        The state decides and not the answer: asked again, a node that is there already refuses.
        """
        number = getattr(Transition, f"TRANSITION_{transition.upper()}")
        request = ChangeState.Request(transition=Transition(id=number))
        left, states = list(nodes), {}
        for _ in range(3):
            if left:
                self.ask_all(ChangeState, {f"{node}/change_state": request for node in left})
                states = self.get_states(left)
                left = [node for node in left if states[node] != _AFTER[transition]]
        if left:
            said = ", ".join(f"{self._full(node)} ({states[node]})" for node in left)
            raise RobotError(f"refused to {transition}: {said}")

    # What is owed --------------------------------------------------------------------------

    def owe(self, **owed: Any) -> None:
        """Note what is to be given back, before it is taken: ``active`` nodes, ``gains``."""
        self.owed = owed
        if self._guarded and self._guard is None and owed:
            self._guard = Guard(self._arguments)
        if self._guard is not None:
            self._guard.note(owed)

    def give_back(self, owed: Mapping[str, Any]) -> None:
        """Set gains as they were and activate the controllers that were active."""
        if owed.get("gains"):
            self.set_parameters(owed["gains"])
        if owed.get("active"):
            wheels = [node.partition("/")[0] for node in owed["active"]]
            # Who excites them ends too: never two that command one wheel.
            self.until(lambda: not any(map(self.strangers, wheels)), 2.0)
            self.change_states(owed["active"], "activate")

    def strangers(self, wheel: str) -> list[str]:
        """Return who commands a wheel, beside its controller and this client."""
        known = {"wheel_pid", self._name}
        return [name for name in self._commanders(wheel) if name not in known]

    def _commanders(self, wheel: str) -> list[str]:
        topic = self._full(f"{wheel}/motor_command")
        return [info.node_name for info in self.node.get_publishers_info_by_topic(topic)]

    @contextlib.contextmanager
    def paused(self, wheels: Sequence[str]) -> Any:
        """Deactivate the wheels' active controllers inside the block, and see the wheels free."""
        owners: dict[str, str] = {}

        def take(wheel: str, message: String) -> None:
            owners[wheel] = message.data

        with self.listen_to_wheels(String, "motor_owner", wheels, take, LATCHED):
            # What is discovered together with the wheel is not so at one instant.
            self.spin(DISCOVERY)
            self.until(lambda: all(self._found(w, w in owners) for w in wheels), PATIENCE)
            for wheel in wheels:
                if rival := self.strangers(wheel):
                    raise RobotError(
                        f"{self._full(wheel)}/motor_command: {', '.join(rival)} commands the "
                        "wheel, and is no wheel_pid that can be paused; end it first"
                    )
            nodes = [controller_of(w) for w in wheels if self._controlled(w, owners.get(w, ""))]
            active = [node for node, state in self.get_states(nodes).items() if state == "active"]
            self.owe(active=active)
            self.change_states(active, "deactivate")
            # The driver's word: whoever commands a wheel holds it until its lease ends.
            if not self.until(lambda: not any(owners.values()), PATIENCE):
                held = ", ".join(f"{self._full(w)} by {name}" for w, name in owners.items() if name)
                raise RobotError(f"still driven after {PATIENCE:g} s: {held}; end it first")
        try:
            yield
        finally:
            self.give_back(self.owed)
            self.owe()

    def _found(self, wheel: str, owner_known: bool) -> bool:
        """Whether discovery is whole: every writer has its name, and the driver said who drives."""
        if UNKNOWN in self._commanders(wheel):
            return False
        return owner_known or self.node.count_publishers(f"{wheel}/motor_owner") == 0

    def _controlled(self, wheel: str, owner: str) -> bool:
        """Whether a controller is there, by the graph or the driver."""
        return "wheel_pid" in self._commanders(wheel) or "/wheel_pid#" in owner
