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
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python

from smp_interfaces.msg import PidState
from smp_motor_control.nodes.executor import LeanExecutor
from smp_motor_control.nodes.runtime import STREAM_SUBSCRIBER, seconds, steady_timer

BASELINE = 0.5
"""How long the old gains are watched first [s]."""

WINDOW = 0.4
"""Length of the stretch that is judged [s]; the first verdict comes that long after the change."""

LOOK = 0.02
"""Interval at which the wheels are looked at [s]."""

SILENT_LOOKS = 25
"""A loop that reports nothing between so many looks has stopped: half a second, in which this
process itself was awake."""

STARVED = 10.0
"""A step that comes so many usual steps late ran without control meanwhile."""

ANSWER = 0.25
"""Time in which a service answers, or is asked again [s]."""

PATIENCE = 8.0
"""Longest wait for a service or a topic; on a busy machine discovery takes seconds [s]."""


_GET, _SET = "get_parameters", "set_parameters_atomically"


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
        self.usual_dt = math.inf
        self.since = math.inf
        self.looks = 0

    def take(self, message: PidState) -> None:
        """Remember a state, and forget those older than the window."""
        now = time.monotonic()
        self.looks = 0
        self.seen.append((now, message))
        while now - self.seen[0][0] > max(WINDOW, BASELINE):
            self.seen.popleft()

    def begin(self) -> None:
        """Take what was seen as usual and start the trial."""
        states = [message for _, message in self.seen]
        self.usual_error = _rms([s.error for s in states])
        self.usual_swing = _swing([s.output for s in states])
        if states:
            self.usual_dt = sorted(s.dt for s in states)[len(states) // 2]
        self.since = time.monotonic()
        self.looks = 0

    def trouble(self) -> str | None:
        """Return what is wrong with the loop now, or None."""
        now = time.monotonic()
        self.looks += 1
        if self.looks > SILENT_LOOKS:
            return f"it reported nothing for {LOOK * SILENT_LOOKS:g} s"
        states = [m for t, m in self.seen if t >= max(self.since, now - WINDOW)]
        if any(not math.isfinite(s.output + s.measurement) for s in states):
            return "its output or measurement is not a number"
        # A few states that queued while this process slept tell of an instant, not of a loop.
        if now - self.since < WINDOW or len(states) < 4 or _span(states) < 0.5 * WINDOW:
            return None
        return self._unstable(states)

    def _unstable(self, states: list[PidState]) -> str | None:
        swing = _swing([s.output for s in states])
        if swing > max(0.25 * self.supply, 3 * self.usual_swing):
            return f"its output swings by {swing:.2g} V from step to step"
        clamped = sum(s.saturated for s in states) / len(states)
        if clamped > 0.5:
            return f"its output is clamped {clamped:.0%} of the time"
        if any(max(s.dt, s.age) > STARVED * self.usual_dt for s in states):
            return None  # the speed shows what the machine did, not the gains
        error = _rms([s.error for s in states])
        asked = max(abs(s.reference) for s in states)
        moved = max(s.reference for s in states) - min(s.reference for s in states)
        # While the reference moves the wheel follows late; that is no fault.
        if error > max(0.3 * asked + moved, 3 * self.usual_error, 0.1):
            return f"its speed is {error:.2g} rad/s off at {asked:.2g} rad/s"
        return None


def _span(states: list[PidState]) -> float:
    """Return the time between the first and the last state [s]."""
    return seconds(states[-1].header.stamp) - seconds(states[0].header.stamp)


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
        self._executor = LeanExecutor()
        self._executor.add_node(self)
        steady_timer(self, LOOK, lambda: None)  # wakes the executor
        self._old: dict[str, dict[str, Any]] = {}
        self._known_clients: dict[str, Any] = {}

    def do_read(self, wheels: Mapping[str, list[str]]) -> dict[str, Any]:
        """Read the parameters of every wheel; those that a node does not have are left out."""
        return {"values": self._get(wheels)}

    def do_apply(
        self, values: Mapping[str, Mapping[str, Any]], watch: float, supply: float
    ) -> dict[str, Any]:
        """Set all wheels, watch, and take back when one of them misbehaves."""
        watches = {wheel: Watch(supply) for wheel in values}
        for wheel, one in watches.items():
            self.create_subscription(PidState, f"/{wheel}/pid_state", one.take, STREAM_SUBSCRIBER)
            # Known to the wheel before it is needed, an answer is not lost on the way.
            self._client(SetParametersAtomically, wheel, _SET)
        old = self._get({wheel: list(new) for wheel, new in values.items()})
        self._until(lambda: all(w.seen for w in watches.values()), PATIENCE)
        silent = [wheel for wheel, one in watches.items() if not one.seen]
        if silent:
            raise Trouble(
                f"{', '.join(silent)}: no pid_state within {PATIENCE:g} s; is wheel_pid active, "
                "and has it a set-point?"
            )
        self._until(lambda: False, BASELINE)
        for one in watches.values():
            one.begin()
        begun = time.monotonic()
        self._old = old
        try:
            self._set(values)
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
            self._until(lambda: False, LOOK)
            for wheel, one in watches.items():
                trouble = one.trouble()
                if trouble is not None:
                    return f"{wheel}: {trouble}"
        return None

    def take_back(self) -> None:
        """Set what was there before, in every wheel that answers."""
        old, self._old = self._old, {}
        try:
            self._set(old)
        except Trouble as trouble:
            raise Trouble(f"the old gains could not be set again: {trouble}") from None

    def _get(self, wheels: Mapping[str, list[str]]) -> dict[str, dict[str, Any]]:
        requests = {wheel: GetParameters.Request(names=names) for wheel, names in wheels.items()}
        answers = self._call(GetParameters, _GET, requests)
        return {
            wheel: {
                name: parameter_value_to_python(value)
                for name, value in zip(names, answers[wheel].values, strict=False)
                if value.type != ParameterType.PARAMETER_NOT_SET
            }
            for wheel, names in wheels.items()
        }

    def _set(self, values: Mapping[str, Mapping[str, Any]]) -> None:
        requests = {
            wheel: SetParametersAtomically.Request(
                parameters=[Parameter(n, value=v).to_parameter_msg() for n, v in new.items()]
            )
            for wheel, new in values.items()
        }
        answers = self._call(SetParametersAtomically, _SET, requests)
        refused = [
            f"{wheel}: wheel_pid refused the gains: {answer.result.reason}"
            for wheel, answer in answers.items()
            if not answer.result.successful
        ]
        if refused:
            raise Trouble("; ".join(refused))

    def _client(self, kind: Any, wheel: str, service: str) -> Any:
        name = f"/{wheel}/wheel_pid/{service}"
        if name not in self._known_clients:
            self._known_clients[name] = self.create_client(kind, name)
        return self._known_clients[name]

    def _call(self, kind: Any, service: str, requests: Mapping[str, Any]) -> dict[str, Any]:
        """Ask all wheels at once; return the answers by wheel.

        An answer is lost where the node has not yet discovered this client: who does not answer
        is asked again, which does no harm.
        """
        clients = {wheel: self._client(kind, wheel, service) for wheel in requests}
        asked: dict[str, list[Any]] = {wheel: [] for wheel in requests}

        def answered(wheel: str) -> bool:
            return any(future.done() for future in asked[wheel])

        def all_answered() -> bool:
            return all(map(answered, requests))

        end = time.monotonic() + PATIENCE
        while not all_answered() and time.monotonic() < end:
            for wheel, request in requests.items():
                if not answered(wheel) and clients[wheel].service_is_ready():
                    asked[wheel].append(clients[wheel].call_async(request))
            self._until(all_answered, ANSWER)
        missing = [wheel for wheel in requests if not answered(wheel)]
        for wheel, futures in asked.items():
            for future in futures:
                if not future.done():
                    clients[wheel].remove_pending_request(future)
        if missing:
            there = all(asked[wheel] for wheel in missing)
            what = "no answer" if there else "no such service"
            hint = "" if there else "; is wheel_pid running?"
            names = ", ".join(clients[wheel].srv_name for wheel in missing)
            raise Trouble(f"{names}: {what} within {PATIENCE:g} s{hint}")
        return {w: next(f for f in asked[w] if f.done()).result() for w in requests}

    def _until(self, condition: Callable[[], bool], timeout: float) -> bool:
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() >= deadline or not rclpy.ok():
                return False
            self._executor.spin_once()
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
