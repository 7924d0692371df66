# SPDX-License-Identifier: Apache-2.0
"""A resumed commissioning gives the results of an uninterrupted one."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from client import Client
from motors import record
from recordings import COUNTS, RATIO, START, Motion, write_bag

from smp_motor_control.excitation import SIGNALS
from smp_motor_ident.cli import checking, commissioning, steps
from smp_motor_ident.cli.commission import main
from smp_motor_ident.commission.wheel_test import Figures
from smp_motor_ident.record import Record

WHEEL, RATE = "rear_left", 100.0
FIGURES = Figures(100.0, 0.001, 0, 0.0, 0.5, 1.0, 1.0, 1.0, 25.0, 0.4, 0.05, 5.0)


class Robot:
    """A robot with a simulated motor; each run is interrupted after ``fuel`` parts."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.fuel, self.left, self.draft = 100, 0, Path()
        monkeypatch.setattr(commissioning, "connect", self.connect)
        monkeypatch.setattr(checking, "check_wheels", self.check)
        monkeypatch.setattr(steps, "record", self.record)
        monkeypatch.setattr(steps, "excite", self.excite)
        monkeypatch.setattr(commissioning, "_verify", lambda *_: "as designed")

    def connect(self, *_: object) -> Client:
        self.left = self.fuel
        return Client(WHEEL, RATE)

    def use(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt

    def check(self, *_: object) -> checking.CheckResult:
        self.use()
        return checking.CheckResult((), {WHEEL: FIGURES}, 6.0, math.nan)

    def record(self, robot: steps.Robot, name: str) -> None:
        self.draft = robot.folder / name
        self.draft.mkdir()  # left behind by an interruption

    def excite(self, robot: steps.Robot, part: steps.Excitation) -> None:
        self.use()
        n = round(part.duration * RATE)
        sent = SIGNALS[part.signal](amplitude=part.amplitude)(np.arange(n) / RATE)
        held = np.concatenate([np.zeros(1), sent])
        did = record(WHEEL, rate=RATE, voltage=held, kinds=("of ours",), seconds=1e2, seed=n)
        self.draft.rmdir()
        write(self.draft, did)


def write(folder: Path, did: Record) -> None:
    """Write a record as the ``record`` node does."""
    stamps = START + np.rint(1e9 * did.time).astype(np.int64)
    position = did.count * 2 * math.pi / COUNTS / RATIO
    signals = did.voltage, did.current, did.velocity / RATIO, position, did.count
    write_bag(folder, Motion(WHEEL, stamps, *signals).messages(latency=0))


def read_results(folder: Path) -> dict[str, Any]:
    """Return the results without dates and paths."""
    gains = json.loads((folder / "gains.json").read_text())
    return {
        "identification": (folder / "identification" / "identification.json").read_text(),
        "motors": yaml.safe_load((folder / "identification" / "motors.yaml").read_text()),
        "wheels": gains["wheels"],
        "gains": yaml.safe_load((folder / "gains.yaml").read_text()),
    }


def test_resumed_commissioning_gives_bit_identical_results(tmp_path, monkeypatch):
    robot, codes = Robot(monkeypatch), list[int]()
    asked = ["--yes", "--amplitude", "6", "--duration", "2"]
    assert main(["--output", str(tmp_path / "whole"), *asked]) == 0
    robot.fuel = 1
    cut = ["--output", str(tmp_path / "cut")]
    codes.append(main([*cut, *asked]))
    while codes[-1] == 130 and len(codes) < 9:  # in the check, and in each of four signals
        codes.append(main([*cut, "--yes", "--resume"]))
    assert codes == [130] * 4 + [0]
    whole, parts = read_results(tmp_path / "whole"), read_results(tmp_path / "cut")
    assert WHEEL in whole["identification"]
    assert parts == whole
