"""Sets gains in running wheel nodes, watches what they do, and takes them back if it is bad.

The tool ``tune --apply`` starts it as a process of its own: one JSON request per line in, one
answer out.  Whatever ends it while gains are on trial, end of input, a signal, an error, the
old gains come back first.

============  =======================================  ====================================
request       with                                     answer
============  =======================================  ====================================
``read``      ``wheels``: wheel to names               ``values``: wheel to name to value
``apply``     ``values``; ``watch`` [s];               ``kept`` (bool), ``reason``,
              ``supply`` [V]                           ``after`` [s] until taken back
============  =======================================  ====================================
"""

from __future__ import annotations

import itertools
import json
import math
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import rclpy
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python

from smp_interfaces.msg import PidState
from smp_motor_control.nodes.runtime import STREAM_SUBSCRIBER

BASELINE = 0.5
"""How long the old gains are watched first [s]."""

WINDOW = 0.4
"""Length of the stretch that is judged [s]; the first verdict comes that long after the change."""

SILENCE = 0.5
"""A loop that reports nothing for so long has stopped [s]."""

ANSWER = 0.5
"""Time in which a service answers, or is asked again [s]."""


class Trouble(Exception):
    """What is wrong, in a line for the user."""


class Watch:
    """Judges one wheel by its ``pid_state``.

    Parameters
    ----------
    supply : float
        [V].
    """

    def __init__(self, supply: float) -> None:
        self.supply = supply
        self.seen: deque[tuple[float, PidState]] = deque()
        self.usual_error = 0.0
        self.usual_swing = 0.0
        self.since = math.inf

    def take(self, message: PidState) -> None:
        """Remember a state, and forget those older than the window."""
        now = time.monotonic()
        self.seen.append((now, message))
        while now - self.seen[0][0] > max(WINDOW, BASELINE):
            self.seen.popleft()

    def begin(self) -> None:
        """Take what was seen as usual and start the trial."""
        states = [message for _, message in self.seen]
        self.usual_error = _rms([s.error for s in states])
        self.usual_swing = _swing([s.output for s in states])
        self.since = time.monotonic()

    def trouble(self) -> str | None:
        """Return what is wrong with the loop now, or None."""
        now = time.monotonic()
        last = self.seen[-1][0] if self.seen else self.since
        if now - max(last, self.since) > SILENCE:
            return f"it reported nothing for {SILENCE:g} s"
        states = [m for t, m in self.seen if t >= max(self.since, now - WINDOW)]
        if any(not math.isfinite(s.output + s.measurement) for s in states):
            return "its output or measurement is not a number"
        if now - self.since < WINDOW or len(states) < 4:
            return None
        return self._unstable(states)

    def _unstable(self, states: list[PidState]) -> str | None:
        swing = _swing([s.output for s in states])
        if swing > max(0.25 * self.supply, 3 * self.usual_swing):
            return f"its output swings by {swing:.2g} V from step to step"
        clamped = sum(s.saturated for s in states) / len(states)
        if clamped > 0.5:
            return f"its output is clamped {clamped:.0%} of the time"
        error = _rms([s.error for s in states])
        asked = max(abs(s.reference) for s in states)
        moved = max(s.reference for s in states) - min(s.reference for s in states)
        # While the reference moves the wheel follows late; that is no fault.
        if error > max(0.3 * asked + moved, 3 * self.usual_error, 0.1):
            return f"its speed is {error:.2g} rad/s off at {asked:.2g} rad/s"
        return None


def _rms(values: list[float]) -> float:
    return math.sqrt(sum(v * v for v in values) / len(values)) if values else 0.0


def _swing(values: list[float]) -> float:
    """Return the mean change from a step to the next [V]."""
    steps = [abs(b - a) for a, b in itertools.pairwise(values)]
    return sum(steps) / len(steps) if steps else 0.0


