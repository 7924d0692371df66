# SPDX-License-Identifier: Apache-2.0
"""Run ``commission``: check, record, identify, tune and verify a running robot.

Results of the checks, recordings, identification and gains are stored as soon as each is complete.
A resumed run does the rest at the same voltages, and gives the same results.
"""

import argparse
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from smp_motor_control import WHEELS, get_controller_name
from smp_motor_control.motor.file import load_motors
from smp_motor_control.wheel.protection import Bounds
from smp_motor_ident.bag.read import read_experiments
from smp_motor_ident.cli import (
    checking,
    commission,
    commissioning_log,
    driving,
    identify,
    plan,
    steps,
    tune,
)
from smp_motor_ident.cli.commissioning_log import CommissioningLog
from smp_motor_ident.cli.processes import ProcessError, Processes, connect
from smp_motor_ident.commission import recordings
from smp_motor_ident.errors import ParameterError
from smp_motor_ident.finding import Finding
from smp_motor_ident.infer.validation import simulate
from smp_motor_ident.limits import MAX_SPEED_RATIO
from smp_motor_ident.report.document import read_identification
from smp_motor_ident.result import Estimate

AMPLITUDE, DURATION = 6.0, 15.0
"""Largest voltage [V] and length of a signal [s], unless the user or an earlier run says so."""

UNFINISHED = "recording"  # folder of a recording until it is complete
DISCOVERY_S = 2.0  # time in which a running controller is discovered [s]
REPORT_TIMEOUT_S = 15.0  # of the first states of all wheels
UNRELIABLE = "unreliable_identification"
"""Code of the finding on an identification unsuitable for design."""


_say = partial(print, flush=True)


@dataclass
class Session:
    """A commissioning under way: its request, its robot, and its progress."""

    arguments: argparse.Namespace
    robot: steps.Robot
    log: CommissioningLog
    schedule: plan.Schedule

    def begin(self, part: str, how: str = "") -> None:
        """Print the next part, and the remaining time."""
        _say(self.schedule.begin(part, how))


