"""What ``commission`` does: the whole way on the user's own running robot."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from smp_motor_control import WHEELS
from smp_motor_control.excitation import SIGNALS as SHAPES
from smp_motor_ident.cli import steps
from smp_motor_ident.cli.commission import NAME
from smp_motor_ident.cli.processes import ProcessError, Processes, connect
from smp_motor_ident.errors import ParameterError

BEGUN, EXCITED = "excitation.begun", "excitation.complete"
"""Mark in the folder that signals were sent, and that all of them were recorded."""

SIGNALS = ("sine", "square", "fourier")

DRAWN, COLUMNS, BLOCKS = 4.0, 72, "▁▂▃▄▅▆▇█"
"""So many seconds of a signal are drawn, on so many columns, with these levels."""


def work(arguments: argparse.Namespace) -> int:
    """Do what the arguments say."""
    folder, wheels, plan = _checked(arguments)
    if arguments.dry_run:
        print("\n".join(drawn(plan)))
        return 0
    try:
        return _commission(arguments, folder, wheels, plan)
    finally:
        moved = any((folder / name).exists() for name in ("excitation", EXCITED))
        if folder.is_dir() and not moved:
            shutil.rmtree(folder)  # nothing but logs of what did not begin


def _commission(
    arguments: argparse.Namespace,
    folder: Path,
    wheels: tuple[str, ...],
    plan: Sequence[steps.Excitation],
) -> int:
    ros = tuple(arguments.ros_arguments)
    # The client leaves last: who excites has ended when the controllers are given back.
    with connect(NAME, ros) as client, Processes(folder / "logs") as processes:
        wheels = wheels or tuple(client.find_wheels()) or WHEELS
        robot = steps.Robot(processes, client, wheels, folder, ros)
        rates = client.wait_for_wheels(wheels, timeout=15.0)
        print("; ".join(f"{wheel} reports at {rate:.0f} Hz" for wheel, rate in rates.items()))
        recorded, results = folder / EXCITED, folder / "identification"
        if not recorded.exists():
            _confirm(arguments, wheels)
        with client.paused(wheels):
            if not recorded.exists():
                begun = folder / BEGUN
                if begun.exists():
                    shutil.rmtree(folder / "excitation", ignore_errors=True)
                begun.touch()
                _excited(robot, plan)
                begun.rename(recorded)
            # What identify and tune write appears as a whole, and is written anew.
            again = ["--force"] if arguments.resume else []
            options = [*again, *(["--tuning"] if arguments.tuning else [])]
            steps.identify_wheels(folder / "excitation", results, *options)
            gains = steps.tune_wheels(results, folder / "gains.yaml", *again)
            if arguments.apply:
                steps.set_gains(robot, gains)
                print("gains set in the running controllers")
    print(f"report: {results / 'report.html'}")
    if not arguments.apply:
        print(f"to use the gains: tune {results} --apply, or --params-file {folder / 'gains.yaml'}")
    return 0


def _checked(
    arguments: argparse.Namespace,
) -> tuple[Path, tuple[str, ...], list[steps.Excitation]]:
    """Return folder, wheels and signals, or refuse before anything starts."""
    folder = Path(arguments.output)
    if folder.exists() and not arguments.resume:
        raise ParameterError(
            f"{folder}: exists already; choose another --output, or go on there with --resume"
        )
    if arguments.resume and not any((folder / name).exists() for name in (BEGUN, EXCITED)):
        raise ParameterError(f"{folder}: no commissioning was cut off there; leave out --resume")
    wheels = tuple(dict.fromkeys(arguments.wheel or ()))
    shares = {"sine": 0.75, "square": 0.75, "fourier": 1.0}
    plan = [
        steps.Excitation(signal, arguments.duration, shares[signal] * arguments.amplitude)
        for signal in SIGNALS
    ]
    return folder, wheels, plan


def drawn(plan: Sequence[steps.Excitation]) -> list[str]:
    """Return the plan in words, each signal with its first seconds as a line of blocks."""
    lines, begin = [], 0.0
    for part in plan:
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
    lines.append(f"then: identify, tune; {begin:g} s of motion in all. Nothing was moved.")
    return lines


def _confirm(arguments: argparse.Namespace, wheels: Sequence[str]) -> None:
    """Ask before anything moves."""
    if arguments.yes:
        return
    if not sys.stdin.isatty():
        raise ParameterError("the wheels would move: say --yes, or run this in a terminal")
    seconds = len(SIGNALS) * arguments.duration
    print(
        f"{', '.join(wheels)} will turn both ways for {seconds:.0f} s at up to "
        f"{arguments.amplitude:g} V. Is the robot on blocks and clear of people? [y/N] ",
        end="",
        flush=True,
    )
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise ProcessError("nothing was moved")


def _excited(robot: steps.Robot, plan: Sequence[steps.Excitation]) -> Path:
    """Return the recording of excited wheels; whatever happens, nobody moves them afterwards."""
    try:
        bag = steps.record(robot, "excitation")
        for part in plan:
            print(f"exciting: {part.signal}, {part.amplitude:g} V, {part.duration:g} s")
            steps.excite(robot, [part])
        return bag
    finally:
        robot.processes.stop("excite", "record")