class GainSetter(Node):
    """Clients and subscriptions for the wheels; every ``do_`` method is a request."""

    def __init__(self) -> None:
        super().__init__("gain_setter")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self._old: dict[str, dict[str, Any]] = {}
        self._known_clients: dict[str, Any] = {}

    def do_read(self, wheels: Mapping[str, list[str]]) -> dict[str, Any]:
        """Read the parameters of every wheel; those that a node does not have are left out."""
        return {"values": {wheel: self._get(wheel, names) for wheel, names in wheels.items()}}

    def do_apply(
        self, values: Mapping[str, Mapping[str, Any]], watch: float, supply: float
    ) -> dict[str, Any]:
        """Set all wheels, watch, and take back when one of them misbehaves."""
        watches = {wheel: Watch(supply) for wheel in values}
        for wheel, one in watches.items():
            self.create_subscription(PidState, f"/{wheel}/pid_state", one.take, STREAM_SUBSCRIBER)
        old = {wheel: self._get(wheel, list(new)) for wheel, new in values.items()}
        self._until(lambda: all(w.seen for w in watches.values()), 5.0)
        silent = [wheel for wheel, one in watches.items() if not one.seen]
        if silent:
            raise Trouble(f"{', '.join(silent)}: no pid_state within 5 s; is wheel_pid active?")
        self._until(lambda: False, BASELINE)
        for one in watches.values():
            one.begin()
        begun = time.monotonic()
        self._old = old
        try:
            for wheel, new in values.items():
                self._set(wheel, new)
            reason = self._trial(watches, watch)
        except Trouble as trouble:
            reason = str(trouble)
        if reason is None:
            self._old = {}
            return {"kept": True, "reason": "", "after": None}
        self.take_back()
        return {"kept": False, "reason": reason, "after": time.monotonic() - begun}

    def _trial(self, watches: Mapping[str, Watch], seconds: float) -> str | None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._until(lambda: False, 0.02)
            for wheel, one in watches.items():
                trouble = one.trouble()
                if trouble is not None:
                    return f"{wheel}: {trouble}"
        return None

    def take_back(self) -> None:
        """Set what was there before, in every wheel that answers."""
        old, self._old = self._old, {}
        failed = []
        for wheel, values in old.items():
            try:
                self._set(wheel, values)
            except Trouble as trouble:
                failed.append(str(trouble))
        if failed:
            raise Trouble("the old gains could not be set again: " + "; ".join(failed))

    def _get(self, wheel: str, names: list[str]) -> dict[str, Any]:
        request = GetParameters.Request(names=names)
        values = self._call(GetParameters, f"/{wheel}/wheel_pid/get_parameters", request).values
        return {
            name: parameter_value_to_python(value)
            for name, value in zip(names, values, strict=False)
            if value.type != ParameterType.PARAMETER_NOT_SET
        }

    def _set(self, wheel: str, values: Mapping[str, Any]) -> None:
        request = SetParametersAtomically.Request(
            parameters=[Parameter(n, value=v).to_parameter_msg() for n, v in values.items()]
        )
        name = f"/{wheel}/wheel_pid/set_parameters_atomically"
        result = self._call(SetParametersAtomically, name, request).result
        if not result.successful:
            raise Trouble(f"{wheel}: wheel_pid refused the gains: {result.reason}")

    def _call(self, kind: Any, name: str, request: Any, timeout: float = 5.0) -> Any:
        if name not in self._known_clients:
            self._known_clients[name] = self.create_client(kind, name)
        client = self._known_clients[name]
        if not self._until(client.service_is_ready, timeout):
            raise Trouble(f"{name}: no such service within {timeout:g} s; is wheel_pid running?")
        # An answer is lost where the node has not yet discovered this client; asking again does
        # no harm.
        for _ in range(int(timeout / ANSWER)):
            future = client.call_async(request)
            if self._until(future.done, ANSWER):
                return future.result()
            client.remove_pending_request(future)
        raise Trouble(f"{name}: no answer within {timeout:g} s")

    def _until(self, condition: Callable[[], bool], timeout: float) -> bool:
        deadline = time.monotonic() + timeout
        while not condition():
            left = deadline - time.monotonic()
            if left <= 0 or not rclpy.ok():
                return False
            self._executor.spin_once(timeout_sec=min(left, 0.02))
        return True


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
    rclpy.init(args=argv, signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    node = GainSetter()
    requests = {"read": node.do_read, "apply": node.do_apply}
    try:
        for line in sys.stdin:
            request = json.loads(line)
            try:
                answer = requests[request.pop("do")](**request)
            except Trouble as trouble:
                answer = {"error": str(trouble)}
            print(json.dumps(answer), flush=True)
    except KeyboardInterrupt:
        return 130
    finally:
        node.take_back()
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
