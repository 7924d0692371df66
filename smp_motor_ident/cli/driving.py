# SPDX-License-Identifier: Apache-2.0
"""Compare measured and predicted changes of set-point in a recorded drive."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_control.encoder import unwrap
from smp_motor_control.motor.parameters import Gearbox
from smp_motor_ident.bag.decode import read_columns
from smp_motor_ident.bag.storage import Table
from smp_motor_ident.cli import applying
from smp_motor_ident.cli.processes import ProcessError
from smp_motor_ident.record import Hardware
from smp_motor_ident.report.chart import Chart, Curve
from smp_motor_ident.report.drawing import document
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune import verification
from smp_motor_ident.tune.verification import Change

MIN_CHANGE = 0.8  # a smaller change of the set-point [rad/s, wheel] is no step to judge
LEAD_S = 0.3  # rest before a drive that is simulated with it [s]
MAX_SAMPLES = 1e6  # of a drive, which takes seconds
STATE = ("encoder_count", "position", "voltage")
ANSWER = ("setpoint", "age", "dt", "output")


@dataclass(frozen=True)
class Designed:
    """Designs, predictions and limits that a drive is compared with, by wheel."""

    estimates: Mapping[str, Estimate]  # the motors
    gains: Mapping[str, Mapping[str, Any]]  # parameters of ``wheel_pid``, as in ``gains.yaml``
    document: Mapping[str, Mapping[str, Any]]  # as in ``gains.json``


def read_designs(estimates: Mapping[str, Estimate], gains: Path) -> Designed:
    """Return motors with the gains that ``tune`` wrote for them, a YAML file and its JSON."""
    document = json.loads(gains.with_suffix(".json").read_text("utf-8"))["wheels"]
    return Designed(estimates, applying.from_file(gains), document)


@dataclass(frozen=True)
class Driven:
    """Recorded samples of one wheel and the commands of its controller."""

    state: Table
    answers: Table


@dataclass(frozen=True)
class Move:
    """One change of set-point in a drive."""

    name: str
    begin: float  # when the wheel was first heard at the new set-point [s]
    before: float  # set-point until then [rad/s, wheel]
    setpoint: float  # [rad/s, wheel]
    lasts: float  # [s]


def read_drive(bag: Path, wheels: Sequence[str], namespace: str = "") -> dict[str, Driven]:
    """Read the samples of wheels and the answers of their controllers."""
    wanted = {f"{namespace}/{wheel}/motor_state": list(STATE) for wheel in wheels}
    wanted |= {f"{namespace}/{wheel}/pid_state": list(ANSWER) for wheel in wheels}
    read = read_columns(bag, wanted)
    return {
        w: Driven(read[f"{namespace}/{w}/motor_state"], read[f"{namespace}/{w}/pid_state"])
        for w in wheels
    }


def find_moves(segments: Sequence[tuple[str, float, float]], answers: Table) -> list[Move]:
    """Return the changes of one wheel's set-point in a drive by segments of name, begin and end."""
    seconds, asked = answers.seconds, answers.columns["setpoint"]
    moves = []
    for name, begin, end in segments:
        during = np.flatnonzero((seconds > begin) & (seconds < end))
        if during.size == 0:
            continue
        final = asked[during[-1]]
        first = during[np.argmax(asked[during] == final)]
        before = float(asked[max(first - 1, 0)])
        if abs(final - before) >= MIN_CHANGE:
            at = float(seconds[first])
            moves.append(Move(name, at, before, float(final), end - at))
    return moves


def changes_of(
    wheel: str, driven: Driven, moves: Sequence[Move], given: Designed
) -> tuple[list[Change], float]:
    """Return the changes of one wheel, and its longest wait for an answer [s].

    The prediction is of its whole drive.
    """
    state, answers = driven.state, driven.answers
    estimate, entry = given.estimates[wheel], given.document[wheel]
    delays = verification.arrival_delays(
        (answers.seconds, answers.columns["age"], answers.columns["output"]),
        (state.seconds, state.columns["voltage"]),
        entry["loop"],
    )
    # The first interval is that since another drive.
    late = answers.columns["dt"][1:], delays[1:]
    silence = max(float(np.max(one, initial=0.0)) for one in late)
    if not moves:
        return [], silence
    end = max(one.begin + one.lasts for one in moves)
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
        instants, wheel_angle(state, estimate.hardware)[shown], step
    )
    rows = verification.predict_speed(
        estimate, given.gains[wheel], entry["loop"], asked, (instants, waited), even
    )
    hardware = estimate.hardware
    count = 2 * np.pi / (hardware.counts_per_revolution or 1e6) / hardware.gear_ratio
    unsure = verification.resolution(count, step)
    changes = []
    for one in moves:
        since = even - one.begin
        kept = (since >= 0.0) & (since < one.lasts - 0.05)
        changes.append(verification.change_of(
            wheel, one.name, one.setpoint, since[kept], speed[kept], rows[:, kept],
            entry["specification"], unsure, before=one.before,
        ))  # fmt: skip
    return changes, silence


def drive_figure(
    drive: Mapping[str, Driven],
    sides: Mapping[str, Sequence[str]],
    hardware: Mapping[str, Hardware],
) -> str:
    """Return an SVG file of set-points and speeds of the wheels of each side."""
    wheels = list(hardware)
    begin = min(float(one.state.seconds[0]) for one in drive.values())
    charts = []
    for side, names in sides.items():
        asked = drive[names[0]].answers
        time = asked.seconds
        speeds = {w: wheel_speed(drive[w].state, hardware[w]) for w in names}
        curves = [Curve("set-point", asked.columns["setpoint"], "muted")]
        curves += [
            Curve(w, np.interp(time, *speeds[w]), f"wheel-{wheels.index(w) % 4 + 1}") for w in names
        ]
        title = f"Wheels of the {side} side, and their set-point (grey)"
        charts.append(Chart(
            name=side, title=title, x_label="time [s]", y_label="wheel speed [rad/s]",
            x=time - begin, curves=tuple(curves),
        ))  # fmt: skip
    return document(charts, wheels)


def longest_stall(drive: Mapping[str, Driven]) -> float:
    """Return the longest pause of the simulating machine [s]."""
    gaps = (float(np.max(np.diff(one.state.seconds))) for one in drive.values())
    ages = (float(np.max(one.answers.columns["age"])) for one in drive.values())
    return max(*gaps, *ages)


def wheel_angle(state: Table, hardware: Hardware) -> Array:
    """Return the wheel's angle from counts, if there are any."""
    if not hardware.counts_per_revolution:
        return state.columns["position"]
    turn = 2 * np.pi / hardware.counts_per_revolution
    counts = unwrap(state.columns["encoder_count"], hardware.encoder_bits).astype(np.float64)
    return Gearbox(hardware.gear_ratio).to_wheel(turn) * counts


def wheel_speed(state: Table, hardware: Hardware) -> tuple[Array, Array]:
    """Return the wheel's speed as its encoder saw it."""
    angle = wheel_angle(state, hardware)
    step = float(np.median(np.diff(state.seconds)))
    return verification.smooth_speed(state.seconds, angle - angle[0], step)
