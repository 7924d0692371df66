# SPDX-License-Identifier: Apache-2.0
"""Verify new gains: drive all wheels and compare their responses with the design's predictions."""

import contextlib
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from smp_motor_control import controller_of
from smp_motor_ident.bag.storage import Table
from smp_motor_ident.cli import processes, steps
from smp_motor_ident.cli.driving import LEAD_S, Designed, Move, changes_of, read_drive
from smp_motor_ident.finding import Finding
from smp_motor_ident.tune import verification
from smp_motor_ident.tune.verification import STEADY_TIME_S, Change

MIN_STEP_S = 1.0  # of a change of set-point with its end [s]
MAX_ATTEMPTS = 3  # largest number of drives; a disturbed drive is repeated


class NeverHeard(processes.ProcessError):
    """A wheel's controller published nothing at a set-point of the drive."""


@dataclass
class Trial:
    """Gains on trial; ``kept`` tells whether they stay after it."""

    kept: bool = False


@contextlib.contextmanager
def on_trial(client: Any, gains: Mapping[str, Mapping[str, Any]]) -> Iterator[Trial]:
    """Set gains in the running controllers; restore the old ones unless they are kept."""
    new = {controller_of(wheel): dict(values) for wheel, values in gains.items()}
    old = client.get_parameters({node: list(values) for node, values in new.items()})
    pending_restore, trial = dict(client.pending_restore), Trial()
    client.set_pending_restore(**pending_restore, gains=old)
    client.set_parameters(new)
    try:
        yield trial
    finally:
        if not trial.kept:
            client.set_parameters(old)
        client.set_pending_restore(**pending_restore)


def plan_of(designed: Designed) -> list[tuple[str, float, float]]:
    """Return the steps of the drive: name, set-point [rad/s] and duration [s]."""
    specified = [one["specification"] for one in designed.document.values()]
    change = min(float(one["change"]) for one in specified)
    longest = max(float(one["settling"]["high"] or MIN_STEP_S) for one in specified)
    lasts = max(MIN_STEP_S, 2 * longest + STEADY_TIME_S)
    driven = [("forward", change), ("stop", 0.0), ("reverse", -change), ("stop", 0.0)]
    return [("stand", 0.0, 2 * LEAD_S), *((name, speed, lasts) for name, speed in driven)]


def drive(robot: steps.Robot, plan: Sequence[tuple[str, float, float]]) -> Path:
    """Drive all wheels through a plan with the gains that are set; return the recording."""
    from smp_motor_control.nodes.driving import drive_wheels

    bag = robot.folder / "verification"
    shutil.rmtree(bag, ignore_errors=True)
    try:
        robot.switch("activate")
        steps.record(robot, bag.name, "motor_command", "pid_state")
        drive_wheels(robot.client, plan, robot.wheels)
    finally:
        robot.processes.stop("record")
        robot.switch("deactivate")
    return bag


def drive_undisturbed(
    robot: steps.Robot, designed: Designed, say: Callable[[str], None]
) -> tuple[list[Change], list[Finding]]:
    """Repeat a drive until it is undisturbed; return the changes and the findings."""
    plan, namespace = plan_of(designed), str(robot.client.node.get_namespace()).rstrip("/")
    for left in reversed(range(MAX_ATTEMPTS)):
        say(f"driving on the new gains: {', '.join(name for name, *_ in plan)}")
        try:
            changes, silence = read_changes(drive(robot, plan), plan, designed, namespace)
        except NeverHeard as error:
            if not left:
                raise
            say(f"the drive was disturbed: {error}")
            continue
        late = verification.report_silence(silence) or verification.report_slow_answers(changes)
        judged = verification.judge(changes)
        if not (late and (judged or late[0].severity == "refused")):
            break
        say(f"the drive was disturbed: {late[0].message}")
    return changes, [*late, *judged]


def read_changes(
    bag: Path, plan: Sequence[tuple[str, float, float]], designed: Designed, namespace: str
) -> tuple[list[Change], float]:
    """Return every change from rest, and the longest wait of a wheel for an answer [s]."""
    changes, silence = list[Change](), 0.0
    for wheel, driven in read_drive(bag, list(designed.document), namespace).items():
        moves = [
            Move(name, _begin(wheel, setpoint, driven.answers), 0.0, setpoint, lasts)
            for name, setpoint, lasts in plan
            if setpoint
        ]
        found, waited = changes_of(wheel, driven, moves, designed)
        changes += found
        silence = max(silence, waited)
    return changes, silence


def _begin(wheel: str, setpoint: float, answers: Table) -> float:
    """Return the time of a wheel's first message at a set-point."""
    asked = np.flatnonzero(np.isclose(answers.columns["setpoint"], setpoint))
    if not asked.size:
        raise NeverHeard(
            f"{wheel}: wheel_pid published nothing at {setpoint:.3g} rad/s in the drive: it had a "
            "fault, or its messages were lost; check /diagnostics, then continue with --resume"
        )
    return float(answers.seconds[asked[0]])
