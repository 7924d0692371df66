# SPDX-License-Identifier: Apache-2.0
"""Plan, interruption and resumption of a commissioning."""

import contextlib
import json
import math
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import yaml
from motors import record
from recordings import COUNTS, RATIO, START, Motion, write_bag
from results import estimate as make_estimate

from smp_motor_control.excitation import SIGNALS
from smp_motor_ident.cli import checking, commissioning, plan, steps, tune
from smp_motor_ident.cli.commission import main
from smp_motor_ident.cli.processes import ProcessError
from smp_motor_ident.commission.wheel_test import Figures
from smp_motor_ident.finding import Finding
from smp_motor_ident.record import Record
from smp_motor_ident.report.commissioning import GAINS
from smp_motor_ident.report.document import identification_document
from smp_motor_ident.result import to_json


def test_dry_run_prints_the_plan_and_creates_no_files(tmp_path, capsys):
    folder = tmp_path / "robot"
    arguments = ["--output", str(folder), "--amplitude", "8", "--duration", "10", "--dry-run"]
    assert main(arguments) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(",")[0] for line in lines if line.startswith("from")] == [
        "from   0.0 s: sine", "from  10.0 s: square", "from  20.0 s: fourier",
        "from  30.0 s: steps",
    ]  # fmt: skip
    assert "slowly until it turns" in lines[0] and "8 V" in lines[0]
    # A square wave has two levels: 3/4 of 8 V in either direction.
    assert set(lines[4].strip()) == {"▁", "█"}
    # Four wheels: 32 s of checks, 35 s of signals and 4 s around each, 32 s to compute, the drive.
    assert "6 V" in lines[3] and "35 s of excitation, about 2 min 5 s in all" in lines[-1]
    assert not folder.exists()


FIGURES = Figures(200.0, 0.001, 0, 0.0, 0.5, 1.0, 1.0, 1.0, 25.0, 0.4, 0.05, 5.0)
STOP = Finding("reversed", "refused", "left: positive voltage decreases its counts", {}, "swap")
GIVEN = "/**/left/wheel_pid:\n  ros__parameters:\n    p: 1.0\n"


class Client:
    """A fake client of a connected robot with one reporting wheel."""

    def __init__(self, wheel: str, rate: float) -> None:
        self.wheel, self.rate = wheel, rate

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def find_wheels(self) -> tuple[str, ...]:
        return (self.wheel,)

    def wait_for_wheels(self, wheels, timeout) -> dict[str, float]:
        return dict.fromkeys(wheels, self.rate)

    def paused(self, wheels) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def until(self, condition, timeout) -> bool:
        return condition()

    def runs_controller(self, wheel) -> bool:
        return True


