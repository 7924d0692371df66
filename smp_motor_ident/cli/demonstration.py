# SPDX-License-Identifier: Apache-2.0
"""Run ``demo``: commission a simulated robot, and compare the results with its true motors."""

import argparse
import shutil
import signal
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from smp_motor_control import WHEELS
from smp_motor_control.motor.file import PAPER_MOTORS, find_config, load_motors
from smp_motor_ident.cli import commission, demo, driving, steps, verdict
from smp_motor_ident.cli.processes import Processes, connect, isolate
from smp_motor_ident.cli.workers import die_with_parent
from smp_motor_ident.errors import ParameterError
from smp_motor_ident.report.document import read_identification
from smp_motor_ident.report.drawing import Chart, Curve, document
from smp_motor_ident.tune.verification import smooth_speed

EXCITATION = ("--amplitude", "10", "--duration", "8")
"""Largest voltage [V] and length of a signal [s]."""

ACCEPTED = (
    "feedback_rate", "feedback_age", "validation_run", "verification", "verification_disturbed",
)  # fmt: skip
"""Findings of a busy computer, which do not end the demo: its own checks decide."""

MAX_STALL_S = 0.008  # pause of the computer beyond which the drive is shown, but not judged [s]


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
        print(f"running: motor_plant, {len(WHEELS)} wheel_pid, skid_steer (ROS domain {domain})")
        accepted = [part for code in ACCEPTED for part in ("--accept", code)]
        steps.run(commission, "--output", str(folder), *EXCITATION, *accepted, "--apply", "--yes")
    designed = driving.read_designs(
        read_identification(folder / "identification"), folder / "gains.yaml"
    )
    driven = driving.read_drive(folder / driving.RECORDING, WHEELS)
    (folder / "drive.svg").write_text(_draw_drive(driven, designed), encoding="utf-8")
    plan = driving.plan_drive(designed)
    changes = {w: driving.read_changes(w, one, plan, designed)[0] for w, one in driven.items()}
    verdict.print_results(truth, designed, changes)
    checks = verdict.check_estimates(truth, designed.estimates)
    gaps = (np.max(np.diff(one.state.seconds)) for one in driven.values())
    stall = max(*gaps, *(np.max(one.answers.columns["age"]) for one in driven.values()))
    if stall <= MAX_STALL_S:
        checks += verdict.check_drive(changes)
    else:
        print(f"---- the drive is not judged: the computer paused for {1e3 * stall:.0f} ms")
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
