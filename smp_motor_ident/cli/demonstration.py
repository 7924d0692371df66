# SPDX-License-Identifier: Apache-2.0
"""Run ``demo``: a simulated robot from four unknown motors to four tuned wheels."""

import argparse
import os
import shutil
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from smp_motor_control import LEFT, RIGHT, WHEELS, get_controller_name
from smp_motor_control.motor.file import PAPER_MOTORS, find_config, load_motors
from smp_motor_control.nodes import loopback
from smp_motor_ident.cli import demo, driving, plan, steps, verdict
from smp_motor_ident.cli.processes import Processes, connect, free_domain
from smp_motor_ident.cli.workers import die_with_parent
from smp_motor_ident.errors import ParameterError

PLAN = (
    steps.Excitation("sine", 8.0, 10.0),
    steps.Excitation("square", 8.0, 10.0),
    steps.Excitation("fourier", 14.0, 11.0),
)
"""Excitation of the wheels while they are recorded."""

DRIVE = (
    ("straight", 0.20, 0.0, 2.5),
    ("arc", 0.06, -0.20, 2.5),
    ("spin", 0.0, 1.0, 2.5),
    ("stop", 0.0, 0.0, 2.0),
)
"""Manoeuvres: name, m/s, rad/s, s."""

MAX_STALL_S = 0.008
"""Pause of the computer [s] after which a drive is repeated; the least disturbed drive is shown,
and judged only if its pauses are shorter."""

MAX_ATTEMPTS = 3


def work(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    die_with_parent(signal.SIGTERM)
    begun = time.monotonic()

    def say(text: str) -> None:
        print(f"[{time.monotonic() - begun:5.1f} s] {text}", flush=True)

    motors = Path(arguments.motors) if arguments.motors else find_config(PAPER_MOTORS)
    truth = load_motors(motors, WHEELS)
    folder = _clear_folder(Path(arguments.output))
    domain = free_domain() if arguments.domain is None else arguments.domain
    os.environ.update({"ROS_DOMAIN_ID": str(domain), **loopback.loopback_environment()})
    with Processes(folder / "logs") as processes, connect(demo.NAME) as client:
        robot = steps.Robot(processes, client, WHEELS, folder)
        start(robot, motors, arguments.rate)
        say(f"running: motor_plant, {len(WHEELS)} wheel_pid, skid_steer (ROS domain {domain})")
        designed = identify_and_tune(robot, say)
        driven, segments, stall = drive(robot, designed.gains, say)
    hardware = {wheel: designed.estimates[wheel].hardware for wheel in WHEELS}
    figure = driving.draw_drive(driven, {"left": LEFT, "right": RIGHT}, hardware)
    (folder / "drive.svg").write_text(figure, encoding="utf-8")
    changes = {
        w: driving.evaluate_changes(w, one, driving.find_moves(segments, one.answers), designed)[0]
        for w, one in driven.items()
    }
    verdict.print_results(truth, designed, changes)
    checks = verdict.check_estimates(truth, designed.estimates)
    if stall <= MAX_STALL_S:
        checks += verdict.check_drive(changes)
    else:
        print(f"---- the drive is not judged: the computer paused for {1e3 * stall:.0f} ms")
    for one in checks:
        mark = "ok  " if one.holds else "FAIL"
        print(f"{mark} {one.name}: {one.worst:.3g} {one.unit} at most {one.limit:g} ({one.where})")
    say("done")
    print(f"report: {folder / 'identification' / 'report.html'}")
    return 0 if all(one.holds for one in checks) else 1


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


def identify_and_tune(robot: steps.Robot, say: Any) -> driving.DesignSet:
    """Excite, record, identify and tune."""
    bag = steps.record(robot, "excitation")
    for part in PLAN:
        say(f"exciting all wheels: {part.signal}, {part.amplitude:g} V, {part.duration:g} s")
        steps.excite(robot, [part])
    robot.processes.stop("record")
    takes = plan.format_duration(plan.COMPUTE_S * len(robot.wheels))
    say(f"recorded {bag}; identifying, which takes about {takes}")
    results = robot.folder / "identification"
    estimates = steps.identify_wheels(bag, results, "--quiet")
    say(f"tuning, which takes about {takes}")
    gains = robot.folder / "gains.yaml"
    steps.tune_wheels(results, gains)
    return driving.read_designs(estimates, gains)


def drive(
    robot: steps.Robot, gains: Mapping[str, Mapping[str, Any]], say: Any
) -> tuple[dict[str, driving.DriveRecording], list[tuple[str, float, float]], float]:
    """Drive through :data:`DRIVE` with the gains; return recording, segments and stall [s]."""
    from smp_motor_control.nodes.driving import drive_body

    robot.client.set_parameters({get_controller_name(w): new for w, new in gains.items()})
    robot.switch("activate")
    lasts = plan.format_duration(sum(seconds for *_, seconds in DRIVE))
    say(f"gains set in the running controllers; driving for {lasts}")
    drives = []
    for attempt in range(1, MAX_ATTEMPTS + 1):
        name = "drive" if attempt == 1 else f"drive_{attempt}"
        bag = steps.record(robot, name, "motor_command", "pid_state")
        segments = drive_body(robot.client, DRIVE, robot.wheels)
        robot.processes.stop("record")
        read = driving.read_drive(bag, robot.wheels)
        stall = driving.find_longest_stall(read)
        drives.append((stall, name, read, segments))
        if stall <= MAX_STALL_S:
            break
        say(f"the computer paused for {1e3 * stall:.0f} ms during drive {attempt}")
    robot.switch("deactivate")
    stall, name, read, segments = min(drives, key=lambda one: one[0])
    say(f"showing {name}")
    return read, segments, stall
