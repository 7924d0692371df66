# SPDX-License-Identifier: Apache-2.0
"""Kill ``commission`` at random moments, in any of its processes, and check its results.

    python benchmarks/commission_kills.py                   # fifty kills, seed of the day
    python benchmarks/commission_kills.py --kills 5 --seed 3
    python benchmarks/commission_kills.py --kills 30 --resume   # and resumed to the end

Each time SIGKILL, SIGTERM or SIGINT hits one of the tool's processes (the tool, ``excite``,
``record``) at random. Required: the motors get 0 V within 0.3 s after the last process that drove
them, by their samples; the controllers are active again within 5 s after the end of the tool; all
its processes end, the guard last; no wheel receives nonzero commands of two writers within 0.2 s.
The times are for a machine with an idle processor; --slack extends them.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from lifecycle_msgs.srv import GetState

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "test")]

from smp_motor_ident.report.document import read_identification  # noqa: E402

Values = dict[str, tuple[float, float]]
MARK = "SMP_CAMPAIGN"
"""Environment variable that the tool hands down to all that it starts."""
WHEELS = ("front_left", "rear_left")
QUIET = {
    "stdout": subprocess.DEVNULL,
    "stderr": subprocess.DEVNULL,
    "stdin": subprocess.DEVNULL,
}
DURATION = 4.0
"""Of each signal [s]; each of four is recorded by processes of its own, then the tool computes."""
LASTS = {"commission": 80.0, "excite": DURATION + 2.0, "record": DURATION + 4.0}
"""Up to how long after its start a part is hit [s]."""
PARTS = ("commission", "commission", "excite", "record")
FAR = 4.0
"""Joint standard deviations between the values of two runs that are not the same result."""
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


def as_firmware() -> None:
    """Run before this machine's other work, as firmware and real-time nodes do."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))


