# SPDX-License-Identifier: Apache-2.0
"""Run ``demo``: commission a simulated robot, and compare the results with its true motors."""

import argparse
import math
import shutil
import signal
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from smp_motor_control import WHEELS
from smp_motor_control.motor.file import PAPER_MOTORS, MotorEntry, find_config, load_motors
from smp_motor_control.motor.parameters import COMBINATIONS, PHYSICAL
from smp_motor_ident.cli import commission, demo, driving, steps
from smp_motor_ident.cli.processes import Processes, connect, isolate
from smp_motor_ident.cli.tables import console, table
from smp_motor_ident.cli.workers import die_with_parent
from smp_motor_ident.errors import ParameterError
from smp_motor_ident.report import words
from smp_motor_ident.report.document import read_identification
from smp_motor_ident.report.drawing import Chart, Curve, document
from smp_motor_ident.result import Estimate, Quantity
from smp_motor_ident.tune.verification import Change, smooth_speed

EXCITATION = ("--amplitude", "11", "--duration", "10")
"""Largest voltage [V] and length of a signal [s]."""

ACCEPTED = (
    "feedback_rate", "feedback_age", "validation_run", "verification", "verification_disturbed",
)  # fmt: skip
"""Findings of a busy computer, which do not end the demo: its own checks decide."""

MAX_OVERSHOOT = 2.0  # percent of the change
MAX_SETTLING_EXCESS = 20.0  # ms later than predicted: four samples
MAX_GAIN_ERROR = 0.5  # percent
MAX_DEVIATIONS = 3.0  # of its own standard deviations, for every parameter of a wheel
WORST_DEVIATIONS = 4.0
UNIT = "standard deviations, timing included,"  # the only systematic error of a simulation
# Of 40 numbers, some 26 of them independent, one lies beyond 3 by chance in one run of 15
# (and beyond 4 in one of 600): so one wheel may, and none may beyond 4.

GAINS = ("p", "i", "d", "feedforward_static", "feedforward_velocity", "feedforward_acceleration")
"""Parameters of a controller that are printed."""


@dataclass(frozen=True)
class Check:
    """One check of the demo: the worst figure, its limit, and its place."""

    name: str
    worst: float
    limit: float
    where: str
    unit: str

    @property
    def holds(self) -> bool:
        """Whether the figure exists and is within its limit."""
        return self.worst <= self.limit


