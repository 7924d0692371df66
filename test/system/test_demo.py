# SPDX-License-Identifier: Apache-2.0
"""The demo as its user runs it: once to the end, and interrupted in three ways."""

import json
import math
import os
import re
import signal
import uuid
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest
from printed import numbers, shape

from smp_motor_control import WHEELS
from smp_motor_control.motor.file import load_motors
from smp_motor_ident.bag import read_records
from smp_motor_ident.cli.applying import from_file

PAGE = Path(__file__).resolve().parents[2] / "docs" / "tutorial" / "simulated-robot.md"

OF_DRIVE = re.compile(r"forward|reverse|overshoot|settling")
"""Lines on the drive, which the demo does not judge where the machine delays its samples."""


def find_processes(mark: str) -> list[int]:
    """Return the processes whose environment contains the mark."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            environment = (entry / "environ").read_bytes()
            state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            continue
        if mark.encode() in environment and state != "Z":
            found.append(int(entry.name))
    return found


@pytest.fixture
def mark() -> Iterator[str]:
    name = f"smp-demo-{uuid.uuid4()}"
    yield name
    for pid in find_processes(name):  # only where a test has failed
        os.kill(pid, signal.SIGKILL)


def assert_page_shows(output: str, *, idle: bool) -> None:
    """Compare the page's excerpt with a run, within the standard deviations of both."""
    shown = [line for line in PAGE.read_text().split("```text\n")[1].split("```")[0].splitlines()
             if line.strip()]  # fmt: skip
    fresh = [line for line in output.split("Front left: ")[1].split("Front right: ")[0].splitlines()
             if line.strip()]  # fmt: skip
    fresh[0] = f"Front left: {fresh[0]}"
    fresh += [line for line in output.splitlines() if line.startswith("ok ")]
    if "the drive is not judged" in output:
        shown, fresh = ([x for x in lines if not OF_DRIVE.search(x)] for lines in (shown, fresh))
    for a, b in zip(shown, fresh, strict=True):
        # The wheel nearest to a limit is random, and so are small systematic errors.
        where = re.compile(r" \((-|\w+( \w+)?)\)$|(?<=^systematic: ).*")
        assert shape(where.sub("", a.rstrip())) == shape(where.sub("", b.rstrip()))
        one, other = numbers(a), numbers(b)
        if "error/std" in a or a.startswith("systematic") or not one:
            continue
        if " ± " in a:
            assert one[0] == other[0], f"{a}: the true motor is {other[0]}"
            assert abs(one[1] - other[1]) < 5 * math.hypot(one[2], other[2]), (a, b)
            # A deviation is an estimate, too: those of R and K differ threefold between runs, and
            # that of L sixfold where a busy machine applies commands late.
            assert 0.2 < one[2] / other[2] < 5.0 or not idle, (a, b)
        elif a.startswith("gains"):
            # Motors that are known to 0.1 % have gains within 2 % (docs/benchmarks/tuning.md).
            assert one == pytest.approx(other, rel=0.02), (a, b)
        elif " ms " in a:
            # The demo's own limits: 20 ms of settling, 2 % of overshoot.
            assert one[1:3] == pytest.approx(other[1:3], abs=20.0), (a, b)
            assert one[3:] == pytest.approx(other[3:], abs=2.0), (a, b)


@pytest.mark.alone
@pytest.mark.slow
def test_demo_output_matches_its_page_and_no_process_remains(process, mark, tmp_path):
    idle = os.getloadavg()[0] < 1.0
    demo = process("demo", "--output", "result", env={"SMP_MARK": mark})
    assert demo.wait(600.0) == 0, demo.output
    assert find_processes(mark) == []
    result = tmp_path / "result"
    assert (result / "identification" / "report.html").stat().st_size > 100_000
    assert set(load_motors(result / "identification" / "motors.yaml")) == set(WHEELS)
    assert set(read_records([str(result / "excitation")])) == set(WHEELS)
    figure = ElementTree.parse(result / "drive.svg").getroot()
    assert {w.replace("_", " ").capitalize() for w in WHEELS} <= set(figure.itertext())
    gains = from_file(result / "gains.yaml")
    assert set(gains) == set(WHEELS)
    motors = json.loads((result / "identification" / "identification.json").read_text())["motors"]
    assert all(motors[wheel]["identifiable"] for wheel in WHEELS)
    for wheel in WHEELS:
        assert wheel.replace("_", " ").capitalize() in demo.output
    assert re.search(r"^report: .*report\.html$", demo.output, re.MULTILINE)
    assert "FAIL" not in demo.output
    assert_page_shows(demo.output, idle=idle)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_process_remains_after_interrupted_demo(process, eventually, mark, number):
    demo = process("demo", "--output", "result", env={"SMP_MARK": mark})
    eventually(lambda: "exciting" in demo.output, 90.0, message=demo.output)
    assert len(find_processes(mark)) > 2 + len(WHEELS)
    demo.send_signal(number)
    code = demo.wait(20.0)
    # A killed demo cannot end its processes: the kernel asks them to, and they need a moment.
    eventually(lambda: find_processes(mark) == [], 10.0)
    if number != signal.SIGKILL:
        assert code == 130
        assert "Traceback" not in demo.output


def test_existing_folder_of_another_kind_is_not_overwritten(process, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    demo = process("demo", "--output", "mine")
    assert demo.wait(30.0) == 2
    assert "mine" in demo.output
    assert (tmp_path / "mine" / "thesis.tex").read_text() == "years of work"
