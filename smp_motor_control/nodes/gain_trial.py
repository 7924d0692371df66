"""New gains in running wheels on trial: set, watched, and taken back from all if one is bad."""

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from smp_interfaces.msg import PidState
from smp_motor_control import controller_of
from smp_motor_control.errors import SmpError
from smp_motor_control.nodes.robot_client import LOOK, PATIENCE, RobotClient, RobotError
from smp_motor_control.nodes.runtime import seconds

BASELINE = 0.5  # how long the old gains are watched first [s]
WINDOW = 0.4
"""Length of the stretch that is judged [s]; the first verdict comes that long after the change."""

SILENT_LOOKS = 25
"""A loop that reports nothing between so many looks has stopped: half a second, in which this
process itself was awake."""

STARVED = 10.0  # a step that comes so many usual steps late ran without control meanwhile
RETURN = 60.0  # how long a wheel that does not answer is waited for, to set its old gains again [s]


class Watch:
    """Judges one wheel by its ``pid_state``."""

    def __init__(self, supply: float) -> None:
        self.supply = supply  # [V]
        self.seen: deque[tuple[float, PidState]] = deque()
        self.usual_error = self.usual_swing = 0.0
        self.usual_dt = self.since = math.inf
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
        if now - self.since < WINDOW or len(states) < 4:
            return None
        if seconds(states[-1].header.stamp) - seconds(states[0].header.stamp) < 0.5 * WINDOW:
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


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else 0.0


def _swing(values: list[float]) -> float:
    """Return the mean change from a step to the next [V]."""
    return float(np.mean(np.abs(np.diff(values)))) if len(values) > 1 else 0.0


@dataclass(frozen=True)
class Outcome:
    """What became of a trial."""

    reason: str  # why the gains were taken back; empty where they are kept
    after: float  # time until that was done in the wheels that answered [s]
    # Wheels that did not return: they go on with the new gains if they do
    missing: tuple[str, ...] = ()


def try_gains(
    client: RobotClient,
    values: Mapping[str, Mapping[str, Any]],
    trial: float,
    supply: float,
    say: Callable[[str], None] = print,
) -> Outcome:
    """Set parameters in all wheels, watch the loops, and take all back when one misbehaves."""
    watches = {wheel: Watch(supply) for wheel in values}
    with client.listen(PidState, {f"{w}/pid_state": one.take for w, one in watches.items()}):
        old = client.get_parameters({controller_of(w): list(new) for w, new in values.items()})
        client.set_parameters(old)  # what could not be taken back is not tried
        client.until(lambda: all(w.seen for w in watches.values()), PATIENCE)
        silent = [wheel for wheel, one in watches.items() if not one.seen]
        if silent:
            raise RobotError(
                f"{', '.join(silent)}: no pid_state within {PATIENCE:g} s; is wheel_pid active, "
                "and has it a set-point?"
            )
        client.spin(BASELINE)
        for one in watches.values():
            one.begin()
        begun = time.monotonic()
        client.owe(gains=old)
        try:
            client.set_parameters({controller_of(w): new for w, new in values.items()})
            reason = _watch(client, watches, trial)
        except RobotError as trouble:
            reason = str(trouble)
    missing = () if reason is None else _take_back(client, old)
    after = time.monotonic() - begun
    if missing:
        missing = _settle(client, missing, old, say)
    client.owe()
    return Outcome(reason or "", after, tuple(missing))


def _watch(client: RobotClient, watches: Mapping[str, Watch], trial: float) -> str | None:
    end = time.monotonic() + trial
    while time.monotonic() < end:
        client.spin(LOOK)
        for wheel, one in watches.items():
            trouble = one.trouble()
            if trouble is not None:
                return f"{wheel}: {trouble}"
    return None


def _take_back(client: RobotClient, old: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Set what was there before; return the nodes that do not answer."""
    try:
        client.set_parameters(old, 1.0)
    except SmpError:
        return [node for node, values in old.items() if not _answers(client, node, values, 0.5)]
    return []


def _answers(client: RobotClient, node: str, values: Mapping[str, Any], patience: float) -> bool:
    try:
        client.set_parameters({node: values}, patience)
    except SmpError:
        return False
    return True


def _settle(
    client: RobotClient,
    missing: list[str],
    old: Mapping[str, Mapping[str, Any]],
    say: Callable[[str], None],
) -> list[str]:
    """Wait for wheels that stopped, and set their old gains before they drive on with the new."""
    client.owe(gains={node: old[node] for node in missing})
    names = ", ".join(node.partition("/")[0] for node in missing)
    say(f"{names} does not answer; its old gains are set when it returns within {RETURN:g} s")
    end = time.monotonic() + RETURN
    while missing and time.monotonic() < end:
        for node in list(missing):
            if _answers(client, node, old[node], 1.0):
                missing.remove(node)
                say(f"{node.partition('/')[0]} is back and has its old gains")
    return [node.partition("/")[0] for node in missing]
