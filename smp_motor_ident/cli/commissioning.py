"""What ``commission`` does: the whole way on the user's own running robot."""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from smp_motor_control import WHEELS
from smp_motor_control.excitation import SIGNALS as SHAPES
from smp_motor_control.motor.file import load_motors
from smp_motor_control.wheel.protection import Bounds
from smp_motor_ident import bag
from smp_motor_ident.cli import checking, steps, verifying
from smp_motor_ident.cli.commission import NAME
from smp_motor_ident.cli.processes import ProcessError, Processes, connect
from smp_motor_ident.cli.protocol import Protocol
from smp_motor_ident.diagnosis import validation_run
from smp_motor_ident.diagnosis.wheel_limits import OVER_SPEED
from smp_motor_ident.errors import ParameterError
from smp_motor_ident.estimation.simulation import simulate
from smp_motor_ident.finding import Finding
from smp_motor_ident.report.document import read_identification
from smp_motor_ident.result import Estimate

BEGUN, EXCITED = "excitation.begun", "excitation.complete"
"""Mark in the folder that wheels were moved, and that all signals were recorded."""

BAGS = ("excitation", "validation")
"""Recordings that motors are identified from, and that they are judged by."""

SIGNALS = (
    ("sine", 0.75, 1.0, "excitation"),
    ("square", 0.75, 1.0, "excitation"),
    ("fourier", 1.0, 1.0, "excitation"),
    ("steps", 1.0, 0.5, "validation"),
)
"""What moves the wheels: signal, shares of amplitude and duration, and whose recording."""

COLD = "cold.json"
"""Resistances of the windings before the first signal, for ``excite``."""

LOOKS, ALIKE = 15, 4
"""Wheels are looked for at most so often, until so many looks [1 s each] find the same."""

UNRELIABLE = "unreliable_identification"
"""Code of the finding that an identification is not to be designed on."""

DRAWN, COLUMNS, BLOCKS = 4.0, 72, "▁▂▃▄▅▆▇█"
"""So many seconds of a signal are drawn, on so many columns, with these levels."""


def work(arguments: argparse.Namespace) -> int:
    """Do what the arguments say."""
    folder = _checked(arguments)
    known = load_motors(arguments.motors) if arguments.motors else {}
    if arguments.dry_run:
        print("\n".join(drawn(arguments.amplitude, arguments.duration)))
        return 0
    try:
        return _commission(arguments, folder, known)
    finally:
        if folder.is_dir() and not any((folder / n).exists() for n in (BEGUN, EXCITED)):
            shutil.rmtree(folder)  # nothing but logs of what did not begin


def _commission(arguments: argparse.Namespace, folder: Path, known: Mapping[str, Any]) -> int:
    ros = tuple(arguments.ros_arguments)
    bounds: dict[str, object] = {
        "max_speed": arguments.max_speed or 0.0,
        "max_current": arguments.max_current,
        "max_winding_rise": arguments.max_winding_rise,
        "cold_file": folder.resolve() / COLD,
    }
    # The client leaves last: who excites has ended when the controllers are given back.
    with connect(NAME, ros) as client, Processes(folder / "logs") as processes:
        wheels = tuple(dict.fromkeys(arguments.wheel or ())) or _found(client)
        robot = steps.Robot(processes, client, wheels or WHEELS, folder, ros, bounds)
        rates = client.wait_for_wheels(robot.wheels, timeout=15.0)
        print("; ".join(f"{wheel} reports at {rate:.0f} Hz" for wheel, rate in rates.items()))
        if not (folder / EXCITED).exists():
            _confirm(arguments, robot.wheels)
        protocol = Protocol(folder, arguments.accept)
        with client.paused(robot.wheels), protocol.ending():
            if not (folder / EXCITED).exists():
                _move(arguments, robot, protocol, known)
            designed = _design(arguments, robot, protocol)
            verdict = _verify(arguments, robot, protocol, designed)
    protocol.end(True, verdict)
    print(f"{verdict}\nreport: {folder / 'report.html'}")
    if not arguments.apply:
        results = folder / "identification"
        print(f"to use the gains: tune {results} --apply, or --params-file {folder / 'gains.yaml'}")
    return 0