class Steps:
    """Fake commissioning steps that log their calls; the step named ``cut`` is interrupted."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.done = folder, list[str]()
        self.given = ["--output", str(folder), "--yes"]
        self.cut, self.fuel = "", 100  # moves that a run completes before it is interrupted
        self.left = 0
        self.found, self.heat = tuple[Finding, ...](), list[Finding]()
        self.bounds, self.sent = dict[str, object](), list[Any]()
        self.more: plan.Recording | None = None
        self.estimate = make_estimate("left")
        monkeypatch.setattr(plan, "plan_extra_recording", lambda *_: self.more)
        monkeypatch.setattr(commissioning, "connect", self.connect)
        monkeypatch.setattr(steps, "record", self.record)
        for owner, name, called in (
            (steps, "excite", "excite"),
            (commissioning, "validate", "validate_motors"),
            (commissioning, "verify", "_verify"),
        ):
            monkeypatch.setattr(owner, called, partial(self.step, name))
        monkeypatch.setattr(steps, "run", self.run)
        monkeypatch.setattr(checking, "check_wheels", self.check)
        monkeypatch.setattr(commissioning, "find_hot_windings", lambda *_: self.heat)

    def connect(self, *_: object) -> Client:
        self.left = self.fuel
        return Client("left", 200.0)

    def step(self, name: str, *given: Any) -> Any:
        self.done.append(name)
        if name == "excite":
            self.bounds = dict(given[0].bounds)
        if name in ("check", "excite"):
            self.left -= 1
        if name == self.cut or self.left < 0:
            raise KeyboardInterrupt
        if name == "excite":
            self.sent.append(given[1])
        return {"validate": [], "verify": "as designed"}.get(name)

    def run(self, tool: ModuleType, *arguments: str) -> None:
        if tool is tune:
            self.tune(*arguments)
            return
        self.step("identify")
        output = self.folder / "identification"
        output.mkdir(exist_ok=True)
        text = to_json(identification_document({"left": self.estimate}))
        (output / "identification.json").write_text(text)

    def check(self, *_: object) -> checking.CheckResult:
        self.step("check")
        return checking.CheckResult(self.found, {"left": FIGURES}, 4.0, 1.6)

    def record(self, robot: object, name: str) -> Path:
        (self.folder / name).mkdir()  # as record does, which refuses an existing folder
        return self.folder / name

    def tune(self, *arguments: str) -> None:
        self.step("tune")
        self.tuned_with = arguments
        most = {"value": 0.1, "high": 0.15}
        entry = {"gains": dict.fromkeys((name for name, _ in GAINS), 1.0)}
        entry["specification"] = {"settling": most, "overshoot": most}
        entry["settling"] = {"transition": 0.16}
        (self.folder / "gains.json").write_text(json.dumps({"wheels": {"left": entry}}))
        (self.folder / "gains.yaml").write_text(GIVEN)


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Steps:
    return Steps(tmp_path / "robot", monkeypatch)


def test_resumed_commissioning_sends_the_same_commands_as_an_uninterrupted_one(robot):
    robot.more = plan.Recording("excitation", "further", steps.Excitation("fourier", 9.0, 5.0))
    assert main([*robot.given, "--amplitude", "5", "--duration", "2"]) == 0
    moved = ["check", *["excite"] * 4, "identify", "excite", "identify"]
    assert robot.done == [*moved, "validate", "tune", "verify"]
    sent, robot.sent, robot.fuel = robot.sent, [], 1
    shutil.rmtree(robot.folder)
    assert main([*robot.given, "--amplitude", "5", "--duration", "2"]) == 130
    runs = 1
    while main([*robot.given, "--resume"]) == 130:  # each run completes one more part
        runs += 1
    assert runs == 5 and robot.sent == sent
    # Recordings at different voltages are not mixed.
    robot.fuel = 100
    assert main([*robot.given, "--resume", "--amplitude", "8"]) == 0
    assert len(robot.sent) == 2 * len(sent)


def test_interrupted_motion_is_repeated_and_completed_motion_is_not(tmp_path, robot):
    other = tmp_path / "other"
    other.mkdir()
    (other / "diary").touch()
    assert main(["--output", str(other), "--yes", "--resume"]) == 2  # not a commissioning
    assert (other / "diary").exists()
    robot.cut = "excite"
    assert main(robot.given) == 130
    assert main(robot.given) == 2  # an existing folder is not overwritten
    robot.cut = "identify"
    assert main([*robot.given, "--resume"]) == 130
    robot.cut = ""
    assert main([*robot.given, "--resume"]) == 0
    # Interrupted in the first signal, then in identify; the third run moves no wheel.
    ended = ["identify", "validate", "tune", "verify"]
    assert robot.done == ["check", "excite", *["excite"] * 4, "identify", *ended]
    document = json.loads((robot.folder / "commissioning.json").read_text())
    assert document["passed"] and document["checks"]["left"]["gain"] == 25.0


def test_resume_repeats_only_failed_or_missing_steps(robot):
    robot.cut = "verify"
    assert main(robot.given) == 130
    assert robot.done[-4:] == ["identify", "validate", "tune", "verify"]
    robot.done, robot.cut = [], ""
    assert main([*robot.given, "--resume"]) == 0
    assert robot.done == ["verify"]
    # A missing recording is repeated, with all steps that depend on it.
    robot.done = []
    shutil.rmtree(robot.folder / "excitation" / "sine")
    assert main([*robot.given, "--resume"]) == 0
    assert robot.done == ["excite", "identify", "validate", "tune", "verify"]


def test_resumed_verification_drive_requires_confirmation(robot, capsys):
    robot.cut = "verify"
    assert main(robot.given) == 130
    robot.done, robot.cut = [], ""
    assert main([*robot.given[:2], "--resume"]) == 2
    assert "--yes" in capsys.readouterr().err and robot.done == []


def test_apply_without_a_controller_is_refused_before_motion(robot, capsys, monkeypatch):
    monkeypatch.setattr(Client, "runs_controller", lambda *_: False)
    assert main([*robot.given, "--apply"]) == 2
    assert "no wheel_pid runs for left" in capsys.readouterr().err and robot.done == []
    assert main(robot.given) == 0
    told = capsys.readouterr().out
    assert "no wheel_pid runs for left: one is started" in told
    # The message precedes the first motion.
    assert told.index("one is started") < told.index("exciting: sine")


def test_design_on_unreliable_identification_requires_acceptance(robot):
    grave = Finding("lag", "unreliable", "the gain may be off", {}, "record longer")
    robot.estimate = replace(robot.estimate, findings=(grave,))
    assert main(robot.given) == 1
    page = (robot.folder / "report.html").read_text()
    assert "the gain may be off" in page and "Not passed." in page
    robot.done = []
    assert main([*robot.given, "--resume", "--accept", "unreliable_identification"]) == 0
    assert robot.done == ["tune", "verify"] and "--accept-unreliable" in robot.tuned_with
    assert "Passed with accepted findings." in (robot.folder / "report.html").read_text()


def test_reversed_wiring_stops_commissioning_before_excitation_unless_accepted(robot, capsys):
    robot.found = (STOP,)
    assert main(robot.given) == 1
    said = capsys.readouterr().err
    assert STOP.message in said and STOP.advice in said
    assert robot.done == ["check"]
    page = (robot.folder / "report.html").read_text()
    assert "Not passed." in page and STOP.message in page and STOP.advice in page
    # The user repairs or accepts the wiring and resumes in the same folder.
    assert main([*robot.given, "--resume", "--accept", "reversed"]) == 0
    page = (robot.folder / "report.html").read_text()
    assert "Passed with accepted findings." in page


def test_hot_winding_stops_commissioning_until_it_has_cooled(robot):
    robot.heat = [Finding("winding_hot", "refused", "left: 60 K hotter", {"wheel": "left"}, "wait")]
    assert main(robot.given) != 0
    assert robot.done == ["check", "excite"]
    assert "60 K hotter" in (robot.folder / "report.html").read_text()
    robot.heat = []
    assert main([*robot.given, "--resume"]) == 0
    assert robot.done.count("excite") == 4


def test_failure_reason_is_stored_in_the_verdict(robot, monkeypatch):
    def refuse(*_: object) -> None:
        raise ProcessError("left/wheel_pid refused the parameters")

    monkeypatch.setattr(robot, "tune", refuse)
    assert main(robot.given) == 1
    document = json.loads((robot.folder / "commissioning.json").read_text())
    assert document["passed"] is False and "refused the parameters" in document["verdict"]


def test_excitation_speed_is_bounded_by_the_checked_speed_or_the_given_limit(robot):
    assert main(robot.given) == 0
    # The checks show 1.6 rad/s; neither supply nor friction can raise it by half.
    assert robot.bounds["max_speed"] == pytest.approx(1.5 * 1.6)
    assert robot.bounds["max_current"] == 0.0
    shutil.rmtree(robot.folder)
    limits = ["--max-speed", "3", "--max-current", "2"]
    assert main([*robot.given, *limits]) == 0
    asked = [robot.bounds[f"max_{name}"] for name in ("speed", "current")]
    assert asked == [3.0, 2.0]


def test_remaining_time_is_estimated_from_completed_steps_of_the_same_kind():
    now = [0.0]
    robots = [plan.Recording("excitation", name, steps.Excitation(name, 10.0, 6.0))
              for name in ("sine", "square")]  # fmt: skip
    schedule = plan.schedule(["left"], robots, checked=True)
    compute = 2 * plan.COMPUTE_S + plan.DRIVE_S
    assert schedule.left() == pytest.approx(2 * (10.0 + plan.START_S) + compute)
    assert schedule.begin("exciting: sine", "6 V").startswith("[1/5] exciting: sine, 6 V; about ")
    timed = plan.Schedule(lambda: now[0])
    for name, kind in (("a", "x"), ("b", "x"), ("c", "y")):
        timed.add(name, kind, 10.0)
    timed.begin("a")
    now[0] = 25.0
    assert timed.left() == 20.0  # overdue steps count as almost finished
    timed.begin("b")
    assert timed.left() == 25.0 + 10.0  # b takes as long as a did; c is of another kind
    now[0] = 30.0
    assert timed.left() == 20.0 + 10.0
    assert plan.format_duration(30.4) == "30 s" and plan.format_duration(123.0) == "2 min 5 s"


def test_imprecise_estimate_requests_one_more_recording():
    known = make_estimate()  # std of 1 %, of the gain less
    assert plan.plan_extra_recording({"left": known}, 6.0) is None
    vague = replace(known.combinations["time_constant"], std=0.002)  # 5 %
    open_ = replace(known, combinations={**known.combinations, "time_constant": vague})
    more = plan.plan_extra_recording({"left": known, "right": open_}, 6.0)
    assert more is not None and more.folder == "excitation" and more.name == "further"
    sent = more.excitation
    assert sent.signal == "fourier" and sent.amplitude <= 6.0 and sent.band is not None
    # The tones lie around the motor's corner, 4 Hz.
    assert sent.band[0] < 4.0 < sent.band[1] and 5.0 <= sent.duration <= plan.MAX_EXTRA_S


WHEEL, RATE = "rear_left", 100.0


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
        return checking.CheckResult((), {WHEEL: replace(FIGURES, rate=RATE)}, 6.0, math.nan)

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