def work(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    die_with_parent(signal.SIGTERM)
    motors = Path(arguments.motors) if arguments.motors else find_config(PAPER_MOTORS)
    truth = load_motors(motors, WHEELS)
    folder = _clear_folder(Path(arguments.output))
    domain = isolate(arguments.domain)
    with Processes(folder / "logs") as processes:
        with connect(demo.NAME) as client:
            start(steps.Robot(processes, client, WHEELS, folder), motors, arguments.rate)
        nodes = f"motor_plant, {len(WHEELS)} wheel_pid, skid_steer"
        print(f"running: {nodes} (ROS domain {domain})", flush=True)
        accepted = [part for code in ACCEPTED for part in ("--accept", code)]
        steps.run(commission, "--output", str(folder), *EXCITATION, *accepted, "--apply", "--yes")
    designed = driving.read_designs(
        read_identification(folder / "identification"), folder / "gains.yaml"
    )
    driven = driving.read_drive(folder / driving.RECORDING, WHEELS)
    (folder / "drive.svg").write_text(_draw_drive(driven, designed), encoding="utf-8")
    changes, disturbed = driving.read_changes(driven, driving.plan_drive(designed), designed)
    print_results(truth, designed, changes)
    checks = check_estimates(truth, designed.estimates)
    if disturbed:
        print(f"---- the drive is not judged: {disturbed[0].message}")
    else:
        checks += check_drive(changes)
    for one in checks:
        mark = "ok  " if one.holds else "FAIL"
        print(f"{mark} {one.name}: {one.worst:.3g} {one.unit} at most {one.limit:g} ({one.where})")
    print(f"report: {folder / 'identification' / 'report.html'}")
    return 0 if all(one.holds for one in checks) else 1


def _draw_drive(driven: Mapping[str, driving.DriveRecording], designed: driving.DesignSet) -> str:
    """Return an SVG file of the set-point and the speeds of the wheels, from their encoders."""
    asked = next(iter(driven.values())).answers
    time, curves = asked.seconds, [Curve("set-point", asked.columns["setpoint"], "muted")]
    for k, (wheel, one) in enumerate(driven.items(), start=1):
        angle = driving.compute_wheel_angle(one.state, designed.estimates[wheel].hardware)
        step = float(np.median(np.diff(one.state.seconds)))
        speed = smooth_speed(one.state.seconds, angle - angle[0], step)
        curves.append(Curve(wheel, np.interp(time, *speed), f"wheel-{k}"))
    chart = Chart(
        name="drive", title="Speed of the wheels, and their set-point (grey)",
        x_label="time [s]", y_label="wheel speed [rad/s]", x=time - time[0], curves=tuple(curves),
    )  # fmt: skip
    return document([chart], list(driven))


def _clear_folder(folder: Path) -> Path:
    """Return an empty folder; an earlier demo's is emptied, anything else is left alone."""
    if folder.exists():
        if not (folder / "logs").is_dir():
            raise ParameterError(f"{folder}: exists already; choose another --output")
        shutil.rmtree(folder)
    return folder


def start(robot: steps.Robot, motors: Path | None = None, rate: float = 200.0) -> None:
    """Start the simulated robot and wait until it reports; its controllers stay inactive."""
    processes, client = robot.processes, robot.client
    file = (motors or find_config(PAPER_MOTORS)).resolve()
    given = ["--ros-args", "-p", f"motors_file:={file}", "-p", f"rate:={rate}"]
    processes.start("motor_plant", "motor_plant", *given, priority=1)
    processes.start("skid_steer", "skid_steer", priority=1)
    robot.start_controllers(WHEELS)
    client.wait_for_nodes(["motor_plant", "skid_steer"], timeout=steps.TIMEOUT_S)
    client.wait_for_wheels(robot.wheels, timeout=steps.TIMEOUT_S)


def _compare_with_truth(entry: MotorEntry, estimate: Estimate) -> list[tuple[str, float, Quantity]]:
    """Return name, truth and estimate of every quantity that the estimate claims to know."""
    held = {**estimate.combinations, **estimate.parameters}
    names = (*COMBINATIONS, *PHYSICAL) if entry.knows_current else COMBINATIONS
    truth = {name: float(getattr(entry.parameters, name)) for name in names}
    return [(n, t, held[n]) for n, t in truth.items() if n in held and held[n].value is not None]


def print_results(
    truth: Mapping[str, MotorEntry], designed: driving.DesignSet, changes: Sequence[Change]
) -> None:
    """Print one table per wheel."""
    out = console()
    for wheel, estimate in designed.estimates.items():
        title = f"{words.label(wheel)}: {words.model(estimate.model)}"
        made = table(title, "", "true", "identified", "error/std")
        compared = _compare_with_truth(truth[wheel], estimate)
        for name, true, quantity in compared:
            std, error = quantity.std or 0.0, (quantity.value or 0.0) - true
            made.add_row(
                name,
                words.state(Quantity(true, unit=quantity.unit)),
                words.state(quantity),
                f"{error / std:+.1f}" if std else "",
            )
        shares = (f"{n} {words.systematic(q)}" for n, _, q in compared if q.systematic)
        mine = designed.gains[wheel]
        text = ", ".join(f"{n} {mine[n]:.4g}" for n in GAINS if mine.get(n))
        columns = ("change", "to", "settling", "predicted", "overshoot", "predicted")
        driven = table("", *columns)
        for one in (change for change in changes if change.wheel == wheel):
            pairs = (one.reading, one.expected)
            settled = (f"{1e3 * x.settling:.0f} ms" for x in pairs)
            overshoot = (f"{x.overshoot:.2f} %" for x in pairs)
            driven.add_row(one.name, f"{one.setpoint:+.2f} rad/s", *settled, *overshoot)
        out.print(made)
        out.print(f"systematic: {'; '.join(shares) or 'none'}", soft_wrap=True)
        out.print(f"gains (volts, wheel rad/s): {text}", soft_wrap=True)
        out.print(driven)


def check_estimates(
    truth: Mapping[str, MotorEntry], estimates: Mapping[str, Estimate]
) -> list[Check]:
    """Check the identified motors against the limits."""
    gain, deviation = [], []
    beyond = set()
    for wheel in estimates:
        timing = next((s.moves for s in estimates[wheel].systematic if s.cause == "timing"), {})
        for name, true, quantity in _compare_with_truth(truth[wheel], estimates[wheel]):
            error = abs((quantity.value or math.nan) - true)
            if name == "dc_gain":
                gain.append((100.0 * error / true, wheel))
            if quantity.status == "estimated":
                std = math.hypot(quantity.std or 1e-300, timing.get(name, 0.0))
                deviations = error / std
                deviation.append((deviations, f"{wheel} {name}"))
                if not deviations <= MAX_DEVIATIONS:
                    beyond.add(wheel)
    return [
        _worst("error of the DC gain", gain, MAX_GAIN_ERROR, "%"),
        _worst("error of a parameter", deviation, WORST_DEVIATIONS, UNIT),
        Check("wheels with an error beyond 3", len(beyond), 1, ", ".join(beyond) or "-", "wheels"),
    ]


def check_drive(changes: Sequence[Change]) -> list[Check]:
    """Check the wheels' responses against the limits."""
    every = [(f"{one.wheel} {one.name}", one) for one in changes]
    over = [(one.reading.overshoot, where) for where, one in every]
    late = [(1e3 * (one.reading.settling - one.expected.settling), where) for where, one in every]
    return [
        _worst("overshoot", over, MAX_OVERSHOOT, "%"),
        _worst("settling after its prediction", late, MAX_SETTLING_EXCESS, "ms"),
    ]


def _worst(name: str, found: Sequence[tuple[float, str]], limit: float, unit: str) -> Check:
    """Return the largest figure; one that does not exist (NaN), or none at all, is worst."""
    figure, where = max(
        found, key=lambda one: math.inf if math.isnan(one[0]) else one[0], default=(math.nan, "-")
    )
    return Check(name, figure, limit, where, unit)