def _move(
    arguments: argparse.Namespace, robot: steps.Robot, protocol: Protocol, known: Mapping[str, Any]
) -> None:
    """Check the wheels, then record them excited; whatever happens, nobody moves them behind it."""
    folder = robot.folder
    for name in BAGS:
        shutil.rmtree(folder / name, ignore_errors=True)
    (folder / BEGUN).touch()
    protocol.begin(robot.wheels)
    bounds = Bounds(
        speed=arguments.max_speed or math.inf,
        current=arguments.max_current or math.inf,
        rise=arguments.max_winding_rise,
    )
    checked = checking.check_wheels(
        robot.client, robot.wheels, arguments.amplitude, bounds, known, _say
    )
    if not arguments.max_speed and math.isfinite(checked.speed):
        fastest = OVER_SPEED.value * checked.speed
        robot = replace(robot, bounds={**robot.bounds, "max_speed": fastest})
    protocol.checks(checked.figures, checked.amplitude)
    protocol.stop(protocol.add("checks", checked.findings))
    protocol.write()
    for name in BAGS:
        try:
            steps.record(robot, name)
            for part in plan(checked.amplitude, arguments.duration, name):
                _say(f"exciting: {part.signal}, {part.amplitude:.3g} V, {part.duration:g} s")
                steps.excite(robot, [part])
        finally:
            robot.processes.stop("excite", "record")
    (folder / BEGUN).rename(folder / EXCITED)


def _design(
    arguments: argparse.Namespace, robot: steps.Robot, protocol: Protocol
) -> verifying.Designed:
    """Identify and tune; what they write appears as a whole, and is written anew."""
    folder, results = robot.folder, robot.folder / "identification"
    fitted, unseen = (folder / name for name in BAGS)
    again = ["--force"] if arguments.resume else []
    again += ["--accept-unreliable"] if UNRELIABLE in arguments.accept else []
    options = [*again, *(["--tuning"] if arguments.tuning else []), "--validate", str(unseen)]
    options += [part for wheel in robot.wheels for part in ("--wheel", wheel)]
    try:
        estimates = steps.identify_wheels(fitted, results, *options)
    except ProcessError:
        protocol.stop(protocol.add("identification", unreliable(results)))
        raise
    protocol.stop(protocol.add("validation", validated(estimates, fitted, unseen)))
    gains = steps.tune_wheels(results, folder / "gains.yaml", *again)
    document = json.loads((folder / "gains.json").read_text("utf-8"))["wheels"]
    return verifying.Designed(estimates, gains, document)


def _verify(
    arguments: argparse.Namespace,
    robot: steps.Robot,
    protocol: Protocol,
    designed: verifying.Designed,
) -> str:
    """Drive with the gains on trial, judge the drive, and return what became of them."""
    missing = [w for w in robot.wheels if not _controlled(robot, w)]
    if missing and arguments.apply:
        raise ProcessError(f"{', '.join(missing)}: no wheel_pid runs that could take the gains")
    if missing:
        protocol.add("verification", [Finding(
            "not_verified", "warning",
            f"no wheel_pid runs for {', '.join(missing)}: the gains have not driven yet", {},
            "start the controllers and commission again with --resume",
        )])  # fmt: skip
        return "Gains are designed, and have not driven yet."
    with verifying.on_trial(robot.client, designed.gains) as trial:
        changes, findings = verifying.drive_undisturbed(robot, designed, _say)
        protocol.changes(changes)
        refused = protocol.add("verification", findings)
        trial.kept = arguments.apply and not refused
    if refused:
        print("the gains were taken back")
        refused += protocol.warned_of({f.evidence.get("wheel") for f in refused})
    protocol.stop(refused)
    return "The wheels did as designed" + (
        "; the gains are set in the running controllers."
        if trial.kept
        else "; the controllers have their former gains again."
    )


