"""Does for a tool without ROS what needs ROS: one JSON request per line in, one answer out.

The tools ``demo`` and ``commission`` start it as a process of their own.  It ends when its
standard input does, so it cannot outlive the tool, and it sends a zero ``cmd_vel`` before.

===================== =============================================  ========================
request ``do``        with                                           answer
===================== =============================================  ========================
``wait_for_wheels``   ``wheels``, ``timeout`` [s]                    ``rates`` [Hz] by wheel
``wait_for_nodes``    ``nodes`` (full names), ``timeout`` [s]        nothing
``wait_for_listener`` ``node`` (name), ``topics``, ``timeout``       nothing
``change_state``      ``node``, ``transition`` (``activate``, ...)   nothing
``get_state``         ``node``, ``timeout`` [s]                      ``state``, empty if none
``set_parameters``    ``node``, ``parameters``                       nothing; all or none set
``get_parameters``    ``node``, ``names``                            ``parameters``
``drive``             ``segments`` of ``[name, m/s, rad/s, s]``      ``segments`` of ``[name,
                                                                     begin, end]`` [s, stamps]
===================== =============================================  ========================

An answer has ``error`` (one line) when the request could not be done.
"""

from __future__ import annotations

import contextlib
import json
import queue
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from smp_interfaces.msg import MotorState, PidState
from smp_motor_control.nodes.asking import SET, Asker, AskError

PERIOD = 0.02
"""Interval [s] between two ``cmd_vel`` messages while driving."""

_TRANSITIONS = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "cleanup": Transition.TRANSITION_CLEANUP,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
}


PATIENCE = 10.0
"""Longest wait for a service, and for wheels that shall follow [s]."""

LEAD = 1.0
"""Standstill that is commanded before a drive at least [s]."""


class RequestError(Exception):
    """A request that could not be done; the text goes back as the answer."""


