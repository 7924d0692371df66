# SPDX-License-Identifier: Apache-2.0
"""Measure the cost of the page of ``lab`` on a robot with four wheels.

The same simulated robot drives alone, and while a page in headless Chromium watches it, in turns.
Every sample that a wheel answers tells how long its answer took (``age`` of ``PidState``).  A
sample is late if it is answered after the next one came.

    python benchmarks/lab.py [--rate 500] [--seconds 20] [--turns 2]
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "test")]

from browser import Browser  # noqa: E402

from smp_motor_control import WHEELS, get_controller_name  # noqa: E402
from smp_motor_control.motor.file import PAPER_MOTORS, find_config  # noqa: E402
from smp_motor_control.nodes.driving import drive_wheels  # noqa: E402
from smp_motor_ident.cli import applying, demonstration, driving, steps  # noqa: E402
from smp_motor_ident.cli.processes import Processes, connect, isolate  # noqa: E402

TICKS = os.sysconf("SC_CLK_TCK")


@dataclass
class Turn:
    """What one drive measured."""

    ages: np.ndarray  # of all answers [s]
    server: float = 0.0  # share of a processor
    browser: float = 0.0
    frames: list[float] = field(default_factory=list)  # a second


def processor_time(root: int) -> float:
    """Return the processor time of a process and its descendants [s]."""
    parents, times = {}, {}
    for one in Path("/proc").iterdir():
        if one.name.isdecimal():
            try:
                fields = (one / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            parents[int(one.name)], times[int(one.name)] = int(fields[1]), fields[11:13]
    family = {root}
    while more := {p for p, parent in parents.items() if parent in family} - family:
        family |= more
    return sum(int(t) for p in family for t in times.get(p, ())) / TICKS


@contextmanager
def watched(folder: Path, turn: Turn, seconds: float) -> Iterator[None]:
    """Let a page watch the robot inside the block, and measure it there."""
    with (
        tempfile.TemporaryFile("w+") as log,
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
        subprocess.Popen(
            ["lab", "--output", str(folder), "--no-browser"], stdout=log, stderr=subprocess.STDOUT
        ) as lab,
    ):
        try:
            while not (
                found := re.findall(
                    r"http://\S+", Path(f"/proc/self/fd/{log.fileno()}").read_text()
                )
            ):
                assert lab.poll() is None, "lab ended"
                time.sleep(0.2)
            with Browser(Path(profile)) as browser:
                browser.open(found[-1], 1280)
                time.sleep(3.0)
                processes = lab.pid, browser._process.pid
                before, begun = [processor_time(p) for p in processes], time.monotonic()
                yield
                spent = [processor_time(p) - b for p, b in zip(processes, before)]
                took = time.monotonic() - begun
                turn.server, turn.browser = (one / took for one in spent)
                turn.frames.append(float(browser.value("document.body.dataset.frames")))
        finally:
            lab.send_signal(signal.SIGINT)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rate", type=float, default=500.0)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--turns", type=int, default=2)
    arguments = parser.parse_args()
    isolate(None)
    turns: dict[bool, list[Turn]] = {False: [], True: []}
    with (
        tempfile.TemporaryDirectory() as name,
        Processes(Path(name) / "logs") as processes,
        connect("benchmark") as client,
    ):
        folder = Path(name)
        robot = steps.Robot(processes, client, WHEELS, folder)
        demonstration.start(robot, find_config(PAPER_MOTORS), arguments.rate)
        gains = applying.from_file(find_config("gains.yaml"))
        client.set_parameters({get_controller_name(w): values for w, values in gains.items()})
        robot.switch("activate")
        plan = [("forward", 2.0, arguments.seconds)]
        for k in range(2 * arguments.turns):
            page = bool(k % 2)
            turn = Turn(np.zeros(0))
            bag = steps.record(robot, f"drive_{k}", "pid_state")
            if page:
                with watched(folder / f"lab_{k}", turn, arguments.seconds):
                    drive_wheels(client, plan, WHEELS)
            else:
                drive_wheels(client, plan, WHEELS)
            processes.stop("record")
            drive = driving.read_drive(bag, WHEELS)
            turn.ages = np.concatenate([one.answers.columns["age"] for one in drive.values()])
            turns[page].append(turn)
    show(turns, arguments.rate)
    return 0


def show(turns: dict[bool, list[Turn]], rate: float) -> None:
    """Print the figures with the page, without it, and their ratio."""
    ages = {page: np.concatenate([t.ages for t in some]) for page, some in turns.items()}
    print(
        f"| four wheels at {rate:g} Hz | alone | with the page | ratio |\n| --- | --- | --- | --- |"
    )
    for title, quantile in (("median", 0.5), ("99 %", 0.99)):
        alone, beside = (1e3 * float(np.quantile(ages[page], quantile)) for page in (False, True))
        print(f"| latency, {title} [ms] | {alone:.3f} | {beside:.3f} | {beside / alone:.2f} |")
    alone, beside = (100 * float(np.mean(ages[page] > 1 / rate)) for page in (False, True))
    print(f"| late answers [%] | {alone:.3f} | {beside:.3f} | |")
    watched_turns = turns[True]
    server, browser, frames = (
        float(np.mean(values))
        for values in (
            [t.server for t in watched_turns], [t.browser for t in watched_turns],
            [f for t in watched_turns for f in t.frames],
        )
    )  # fmt: skip
    print(f"| lab [% of a processor] | | {100 * server:.1f} | |")
    print(f"| browser [% of a processor] | | {100 * browser:.1f} | |")
    print(f"| frames a second | | {frames:.1f} | |")


if __name__ == "__main__":
    sys.exit(main())
