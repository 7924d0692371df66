# SPDX-License-Identifier: Apache-2.0
"""Trial of new gains on running wheels, with the old gains restored if one loop misbehaves."""

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from smp_interfaces.msg import PidState
from smp_motor_control import get_controller_name
from smp_motor_control.errors import SmpError
from smp_motor_control.nodes.robot_client import POLL_PERIOD_S, TIMEOUT_S, RobotClient, RobotError
from smp_motor_control.nodes.runtime import seconds

BASELINE_S = 0.5  # observation of the old gains
WINDOW_S = 0.4  # assessed time span; the first assessment is this long after the change

MAX_SILENT_POLLS = 25
"""Polls without a report that show a stopped loop: half a second of this process's run time."""

STARVED_RATIO = 10.0  # late by this many usual intervals, the loop was not computed meanwhile
RETURN_TIMEOUT_S = 60.0  # longest wait for a wheel that stopped answering


class LoopWatch:
    """Assess one wheel by its ``pid_state``."""

    def __init__(self, supply: float) -> None:
        self.supply = supply  # [V]
        self.seen: deque[tuple[float, PidState]] = deque()
        self.baseline_error = self.baseline_swing = 0.0
        self.baseline_dt = self.since = math.inf
        self.silent_polls = 0

    def take(self, message: PidState) -> None:
        """Add a state and drop those older than the window."""
        now = time.monotonic()
        self.silent_polls = 0
        self.seen.append((now, message))
        while now - self.seen[0][0] > max(WINDOW_S, BASELINE_S):
            self.seen.popleft()

    def begin(self) -> None:
        """Use the states so far as the baseline and start the trial."""
        states = [message for _, message in self.seen]
        self.baseline_error = _rms([s.error for s in states])
        self.baseline_swing = _mean_change([s.output for s in states])
        if states:
            self.baseline_dt = sorted(s.dt for s in states)[len(states) // 2]
        self.since = time.monotonic()
        self.silent_polls = 0

    def find_problem(self) -> str | None:
        """Return the present problem of the loop, or None."""
        now = time.monotonic()
        self.silent_polls += 1
        if self.silent_polls > MAX_SILENT_POLLS:
            return f"it reported nothing for {POLL_PERIOD_S * MAX_SILENT_POLLS:g} s"
        states = [m for t, m in self.seen if t >= max(self.since, now - WINDOW_S)]
        if any(not math.isfinite(s.output + s.measurement) for s in states):
            return "its output or measurement is not a number"
        # A few states that queued while this process slept show an instant only.
        if now - self.since < WINDOW_S or len(states) < 4:
            return None
        if seconds(states[-1].header.stamp) - seconds(states[0].header.stamp) < 0.5 * WINDOW_S:
            return None
        return self._find_instability(states)

    def _find_instability(self, states: list[PidState]) -> str | None:
        swing = _mean_change([s.output for s in states])
        if swing > max(0.25 * self.supply, 3 * self.baseline_swing):
            return f"its output swings by {swing:.2g} V from step to step"
        clamped = sum(s.saturated for s in states) / len(states)
        if clamped > 0.5:
            return f"its output is clamped {100 * clamped:.0f} % of the time"
        if any(max(s.dt, s.age) > STARVED_RATIO * self.baseline_dt for s in states):
            return None  # the computer's delays, not the gains, affect the speed
        error = _rms([s.error for s in states])
        largest = max(abs(s.reference) for s in states)
        change = max(s.reference for s in states) - min(s.reference for s in states)
        # A lag behind a moving reference is not a fault.
        if error > max(0.3 * largest + change, 3 * self.baseline_error, 0.1):
            return f"its speed is {error:.2g} rad/s off at {largest:.2g} rad/s"
        return None


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else 0.0


def _mean_change(values: list[float]) -> float:
    """Return the mean change between steps [V]."""
    return float(np.mean(np.abs(np.diff(values)))) if len(values) > 1 else 0.0


@dataclass(frozen=True)
class Outcome:
    """Result of a trial."""

    reason: str  # why the old gains were restored; empty if the new ones are kept
    after: float  # time from the change to their restoration, without missing wheels [s]
    missing: tuple[str, ...] = ()  # wheels that did not answer and may run with the new gains


def try_gains(
    client: RobotClient,
    values: Mapping[str, Mapping[str, Any]],
    trial: float,
    supply: float,
    say: Callable[[str], None] = print,
    on_set: Callable[[], None] = lambda: None,
) -> Outcome:
    """Set parameters in all wheels, watch the loops, and restore all when one misbehaves.

    ``on_set`` is called once the parameters are set.
    """
    watches = {wheel: LoopWatch(supply) for wheel in values}
    with client.listen(PidState, {f"{w}/pid_state": one.take for w, one in watches.items()}):
        old = client.get_parameters(
            {get_controller_name(w): list(new) for w, new in values.items()}
        )
        client.set_parameters(old)  # ensures that they can be restored
        client.until(lambda: all(w.seen for w in watches.values()), TIMEOUT_S)
        silent = [wheel for wheel, one in watches.items() if not one.seen]
        if silent:
            raise RobotError(
                f"{', '.join(silent)}: no pid_state within {TIMEOUT_S:g} s; is wheel_pid active "
                "with a set-point?"
            )
        client.spin(BASELINE_S)
        for one in watches.values():
            one.begin()
        start = time.monotonic()
        pending_restore = dict(client.pending_restore)
        # Gains that an earlier trial has replaced are the ones to restore.
        gains = {**old, **pending_restore.get("gains", {})}
        client.set_pending_restore(**{**pending_restore, "gains": gains})
        try:
            client.set_parameters({get_controller_name(w): new for w, new in values.items()})
            on_set()
            reason = _watch(client, watches, trial)
        except RobotError as error:
            reason = str(error)
    missing = []
    if reason is not None and not _restores(client, old, 1.0):
        missing = [n for n, values in old.items() if not _restores(client, {n: values}, 0.5)]
    after = time.monotonic() - start
    if missing:
        missing = _wait_for_missing(client, missing, old, say)
    client.set_pending_restore(**pending_restore)
    return Outcome(reason or "", after, tuple(missing))


def _watch(client: RobotClient, watches: Mapping[str, LoopWatch], trial: float) -> str | None:
    end = time.monotonic() + trial
    while time.monotonic() < end:
        client.spin(POLL_PERIOD_S)
        for wheel, one in watches.items():
            problem = one.find_problem()
            if problem is not None:
                return f"{wheel}: {problem}"
    return None


def _restores(client: RobotClient, nodes: Mapping[str, Mapping[str, Any]], patience: float) -> bool:
    """Set the old parameters of nodes; return whether they answer."""
    try:
        client.set_parameters(nodes, patience)
    except SmpError:
        return False
    return True


def _wait_for_missing(
    client: RobotClient,
    missing: list[str],
    old: Mapping[str, Mapping[str, Any]],
    say: Callable[[str], None],
) -> list[str]:
    """Wait for wheels that do not answer, and restore their gains when they return."""
    pending = client.pending_restore.get("gains", {})
    gains = {node: v for node, v in pending.items() if node not in old or node in missing}
    client.set_pending_restore(**{**client.pending_restore, "gains": gains})
    names = ", ".join(node.partition("/")[0] for node in missing)
    say(
        f"{names} does not answer; its old gains are restored if it returns within "
        f"{RETURN_TIMEOUT_S:g} s"
    )
    end = time.monotonic() + RETURN_TIMEOUT_S
    while missing and time.monotonic() < end:
        for node in list(missing):
            if _restores(client, {node: old[node]}, 1.0):
                missing.remove(node)
                say(f"{node.partition('/')[0]} is back and has its old gains")
    return [node.partition("/")[0] for node in missing]