class Conductor(Node):
    """Holds the publisher and the clients; every method is one request."""

    def __init__(self) -> None:
        super().__init__("conductor")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self._cmd_vel = self.create_publisher(TwistStamped, "/cmd_vel", 1)
        self._asker = Asker(self, self._until, PATIENCE)

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Do one request.

        Parameters
        ----------
        request : dict
            With ``do`` and what it needs.

        Returns
        -------
        dict
            The answer, ``error`` in it when it could not be done.
        """
        arguments = dict(request)
        name = arguments.pop("do", "")
        work = None if name.startswith("_") else getattr(self, f"do_{name}", None)
        if work is None:
            return {"error": f"no such request: {name!r}"}
        try:
            return work(**arguments) or {}
        except (RequestError, AskError) as error:
            return {"error": str(error)}
        except Exception as error:  # an answer must come, or the tool waits for ever
            return {"error": f"{name}: {type(error).__name__}: {error}"}

    def do_wait_for_wheels(self, wheels: Sequence[str], timeout: float) -> dict[str, Any]:
        """Wait until every wheel has reported its state for half a second."""
        stamps: dict[str, list[float]] = {wheel: [] for wheel in wheels}
        qos = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
        subscriptions = [
            self.create_subscription(
                MotorState,
                f"/{wheel}/motor_state",
                lambda message, seen=seen: seen.append(_seconds(message.header.stamp)),
                qos,
            )
            for wheel, seen in stamps.items()
        ]
        heard = self._until(
            lambda: all(seen and seen[-1] - seen[0] > 0.5 for seen in stamps.values()), timeout
        )
        for subscription in subscriptions:
            self.destroy_subscription(subscription)
        if not heard:
            silent = [wheel for wheel, seen in stamps.items() if not seen or seen[-1] == seen[0]]
            topics = ", ".join(f"/{wheel}/motor_state" for wheel in silent or wheels)
            raise RequestError(f"nothing heard on {topics} within {timeout:.0f} s")
        return {"rates": {w: (len(s) - 1) / (s[-1] - s[0]) for w, s in stamps.items()}}

    def do_wait_for_nodes(self, nodes: Sequence[str], timeout: float) -> None:
        """Wait until every node can be asked for its parameters."""
        for node in nodes:
            client = self._asker.client(SetParametersAtomically, f"{node}/{SET}")
            if not self._until(client.service_is_ready, timeout):
                raise RequestError(f"{node} does not answer within {timeout:.0f} s")

    def do_wait_for_listener(self, node: str, topics: Sequence[str], timeout: float) -> None:
        """Wait until a node subscribes all of the topics."""

        def missing() -> list[str]:
            return [
                topic
                for topic in topics
                if node not in {i.node_name for i in self.get_subscriptions_info_by_topic(topic)}
            ]

        if not self._until(lambda: not missing(), timeout):
            raise RequestError(f"{node} does not listen to {', '.join(missing())}")

    def do_change_state(self, node: str, transition: str) -> None:
        """Ask a lifecycle node for a transition."""
        request = ChangeState.Request(transition=Transition(id=_TRANSITIONS[transition]))
        # Asked once only: what was done already would be refused.
        name = f"{node}/change_state"
        if not self._asker.ask_all(ChangeState, {name: request}, again=PATIENCE)[name].success:
            raise RequestError(f"{node} refused to {transition}")

    def do_get_state(self, node: str, timeout: float) -> dict[str, Any]:
        """Return a lifecycle node's state; empty where there is no such node."""
        name = f"{node}/get_state"
        if not self._until(self._asker.client(GetState, name).service_is_ready, timeout):
            return {"state": ""}
        answer = self._asker.ask_all(GetState, {name: GetState.Request()})[name]
        return {"state": answer.current_state.label}

    def do_set_parameters(self, node: str, parameters: dict[str, Any]) -> None:
        """Set all parameters at once, or none."""
        self._asker.set_parameters({node: parameters})

    def do_get_parameters(self, node: str, names: Sequence[str]) -> dict[str, Any]:
        """Read parameters; those that are not set are left out."""
        return {"parameters": self._asker.get_parameters({node: names})[node]}

    def do_drive(
        self, segments: Sequence[tuple[str, float, float, float]], wheels: Sequence[str]
    ) -> dict[str, Any]:
        """Drive segment after segment, and stop at the end whatever happens."""
        if not self._until(lambda: self._cmd_vel.get_subscription_count() > 0, 10.0):
            raise RequestError("nobody listens on /cmd_vel: start skid_steer")
        times = []
        try:
            self._stand_until_followed(wheels)
            for name, linear, angular, duration in segments:
                begin = _seconds(self.get_clock().now().to_msg())
                self._drive_for(linear, angular, duration)
                times.append([name, begin, _seconds(self.get_clock().now().to_msg())])
        finally:
            self.stop()
        return {"segments": times}

    def _stand_until_followed(self, wheels: Sequence[str]) -> None:
        """Command standstill until the wheels hear it: who just joined is still being found."""
        heard: dict[str, float] = dict.fromkeys(wheels, 0.0)
        qos = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
        subscriptions = [
            self.create_subscription(
                PidState,
                f"/{wheel}/pid_state",
                lambda message, wheel=wheel: heard.update({wheel: time.monotonic()}),
                qos,
            )
            for wheel in wheels
        ]
        begin = time.monotonic()
        while time.monotonic() < begin + LEAD or min(heard.values()) < begin + LEAD:
            silent = [f"/{wheel}/pid_state" for wheel in wheels if heard[wheel] < begin + LEAD]
            if time.monotonic() > begin + PATIENCE:
                raise RequestError(f"standstill is commanded, but {', '.join(silent)} is silent")
            self._drive_for(0.0, 0.0, PERIOD)
        for subscription in subscriptions:
            self.destroy_subscription(subscription)

    def _drive_for(self, linear: float, angular: float, duration: float) -> None:
        end = time.monotonic() + duration
        while (now := time.monotonic()) < end:
            self._send(linear, angular)
            self._until(lambda: False, min(PERIOD, end - now))

    def stop(self) -> None:
        """Command standstill."""
        self._send(0.0, 0.0)

    def _send(self, linear: float, angular: float) -> None:
        message = TwistStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = "base_link"
        message.twist.linear.x, message.twist.angular.z = float(linear), float(angular)
        self._cmd_vel.publish(message)

    def _until(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Spin until the condition holds; return whether it did in time."""
        deadline = time.monotonic() + timeout
        while not condition():
            left = deadline - time.monotonic()
            if left <= 0 or not rclpy.ok():
                return False
            self._executor.spin_once(timeout_sec=min(left, 0.05))
        return True


def _seconds(stamp: Any) -> float:
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def main(argv: list[str] | None = None) -> int:
    """Answer requests from standard input until it ends.

    Parameters
    ----------
    argv : list of str or None
        ROS arguments.

    Returns
    -------
    int
        Exit code.
    """
    rclpy.init(args=argv)
    node = Conductor()
    lines: queue.Queue[str] = queue.Queue()

    def read() -> None:
        for line in sys.stdin:
            lines.put(line)
        lines.put("")

    threading.Thread(target=read, daemon=True).start()
    with contextlib.suppress(KeyboardInterrupt):
        while (line := lines.get()).strip():
            print(json.dumps(node.answer(json.loads(line))), flush=True)
    if rclpy.ok():
        node.stop()
        node.destroy_node()
        rclpy.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