def _found(client: Any) -> tuple[str, ...]:
    """Return the wheels that report: a busy machine's are discovered seconds apart."""
    looks: list[tuple[str, ...]] = []
    while len(looks) < LOOKS:
        looks.append(tuple(client.find_wheels()))
        if looks[-1] and looks[-ALIKE:] == [looks[-1]] * ALIKE:
            break
    return looks[-1]


def _controlled(robot: steps.Robot, wheel: str) -> bool:
    node = robot.client.node
    return bool(node.count_services(node.resolve_service_name(f"{wheel}/wheel_pid/change_state")))


def unreliable(results: Path) -> list[Finding]:
    """Return why motors that were identified are not to be designed on."""
    if not (results / "identification.json").is_file():
        return []
    return [
        Finding(UNRELIABLE, "refused", f"{wheel}: {one.message}", one.evidence, one.advice)
        for wheel, estimate in read_identification(results).items()
        for one in estimate.findings
        if one.severity in ("unreliable", "refused")
    ]


def validated(estimates: Mapping[str, Estimate], fitted: Path, unseen: Path) -> list[Finding]:
    """Judge every motor by a run that its fit has not seen."""
    found = []
    read = {path: bag.read_experiments([str(path)]) for path in (fitted, unseen)}
    for wheel, one in estimates.items():
        parts = {
            path: [
                validation_run.Simulated(record.time, *simulate(one, record))
                for record in records[wheel]
            ]
            for path, records in read.items()
        }
        found.append(validation_run.judge(wheel, parts[fitted], parts[unseen]))
    return found


def _checked(arguments: argparse.Namespace) -> Path:
    """Return the folder, or refuse before anything starts."""
    folder = Path(arguments.output)
    if folder.exists() and not arguments.resume:
        raise ParameterError(
            f"{folder}: exists already; choose another --output, or go on there with --resume"
        )
    if arguments.resume and not any((folder / name).exists() for name in (BEGUN, EXCITED)):
        raise ParameterError(f"{folder}: no commissioning was cut off there; leave out --resume")
    return folder


def plan(amplitude: float, duration: float, of: str = "") -> list[steps.Excitation]:
    """Return the signals of one recording, or of all."""
    return [
        steps.Excitation(signal, lasts * duration, share * amplitude)
        for signal, share, lasts, recording in SIGNALS
        if of in ("", recording)
    ]


def drawn(amplitude: float, duration: float) -> list[str]:
    """Return the plan in words, each signal with its first seconds as a line of blocks."""
    lines = [
        f"first: each wheel alone, slowly until it turns, then at growing voltages up to "
        f"{amplitude:g} V, both ways; signs, gearing, dead zone, supply and load are checked"
    ]
    begin = 0.0
    for part in plan(amplitude, duration):
        signal = SHAPES[part.signal](amplitude=part.amplitude)
        shown = min(part.duration, DRAWN)
        level = signal(np.arange(COLUMNS, dtype=np.float64) * (shown / COLUMNS)) / part.amplitude
        bars = "".join(BLOCKS[round((1 + float(v)) / 2 * (len(BLOCKS) - 1))] for v in level)
        lines.append(
            f"from {begin:5.1f} s: {part.signal}, up to {part.amplitude:g} V either way, "
            f"{part.duration:g} s; its first {shown:g} s:"
        )
        lines.append(f"  {bars}")
        begin += part.duration
    lines.append(
        f"then: identify, tune, and a drive of all wheels with the gains on trial; {begin:g} s of "
        "excitation in all. Nothing was moved."
    )
    return lines


def _confirm(arguments: argparse.Namespace, wheels: Sequence[str]) -> None:
    """Ask before anything moves."""
    if arguments.yes:
        return
    if not sys.stdin.isatty():
        raise ParameterError("the wheels would move: say --yes, or run this in a terminal")
    seconds = sum(part.duration for part in plan(arguments.amplitude, arguments.duration))
    print(
        f"{', '.join(wheels)} will turn both ways for {seconds:.0f} s at up to "
        f"{arguments.amplitude:g} V. Is the robot on blocks and clear of people? [y/N] ",
        end="",
        flush=True,
    )
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise ProcessError("nothing was moved")


def _say(text: str) -> None:
    print(text, flush=True)
