# SPDX-License-Identifier: Apache-2.0
"""Run ``commission`` on random robots, some of them wired or supplied wrongly.

    python benchmarks/commission_draws.py                      # forty robots
    python benchmarks/commission_draws.py --draws 12 --seed 3

Each robot has four motors drawn at random and, in turn, one of the cases: sound, an encoder or
the leads of a motor swapped, a wrong gear ratio, a dead zone, a weak battery, a load on one wheel.
``commission --yes --apply`` runs against live ``motor_plant`` and ``wheel_pid``.  The end is right
where gains passed the verification drive and the case allows it, or where it stopped with the
diagnosis of the case, at the wheel that has it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
SILENT = {"stdin": subprocess.DEVNULL, "stderr": subprocess.STDOUT}

RIGHT: dict[str, tuple[bool, str]] = {
    "sound": (True, ""),
    "encoder swapped": (False, "reversed"),
    "leads swapped": (False, "reversed"),
    "wrong gear ratio": (False, "gear_ratio"),
    "dead zone": (True, "dead_zone"),
    "weak battery": (False, "supply_low"),
    "load on one wheel": (False, "friction_outlier"),
}
"""By case: whether gains may pass, and the finding at the faulty wheel that explains a stop."""


def motors(draw: random.Random) -> dict[str, dict[str, float]]:
    """Return four motors, each drawn by itself from a range of geared motors of 12 V."""
    drawn = {}
    for wheel in WHEELS:
        resistance = draw.uniform(2.0, 12.0)
        constant = draw.uniform(0.01, 0.04)
        slow = draw.uniform(0.03, 0.12)
        inertia = slow * constant**2 / resistance
        friction = draw.uniform(0.3, 0.6)
        drawn[wheel] = {
            "resistance": resistance,
            "inductance": resistance * slow * draw.uniform(0.01, 0.15),
            "motor_constant": constant,
            "inertia": inertia,
            "viscous_friction": draw.uniform(0.02, 0.2) * constant**2 / resistance,
            "coulomb_friction": friction * constant / resistance,
            "gear_ratio": 50.0,
            "counts_per_revolution": draw.choice([48.0, 256.0, 500.0, 2048.0]),
            "encoder_bits": draw.choice([0, 16]),
            "supply_voltage": 12.0,
        }
    return drawn


def spoil(case: str, wheel: dict[str, float], draw: random.Random) -> list[str]:
    """Make one case of a robot's wheel; return further arguments of the plant."""
    if case == "encoder swapped":
        wheel["encoder"] = -1
    elif case == "leads swapped":
        wheel["leads"] = -1
    elif case == "wrong gear ratio":
        wheel["described_gear_ratio"] = wheel["gear_ratio"] * draw.choice([0.5, 0.75, 1.5, 2.0])
    elif case == "dead zone":
        wheel["dead_zone"] = draw.uniform(0.8, 2.0)
    elif case == "weak battery":
        return ["-p", f"battery_voltage:={12.0 * draw.uniform(0.6, 0.85)}"]
    elif case == "load on one wheel":
        wheel["coulomb_friction"] *= draw.uniform(5.0, 7.0)
    return []


class Nodes:
    """The processes of one robot."""

    def __init__(self, folder: Path, arguments: list[str]) -> None:
        plant = [
            "motor_plant",
            "--ros-args",
            "-p",
            f"motors_file:={folder / 'motors.yaml'}",
            *arguments,
        ]
        commands = [plant] + [["wheel_pid", "--ros-args", "-r", f"__ns:=/{w}"] for w in WHEELS]
        with (folder / "nodes.log").open("wb") as log:
            self.processes = [
                subprocess.Popen(one, stdout=log, preexec_fn=_firmware, **SILENT)  # type: ignore[call-overload]
                for one in commands
            ]

    def close(self) -> None:
        for process in self.processes:
            process.send_signal(signal.SIGINT)
        for process in self.processes:
            try:
                process.wait(20.0)
            except subprocess.TimeoutExpired:
                process.kill()


def _firmware() -> None:
    """Run before this machine's other work, as firmware and real-time nodes do."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))


def run(case: str, folder: Path, draw: random.Random, duration: float) -> tuple[bool, str, str]:
    """Commission one robot; return whether it ended rightly, how, and its last line."""
    robot, spoilt = motors(draw), draw.choice(WHEELS)
    arguments = spoil(case, robot[spoilt], draw)
    may_pass, reason = RIGHT[case]
    tree = {"/**/motor_plant": {"ros__parameters": {"motors": robot}}}
    (folder / "motors.yaml").write_text(yaml.safe_dump(tree))
    nodes = Nodes(folder, arguments)
    try:
        command = ["commission", "--output", str(folder / "out"), "--yes", "--apply"]
        with (folder / "commission.log").open("wb") as log:
            tool = subprocess.run(
                [*command, "--duration", str(duration)], stdout=log, timeout=1200.0, **SILENT
            )  # type: ignore[call-overload]
    finally:
        nodes.close()
    said = (folder / "commission.log").read_text(errors="replace").strip().splitlines()
    document = folder / "out" / "commissioning.json"
    words = said[-1] if said else ""
    if not document.is_file():
        return False, f"exit {tool.returncode}", words
    found = json.loads(document.read_text())
    if missing := set(WHEELS) - set(found["checks"]):
        return False, f"without {', '.join(sorted(missing))}", words
    if tool.returncode == 0 and found["passed"]:
        return may_pass, "passed", words
    at = {f["code"] for f in found.get("findings", []) if f["severity"] == "refused"}
    named = {
        f["code"]
        for f in found.get("findings", [])
        if f["severity"] != "note" and f["evidence"].get("wheel") in (spoilt, None)
    }
    stopped = at <= {reason, "verification"} and reason in named
    return stopped, ", ".join(sorted(at)) or f"exit {tool.returncode}", words


def main() -> int:
    """Run the draws; exit code 1 where an end is wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--duration", type=float, default=6.0, help="of each signal [s]; default 6")
    parser.add_argument("--case", choices=RIGHT, help="this case only")
    parser.add_argument("--keep", metavar="DIR", help="keep the results, one folder per draw")
    given = parser.parse_args()
    os.environ.setdefault("ROS_DOMAIN_ID", "106")
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    cases, wrong = list(RIGHT), 0
    for k in range(given.draws):
        draw = random.Random(f"{given.seed} {k}")
        case = given.case or cases[k % len(cases)]
        folder = Path(given.keep or tempfile.mkdtemp(), f"draw_{k}").resolve()
        folder.mkdir(parents=True)
        begun = time.monotonic()
        right, end, words = run(case, folder, draw, given.duration)
        wrong += not right
        took = time.monotonic() - begun
        print(
            f"{k + 1}: {case}: {end}: {'right' if right else 'WRONG'} "
            f"({took:.0f} s, load {os.getloadavg()[0]:.1f}) {'' if right else words}",
            flush=True,
        )
    print(f"seed {given.seed}: {given.draws} robots, {wrong} ends wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
