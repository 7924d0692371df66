# SPDX-License-Identifier: Apache-2.0
"""Drive on new gains, and compare changes of set-point with the design's predictions."""

import contextlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_control.encoder import unwrap
from smp_motor_ident.bag.decode import read_columns
from smp_motor_ident.bag.storage import Table
from smp_motor_ident.cli import applying, steps
from smp_motor_ident.cli.processes import ProcessError
from smp_motor_ident.finding import Finding
from smp_motor_ident.record import Hardware
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune import verification
from smp_motor_ident.tune.verification import STEADY_TIME_S, Change

RECORDING = "verification"  # folder of the recorded drive
LEAD_S = 0.3  # rest before a drive that is simulated with it [s]
MAX_SAMPLES = 1e6  # largest number of samples of a drive; its simulation takes seconds

Plan = Sequence[tuple[str, float, float]]
"""Steps of a drive: name, set-point [rad/s, wheel] and duration [s]."""

STATE_COLUMNS = ("encoder_count", "position", "voltage")
ANSWER_COLUMNS = ("setpoint", "age", "dt", "output")
MIN_STEP_S = 1.0  # shortest duration of a set-point in a drive [s]
MAX_ATTEMPTS = 3  # largest number of drives; a disturbed drive is repeated


@dataclass(frozen=True)
class DesignSet:
    """Designs, predictions and limits that a drive is compared with, by wheel."""

    estimates: Mapping[str, Estimate]  # the motors
    gains: Mapping[str, Mapping[str, Any]]  # parameters of ``wheel_pid``, as in ``gains.yaml``
    document: Mapping[str, Mapping[str, Any]]  # as in ``gains.json``


def read_designs(estimates: Mapping[str, Estimate], gains: Path) -> DesignSet:
    """Return motors with the gains that ``tune`` wrote for them, a YAML file and its JSON."""
    document = json.loads(gains.with_suffix(".json").read_text("utf-8"))["wheels"]
    return DesignSet(estimates, applying.from_file(gains), document)


@dataclass(frozen=True)
class DriveRecording:
    """Recorded samples of one wheel and the commands of its controller."""

    state: Table
    answers: Table


def read_drive(bag: Path, wheels: Sequence[str], namespace: str = "") -> dict[str, DriveRecording]:
    """Read the samples of wheels and the answers of their controllers."""
    wanted = {f"{namespace}/{wheel}/motor_state": list(STATE_COLUMNS) for wheel in wheels}
    wanted |= {f"{namespace}/{wheel}/pid_state": list(ANSWER_COLUMNS) for wheel in wheels}
    read = read_columns(bag, wanted)
    return {
        w: DriveRecording(read[f"{namespace}/{w}/motor_state"], read[f"{namespace}/{w}/pid_state"])
        for w in wheels
    }


def read_changes(
    driven: Mapping[str, DriveRecording], plan: Plan, given: DesignSet
) -> tuple[list[Change], list[Finding]]:
    """Return the changes of all wheels, and a finding where the computer disturbed the drive."""
    read = [read_wheel_changes(wheel, one, plan, given) for wheel, one in driven.items()]
    changes = [change for found, _ in read for change in found]
    silence = max(waited for _, waited in read)
    return changes, verification.report_silence(silence) or verification.report_loop_delay(changes)


def read_wheel_changes(
    wheel: str, driven: DriveRecording, plan: Plan, given: DesignSet
) -> tuple[list[Change], float]:
    """Return a wheel's changes of set-point from rest, and its longest wait for an answer [s]."""
    state, answers = driven.state, driven.answers
    estimate, entry = given.estimates[wheel], given.document[wheel]
    delays = verification.measure_arrival_delays(
        (answers.seconds, answers.columns["age"], answers.columns["output"]),
        (state.seconds, state.columns["voltage"]),
        entry["loop"],
    )
    # The first interval began before this drive.
    late = answers.columns["dt"][1:], delays[1:]
    silence = max(float(np.max(one, initial=0.0)) for one in late)
    moves = [
        (name, setpoint, _find_begin(wheel, setpoint, answers), lasts)
        for name, setpoint, lasts in plan
        if setpoint
    ]
    end = max(begin + lasts for *_, begin, lasts in moves)
    shown = (state.seconds > answers.seconds[0] - LEAD_S) & (state.seconds < end)
    instants = state.seconds[shown]
    known = dict(zip(answers.seconds, delays))
    waited = np.array([known.get(instant, np.nan) for instant in instants])
    latest = np.searchsorted(answers.seconds, instants, side="right") - 1
    asked = np.where(latest < 0, 0.0, answers.columns["setpoint"][latest])
    step = float(entry["loop"]["sample_time"])
    if np.ptp(instants) > MAX_SAMPLES * step:
        raise ProcessError(
            f"{wheel}: the stamps of the drive span {np.ptp(instants):.3g} s at {step:.3g} s a "
            "sample: a clock was set meanwhile, or two nodes publish motor_state. Look at the "
            "clocks and the nodes, then drive again"
        )
    even, speed = verification.smooth_speed(
        instants, compute_wheel_angle(state, estimate.hardware)[shown], step
    )
    rows = verification.predict_speed(
        estimate, given.gains[wheel], entry["loop"], asked, (instants, waited), even
    )
    hardware = estimate.hardware
    count = 2 * np.pi / (hardware.counts_per_revolution or 1e6) / hardware.gear_ratio
    unsure = verification.resolution(count, step)
    changes = []
    for name, setpoint, begin, lasts in moves:
        since = even - begin
        kept = (since >= 0.0) & (since < lasts - 0.05)
        changes.append(verification.read_change(
            wheel, name, setpoint, since[kept], speed[kept], rows[:, kept],
            entry["specification"], unsure,
        ))  # fmt: skip
    return changes, silence