def work(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    folder = _prepare_folder(arguments)
    known = load_motors(arguments.motors) if arguments.motors else {}
    log = CommissioningLog(folder, arguments.accept)
    # Missing arguments are those of the run that is resumed, or the defaults.
    earlier = log.document.get("asked", {})
    arguments.wheel = arguments.wheel or earlier.get("wheels")
    arguments.amplitude = arguments.amplitude or earlier.get("amplitude", AMPLITUDE)
    arguments.duration = arguments.duration or earlier.get("duration", DURATION)
    if arguments.dry_run:
        wheels = arguments.wheel or WHEELS
        print("\n".join(plan.draw_plan(arguments.amplitude, arguments.duration, wheels)))
        return 0
    try:
        return _commission(arguments, folder, known)
    finally:
        if folder.is_dir() and not (folder / commissioning_log.NAME).exists():
            shutil.rmtree(folder)  # it holds only logs; the wheels never moved


def _commission(arguments: argparse.Namespace, folder: Path, known: Mapping[str, Any]) -> int:
    ros = tuple(arguments.ros_arguments)
    bounds = {"max_speed": arguments.max_speed or 0.0, "max_current": arguments.max_current}
    # The client exits last, so that excite has ended when the controllers are restored.
    with connect(commission.NAME, ros) as client, Processes(folder / "logs") as processes:
        _say("looking for the wheels that report, which takes some 5 s")
        wheels = tuple(dict.fromkeys(arguments.wheel or ())) or client.find_wheels()
        robot = steps.Robot(processes, client, wheels or WHEELS, folder, ros, bounds)
        rates = client.wait_for_wheels(robot.wheels, REPORT_TIMEOUT_S)
        print("; ".join(f"{wheel} reports at {rate:.0f} Hz" for wheel, rate in rates.items()))
        session = _begin(arguments, robot)
        if session is None:
            return 0
        with client.paused(robot.wheels), session.log.store_error():
            if not session.log.has("checked"):
                _check(session, known)
            for one in _recordings(arguments, session.log):
                if not _is_recorded(robot, one):
                    _record(session, one)
            designed = _design(session)
            verdict = _verify(session, designed)
    session.log.store_verdict(True, verdict)
    print("\n".join(session.log.summary()))
    print(f"{verdict}\nreport: {folder / 'report.html'}")
    if not arguments.apply:
        results = folder / "identification"
        print(f"to use the gains: tune {results} --apply, or --params-file {folder / 'gains.yaml'}")
    return 0


def _begin(arguments: argparse.Namespace, robot: steps.Robot) -> Session | None:
    """Ask before anything moves; discard results at other voltages or of other wheels."""
    log = CommissioningLog(robot.folder, arguments.accept)
    asked = {name: getattr(arguments, name) for name in ("amplitude", "duration")}
    asked["wheels"] = list(robot.wheels)
    same = log.document.get("asked") == asked
    if same and log.passed_verdict and not arguments.apply:
        _say(f"nothing is left to do: it passed. {log.passed_verdict}")
        return None
    if not same:
        if "asked" in log.document:
            _say("wheels, amplitude or duration have changed: all steps are repeated")
        log.begin(robot.wheels, asked)
    left = [one for one in _recordings(arguments, log) if not (same and _is_recorded(robot, one))]
    computed = {part: not left and log.has(part) for part in ("identified", "tuned")}
    schedule = plan.schedule(robot.wheels, left, checked=log.has("checked"), **computed)
    session = Session(arguments, robot, log, schedule)
    _report_missing_controllers(arguments, robot)
    _confirm(arguments, robot.wheels, left, schedule)
    if not same:
        for name in (plan.FITTED, plan.HELD_OUT):
            shutil.rmtree(robot.folder / name, ignore_errors=True)
        log.write()
    return session


def _report_missing_controllers(arguments: argparse.Namespace, robot: steps.Robot) -> None:
    """Report wheels without a controller; each gets one for the drive."""
    robot.client.until(lambda: not robot.uncontrolled(), DISCOVERY_S)
    missing = ", ".join(robot.uncontrolled())
    if missing and arguments.apply:
        raise ParameterError(
            f"no wheel_pid runs for {missing}: --apply has no controller to leave the gains in; "
            "start it, or leave out --apply"
        )
    if missing:
        _say(f"no wheel_pid runs for {missing}: one is started for the drive and ended after it")


def _recordings(arguments: argparse.Namespace, log: CommissioningLog) -> list[plan.Recording]:
    """Return the recordings, at the voltage found by the checks or, before them, at the limit."""
    amplitude = log.document["amplitude"] if log.has("checked") else arguments.amplitude
    return plan.recordings(amplitude, arguments.duration)


def _is_recorded(robot: steps.Robot, one: plan.Recording) -> bool:
    return (robot.folder / one.folder / one.name).is_dir()


def _check(session: Session, known: Mapping[str, Any]) -> None:
    """Check the wheels one by one; stop at faults that the user must repair."""
    arguments, robot, log = session.arguments, session.robot, session.log
    bounds = Bounds(speed=arguments.max_speed or 0.0, current=arguments.max_current)
    checked = checking.check_wheels(
        robot.client, robot.wheels, arguments.amplitude, bounds, known,
        lambda wheel: session.begin(f"checking {wheel}"),
    )  # fmt: skip
    log.store_checks(checked.figures, checked.amplitude, checked.speed)
    log.stop_on(log.add("checks", checked.findings))
    log.mark(checked=True)


def _record(session: Session, one: plan.Recording) -> None:
    """Record the wheels under one signal; stop them at the end in any case."""
    arguments, robot = session.arguments, session.robot
    robot.client.wait_for_wheels(robot.wheels, REPORT_TIMEOUT_S)
    speed = session.log.document.get("speed")
    if speed and not arguments.max_speed:
        fastest = MAX_SPEED_RATIO * float(speed)
        robot = replace(robot, bounds={**robot.bounds, "max_speed": fastest})
    session.begin(one.part, one.describe())
    draft = robot.folder / UNFINISHED
    shutil.rmtree(draft, ignore_errors=True)
    try:
        steps.record(robot, UNFINISHED)
        steps.excite(robot, one.excitation)
    finally:
        robot.processes.stop("excite", "record")
    log = session.log
    log.mark(identified=False, judged=False, tuned=False)
    (robot.folder / one.folder).mkdir(exist_ok=True)
    draft.rename(robot.folder / one.folder / one.name)
    earlier = [r for r in _recordings(arguments, log) if r != one and _is_recorded(robot, r)]
    log.stop_on(log.add(one.part, find_hot_windings(robot.folder, earlier, one)))


def find_hot_windings(
    folder: Path, earlier: Sequence[plan.Recording], last: plan.Recording
) -> list[Finding]:
    """Return a finding for each winding that must cool before the next signal."""
    before, now = (
        read_experiments([str(folder / r.folder / r.name) for r in some]) if some else {}
        for some in (earlier, [last])
    )
    return [
        f
        for w in now
        if w in before
        for f in recordings.report_heated_winding(w, before[w], now[w][0])
    ]


def _design(session: Session) -> driving.DesignSet:
    """Identify and tune, skipping completed steps; write each result in one piece."""
    arguments, robot, log = session.arguments, session.robot, session.log
    folder, gains = robot.folder, robot.folder / "gains.yaml"
    known = (folder / plan.FITTED / plan.EXTRA).is_dir()
    estimates = _identify(session, plan.IDENTIFYING)
    more = None if known else plan.plan_extra_recording(estimates, arguments.amplitude)
    if more:
        session.schedule.add(more.part, "signal", more.excitation.duration + plan.START_S)
        session.schedule.add(plan.IDENTIFYING_AGAIN, "identify", plan.COMPUTE_S * len(robot.wheels))
        _record(session, more)
        estimates = _identify(session, plan.IDENTIFYING_AGAIN)
    if not log.has("judged"):
        log.add("identification", report_unreliable_motors(estimates))
        log.add(
            "validation", validate_motors(estimates, folder / plan.FITTED, folder / plan.HELD_OUT)
        )
        log.mark(judged=True)
    log.stop_on(log.find_blocking("identification") or log.find_blocking("validation"))
    if not log.has("tuned"):
        session.begin(plan.TUNING)
        accepted = ["--accept-unreliable"] if UNRELIABLE in arguments.accept else []
        results = str(folder / "identification")
        steps.run(tune, results, "--output", str(gains), "--force", *accepted)
        log.mark(tuned=True)
    return driving.read_designs(estimates, gains)


def _identify(session: Session, part: str) -> dict[str, Estimate]:
    """Identify from all recordings, unless that is done."""
    robot, log = session.robot, session.log
    results = robot.folder / "identification"
    if log.has("identified"):
        return read_identification(results)
    session.begin(part)
    fitted, held_out = (str(robot.folder / name) for name in (plan.FITTED, plan.HELD_OUT))
    wheels = [part for wheel in robot.wheels for part in ("--wheel", wheel)]
    try:
        steps.run(
            identify, fitted, "--output", str(results), "--validate", held_out, *wheels,
            "--force", "--quiet", "--accept-unreliable",
        )  # fmt: skip
    except ProcessError:
        if (results / "identification.json").is_file():
            log.stop_on(
                log.add("identification", report_unreliable_motors(read_identification(results)))
            )
        raise
    log.mark(identified=True, judged=False, tuned=False)
    return read_identification(results)


def _verify(session: Session, designed: driving.DesignSet) -> str:
    """Drive with the gains on trial, check the drive, and return the outcome."""
    robot, log = session.robot, session.log
    robot.client.wait_for_wheels(robot.wheels, REPORT_TIMEOUT_S)
    session.schedule.add(
        plan.DRIVING, "drive", plan.START_S + sum(one[2] for one in driving.plan_drive(designed))
    )
    session.begin(plan.DRIVING)
    own = robot.uncontrolled()
    gains = {get_controller_name(wheel): new for wheel, new in designed.gains.items()}
    try:
        robot.start_controllers(own)
        with driving.on_trial(robot.client, gains):
            changes, findings = driving.drive_undisturbed(robot, designed, _say)
        log.store_changes(changes)
        refused = log.add("verification", findings)
        if kept := session.arguments.apply and not refused:
            robot.client.set_parameters(gains)
    finally:
        robot.processes.stop(*(f"{wheel}.wheel_pid" for wheel in own))
    if refused:
        print("the previous gains were restored")
        refused += log.find_warnings({f.evidence.get("wheel") for f in refused})
    log.stop_on(refused)
    did = "The wheels drove as designed"
    if accepted := [f for f in findings if f.severity == "refused"]:
        did = f"The wheels drove, and {len(accepted)} findings of the drive were accepted"
    now = "the controllers have their former gains again"
    if own:
        now = f"the wheel_pid that was started for {', '.join(own)} has ended"
    return f"{did}; {'the gains are set in the running controllers' if kept else now}."


def report_unreliable_motors(estimates: Mapping[str, Estimate]) -> list[Finding]:
    """Return the reasons against a design on the identified motors."""
    return [
        Finding(UNRELIABLE, "refused", f"{wheel}: {one.message}", one.evidence, one.advice)
        for wheel, estimate in estimates.items()
        for one in estimate.findings
        if one.severity in ("unreliable", "refused")
    ]


def validate_motors(
    estimates: Mapping[str, Estimate], fitted: Path, held_out: Path
) -> list[Finding]:
    """Validate every motor on the held-out run."""
    found = []
    read = {path: read_experiments([str(path)]) for path in (fitted, held_out)}
    for wheel, one in estimates.items():
        parts = [
            [recordings.SimulatedRun(r.time, *simulate(one, r)) for r in read[path][wheel]]
            for path in (fitted, held_out)
        ]
        found.append(recordings.judge(wheel, *parts))
    return found


def _prepare_folder(arguments: argparse.Namespace) -> Path:
    """Return the folder, or refuse before anything starts."""
    folder = Path(arguments.output)
    there = {path.name for path in folder.iterdir()} if folder.is_dir() else {folder.name}
    if folder.exists() and there <= {"logs"}:  # a run was killed before it moved the wheels
        return folder
    if folder.exists() and not arguments.resume:
        raise ParameterError(
            f"{folder}: exists already; choose another --output, or go on there with --resume"
        )
    if arguments.resume and commissioning_log.NAME not in there:
        raise ParameterError(f"{folder}: holds no interrupted commissioning; leave out --resume")
    return folder


def _confirm(
    arguments: argparse.Namespace,
    wheels: Sequence[str],
    left: Sequence[plan.Recording],
    schedule: plan.Schedule,
) -> None:
    """Ask before anything moves."""
    if arguments.yes:
        return
    if not sys.stdin.isatty():
        raise ParameterError("the wheels will move; confirm with --yes, or run this in a terminal")
    seconds = sum(one.excitation.duration for one in left)
    excited = f"for {seconds:.0f} s at up to {arguments.amplitude:g} V, then " if left else ""
    print(
        f"{', '.join(wheels)} will turn both ways {excited}in a drive on the new gains; all takes "
        f"about {plan.format_duration(schedule.left())}. Is the robot on blocks and clear of "
        "people? [y/N] ",
        end="",
        flush=True,
    )
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise ProcessError("nothing was moved")
