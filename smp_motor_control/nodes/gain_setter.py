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
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.node import Node

from smp_interfaces.msg import PidState
from smp_motor_control.nodes.asking import SET, Asker, AskError
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

PATIENCE = 8.0
"""Longest wait for a service or a topic; on a busy machine discovery takes seconds [s]."""


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


def _node(wheel: str) -> str:
    return f"/{wheel}/wheel_pid"


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
        self._asker = Asker(self, self._until, PATIENCE)

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
            self._asker.client(SetParametersAtomically, f"{_node(wheel)}/{SET}")
        old = self._get({wheel: list(new) for wheel, new in values.items()})
        self._until(lambda: all(w.seen for w in watches.values()), PATIENCE)
        silent = [wheel for wheel, one in watches.items() if not one.seen]
        if silent:
            raise AskError(
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
        except AskError as trouble:
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
        except AskError as trouble:
            raise AskError(f"the old gains could not be set again: {trouble}") from None

    def _get(self, wheels: Mapping[str, list[str]]) -> dict[str, dict[str, Any]]:
        found = self._asker.get_parameters({_node(w): names for w, names in wheels.items()})
        return {wheel: found[_node(wheel)] for wheel in wheels}

    def _set(self, values: Mapping[str, Mapping[str, Any]]) -> None:
        self._asker.set_parameters({_node(wheel): new for wheel, new in values.items()})

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
            except AskError as trouble:
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