def compute_wheel_angle(state: Table, hardware: Hardware) -> Array:
    """Return the wheel's angle from counts, if there are any."""
    if not hardware.counts_per_revolution:
        return state.columns["position"]
    angle_per_count = 2 * np.pi / hardware.counts_per_revolution / hardware.gear_ratio
    counts = unwrap(state.columns["encoder_count"], hardware.encoder_bits).astype(np.float64)
    return angle_per_count * counts


class NoMessageError(ProcessError):
    """A controller published no message at a set-point of the drive."""


@contextlib.contextmanager
def on_trial(client: Any, new: Mapping[str, Mapping[str, Any]]) -> Iterator[None]:
    """Set parameters of controllers, by node, inside the block; restore the old ones after it."""
    old = client.get_parameters({node: list(values) for node, values in new.items()})
    pending_restore = dict(client.pending_restore)
    client.set_pending_restore(**pending_restore, gains=old)
    client.set_parameters(new)
    try:
        yield
    finally:
        client.set_parameters(old)
        client.set_pending_restore(**pending_restore)


def plan_drive(designed: DesignSet) -> Plan:
    """Return the steps of the drive, long enough for every wheel to settle."""
    specified = [one["specification"] for one in designed.document.values()]
    change = min(float(one["change"]) for one in specified)
    longest = max(float(one["settling"]["high"] or MIN_STEP_S) for one in specified)
    lasts = max(MIN_STEP_S, 2 * longest + STEADY_TIME_S)
    driven = [("forward", change), ("stop", 0.0), ("reverse", -change), ("stop", 0.0)]
    return [("stand", 0.0, 2 * LEAD_S), *((name, speed, lasts) for name, speed in driven)]


def drive(robot: steps.Robot, plan: Plan) -> Path:
    """Drive all wheels through a plan with the gains that are set; return the recording."""
    from smp_motor_control.nodes.driving import drive_wheels

    shutil.rmtree(robot.folder / RECORDING, ignore_errors=True)
    try:
        robot.switch("activate")
        bag = steps.record(robot, RECORDING, "motor_command", "pid_state")
        drive_wheels(robot.client, plan, robot.wheels)
    finally:
        robot.processes.stop("record")
        robot.switch("deactivate")
    return bag


def drive_undisturbed(
    robot: steps.Robot, designed: DesignSet, say: Callable[[str], None]
) -> tuple[list[Change], list[Finding]]:
    """Repeat a drive until it is undisturbed; return the changes and the findings."""
    plan, namespace = plan_drive(designed), str(robot.client.node.get_namespace()).rstrip("/")
    for left in reversed(range(MAX_ATTEMPTS)):
        say(f"driving on the new gains: {', '.join(name for name, *_ in plan)}")
        driven = read_drive(drive(robot, plan), list(designed.document), namespace)
        try:
            changes, late = read_changes(driven, plan, designed)
        except NoMessageError as error:
            if not left:
                raise
            say(f"the drive was disturbed: {error}")
            continue
        judged = verification.judge(changes)
        if not (late and (judged or late[0].severity == "refused")):
            break
        say(f"the drive was disturbed: {late[0].message}")
    return changes, [*late, *judged]


def _find_begin(wheel: str, setpoint: float, answers: Table) -> float:
    """Return the time of a wheel's first message at a set-point."""
    asked = np.flatnonzero(np.isclose(answers.columns["setpoint"], setpoint))
    if not asked.size:
        raise NoMessageError(
            f"{wheel}: wheel_pid published nothing at {setpoint:.3g} rad/s in the drive: it had a "
            "fault, or its messages were lost; check /diagnostics, then continue with --resume"
        )
    return float(answers.seconds[asked[0]])
