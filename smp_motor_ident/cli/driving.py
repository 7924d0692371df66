"""How the wheels answered ``cmd_vel``, from the recording of a drive."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_control.encoder import unwrap
from smp_motor_control.motor.parameters import Gearbox
from smp_motor_ident.bag.decode import read_columns
from smp_motor_ident.bag.storage import Table
from smp_motor_ident.record import Hardware
from smp_motor_ident.report.chart import Chart, Curve
from smp_motor_ident.report.drawing import document
from smp_motor_ident.tune.simulation import StepFigures, step_figures
from smp_motor_ident.tune.verification import smoothed

LEAST_CHANGE = 0.8  # a smaller change of the set-point [rad/s, wheel] is no step to judge


@dataclass(frozen=True)
class Answer:
    """One wheel's answer to one change of ``cmd_vel``."""

    segment: str  # name of the manoeuvre that began
    # before, after: speed before, and set-point [rad/s, wheel]
    before: float
    after: float
    figures: StepFigures  # of the change


Drive = Mapping[str, Table]
"""What is judged and drawn of the recording of a drive, by topic."""


def read_drive(bag: Path, wheels: Sequence[str]) -> Drive:
    """Read the samples of wheels and the answers of their controllers."""
    wanted = {f"/{wheel}/motor_state": ["encoder_count"] for wheel in wheels}
    return read_columns(bag, wanted | {f"/{w}/pid_state": ["setpoint", "age"] for w in wheels})


def answers_of(
    drive: Drive, segments: Sequence[tuple[str, float, float]], hardware: Mapping[str, Hardware]
) -> dict[str, list[Answer]]:
    """Measure rise, settling and overshoot of every wheel in every segment."""
    answers = {}
    for wheel, known in hardware.items():
        time, speed = wheel_speed(drive[f"/{wheel}/motor_state"], known)
        asked = drive[f"/{wheel}/pid_state"]
        found = [_answer(time, speed, asked, *segment) for segment in segments]
        answers[wheel] = [a for a in found if a is not None]
    return answers


def drive_figure(
    drive: Drive, sides: Mapping[str, Sequence[str]], hardware: Mapping[str, Hardware]
) -> str:
    """Return an SVG file: what the wheels of each side were asked for, and what they did."""
    wheels = list(hardware)
    begin = min(float(columns.seconds[0]) for columns in drive.values())
    charts = []
    for side, names in sides.items():
        asked = drive[f"/{names[0]}/pid_state"]
        time = asked.seconds
        speeds = {w: wheel_speed(drive[f"/{w}/motor_state"], hardware[w]) for w in names}
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


def longest_stall(drive: Drive) -> float:
    """Return how long the machine that simulates stood still at worst."""
    gaps = (np.diff(c.seconds) for c in drive.values() if "age" not in c.columns)
    ages = (c.columns["age"] for c in drive.values() if "age" in c.columns)
    return max(float(np.max(found)) for found in (*gaps, *ages))


def wheel_angle(state: Table, hardware: Hardware) -> Array:
    """Return the wheel's angle as its counts tell it, where there are counts."""
    if not hardware.counts_per_revolution:
        return state.columns["position"]
    turn = 2 * np.pi / hardware.counts_per_revolution
    counts = unwrap(state.columns["encoder_count"], hardware.encoder_bits).astype(np.float64)
    return Gearbox(hardware.gear_ratio).to_wheel(turn) * counts


def wheel_speed(state: Table, hardware: Hardware) -> tuple[Array, Array]:
    """Return the wheel's speed as its encoder saw it."""
    angle = wheel_angle(state, hardware)
    return smoothed(state.seconds, angle - angle[0], float(np.median(np.diff(state.seconds))))


def _answer(
    time: Array, speed: Array, asked: Table, name: str, begin: float, end: float
) -> Answer | None:
    """Read one segment; its set-point is the last one asked for in it."""
    during = np.flatnonzero((asked.seconds > begin) & (asked.seconds < end))
    before = (time > begin - 0.3) & (time < begin)
    inside = (time >= begin) & (time < end)
    if during.size == 0 or not inside.any():
        return None
    start = float(speed[before].mean()) if before.any() else 0.0
    final = float(asked.columns["setpoint"][during[-1]])
    if abs(final - start) < LEAST_CHANGE:
        return None
    figures = step_figures(
        time[inside] - begin, speed[inside] - start, np.zeros(inside.sum()), final - start
    )
    return Answer(name, start, final, figures)