def family(mark: str) -> dict[int, list[str]]:
    """Return the processes whose environment bears a mark, whichever session they are in."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            bears = f"{MARK}={mark}\0".encode() in (entry / "environ").read_bytes()
            arguments = (entry / "cmdline").read_bytes().split(b"\0")[:-1]
        except OSError:  # ended meanwhile, or another user's
            continue
        if bears and arguments:  # one that has ended and waits for its parent has none
            found[int(entry.name)] = [a.decode(errors="replace") for a in arguments]
    return found


def plays(part: str, arguments: list[str]) -> bool:
    """Return whether a command line is that of an executable."""
    return any(Path(a).name == part for a in arguments[:2])


class Campaign:
    """Plant and controllers, with their states."""

    def __init__(self, domain: int, slack: float) -> None:
        from wheel_robot import WheelRobot

        self.robot, self.slack = WheelRobot(domain), slack
        self.mark, self.folder = "", Path()
        self.robot.spin_for(2.0)
        if self.robot.node.count_publishers("/front_left/motor_description"):
            sys.exit(f"another robot runs in domain {domain}; choose another ROS_DOMAIN_ID")
        start = partial(subprocess.Popen, preexec_fn=as_firmware, **QUIET)
        self.processes = [start(["motor_plant"])]
        for wheel in WHEELS:
            command = ["wheel_pid", "--ros-args", "-r", f"__ns:=/{wheel}", "-p", "p:=2.0"]
            self.processes.append(start(command))
        self.clients = {
            w: self.robot.node.create_client(GetState, f"/{w}/wheel_pid/get_state") for w in WHEELS
        }
        if not self.until(self.active, 120.0):
            sys.exit("the controllers do not become active")

    def close(self) -> None:
        self.end_family()
        for process in self.processes:
            process.kill()
            process.wait(60.0)
        self.robot.close()

    def end_family(self) -> None:
        for pid in family(self.mark) if self.mark else ():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def until(self, condition: Callable[[], object], within: float) -> bool:
        end = time.monotonic() + within
        while not condition():
            if time.monotonic() > end:
                return False
            self.robot.spin()
        return True

    def active(self) -> bool:
        """Ask both controllers for their state."""
        futures = [c.call_async(GetState.Request()) for c in self.clients.values()]
        if not self.until(lambda: all(f.done() for f in futures), 1.0):
            return False
        return all(f.result().current_state.label == "active" for f in futures)

    def volts(self) -> float:
        return max(abs(self.robot.states[w][-1].duty_cycle) for w in WHEELS if self.robot.states[w])

    def two_writers(self) -> str:
        """Return the writers that drove one wheel within 0.2 s, if there are two."""
        for wheel in WHEELS:
            last: tuple[str, float] = ("", -1.0)
            for command in self.robot.commands[wheel]:
                at = command.header.stamp.sec + 1e-9 * command.header.stamp.nanosec
                writer = command.header.frame_id
                if command.voltage != 0.0:
                    if writer != last[0] and at - last[1] < 0.2:
                        return f"{wheel}: {last[0]} and {writer}"
                    last = writer, at
            self.robot.commands[wheel].clear()
        return ""

    def commission(self, *more: str) -> Any:
        """Start the tool."""
        given = [part for wheel in WHEELS for part in ("--wheel", wheel)]
        command = ["commission", "--output", str(self.folder), "--duration", str(DURATION), "--yes"]
        self.mark = uuid.uuid4().hex
        return subprocess.Popen(
            [*command, *given, *more],
            env={**os.environ, MARK: self.mark}, start_new_session=True, **QUIET,
        )  # type: ignore[call-overload]  # fmt: skip

    def result(self, *more: str) -> tuple[str, Values]:
        """Run the tool to its end; return what did not hold, and the values."""
        tool = self.commission(*more)
        if wrong := self.judge(tool, drives_no_more=False, within=400.0):
            return wrong, {}
        document = json.loads((self.folder / "commissioning.json").read_text())
        if tool.returncode or not document["passed"]:
            return f"exit {tool.returncode}: {document['verdict']}", {}
        found = read_identification(self.folder / "identification")
        return "", {
            f"{wheel} {name}": (float(q.value), float(q.std))
            for wheel, one in found.items()
            for name, q in {**one.parameters, **one.combinations}.items()
            if q.value is not None and q.std
        }

    def resumed(self, whole: Values) -> str:
        """Resume an interrupted run; return its differences from an uninterrupted one."""
        begun = (self.folder / "commissioning.json").is_file()
        wrong, values = self.result(*["--resume"] * begun)
        if wrong:
            return f"resumed: {wrong}"
        apart = {
            name: abs(value - whole[name][0]) / math.hypot(std, whole[name][1])
            for name, (value, std) in values.items()
            if name in whole
        }
        return ", ".join(f"{name} {x:.1f} deviations off" for name, x in apart.items() if x > FAR)

    def kill(self, draw: random.Random) -> tuple[str, str]:
        """Start the tool and kill a part of it; return which, and what did not hold."""
        self.folder = Path(tempfile.mkdtemp(), "out")
        tool = self.commission()
        part, number = draw.choice(PARTS), draw.choice(SIGNALS)
        ended = lambda: tool.poll() is not None  # noqa: E731
        here = lambda: [p for p, args in family(self.mark).items() if plays(part, args)]  # noqa: E731
        found: list[int] = []
        # A part that ends before its moment is met again when it is next started.
        while not found and not ended():
            self.until(lambda: here() or ended(), 120.0)
            self.until(ended, draw.uniform(0.0, LASTS[part]))
            found = here()
        for pid in found:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
        moment = f"{part} {'hit by' if found else 'ended before'} {number.name}"
        return moment, self.judge(tool, bool(found) and part == "excite")

    def judge(self, tool: Any, drives_no_more: bool, within: float = 180.0) -> str:
        at_rest = lambda: self.volts() == 0.0  # noqa: E731
        if drives_no_more and not self.until(at_rest, 0.3 + self.slack):
            return f"{12.0 * self.volts():.1f} V after 0.3 s"
        if not self.until(lambda: tool.poll() is not None, within):
            return "the tool hangs"
        if not self.until(at_rest, 0.3 + self.slack):
            return f"{12.0 * self.volts():.1f} V 0.3 s after the tool's end"
        if not self.until(self.active, 5.0 + self.slack):
            return "controllers are not active 5 s after the tool's end"
        if not self.until(lambda: not family(self.mark), 5.0 + self.slack):
            left = "; ".join(" ".join(args) for args in family(self.mark).values())
            self.end_family()
            return f"left: {left}"
        return self.two_writers()


def main() -> int:
    """Run the campaign; exit code 1 where something did not hold."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=int(time.time()) // 86400)
    parser.add_argument("--resume", action="store_true", help="go on with each, to its end")
    parser.add_argument("--slack", type=float, default=0.5, help="more time [s]; default 0.5")
    given = parser.parse_args()
    domain = int(os.environ.setdefault("ROS_DOMAIN_ID", "105"))
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    draw, failures = random.Random(given.seed), 0
    campaign = Campaign(domain, given.slack)
    try:
        whole: Values = {}
        if given.resume:
            campaign.folder = Path(tempfile.mkdtemp(), "out")
            wrong, whole = campaign.result()
            if wrong:
                sys.exit(f"a run that nobody cut off: {wrong}")
            print(f"a run that nobody cut off: passed, {len(whole)} values", flush=True)
        for k in range(given.kills):
            moment, wrong = campaign.kill(draw)
            if given.resume and not wrong:
                wrong = campaign.resumed(whole)
            failures += bool(wrong)
            load = os.getloadavg()[0]
            print(f"{k + 1}: {moment}: {wrong or 'held'} (load {load:.1f})", flush=True)
    finally:
        campaign.close()
    print(f"seed {given.seed}: {given.kills} kills, {failures} of them wrong")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
