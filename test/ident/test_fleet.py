# SPDX-License-Identifier: Apache-2.0
"""Fleets of recordings: separate identification, caching, comparison in one table."""

import csv
import os
import re
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import write_steps

from smp_motor_ident.cli import fleet as command
from smp_motor_ident.cli.identify import main
from smp_motor_ident.report.fleet import DAY, Row, drifts, outliers, page
from smp_motor_ident.result import Quantity


def gain(value: float, std: float = 0.05) -> Quantity:
    """Return a gain as an estimate states it."""
    return Quantity(value, std, (value - 2 * std, value + 2 * std), "rad/s/V")


def rows(slope: float, seed: int = 0, robot: str = "one", level: float = 25.0) -> list[Row]:
    """Return ten recordings of a motor on ten days."""
    rng = np.random.default_rng(seed)
    return [
        Row(robot, "front_left", f"bag{k}", k * DAY,
            {"dc_gain": gain(level * (1 + slope * k) + float(rng.normal(0, 0.05)))}, 97.0)
        for k in range(10)
    ]  # fmt: skip


def test_drifting_motor_is_found_among_steady_ones():
    # False alarms among 100 steady motors: 100 times 6 in 100,000.
    steady = [row for k in range(100) for row in rows(0.0, k, f"robot{k}")]
    (mark,) = drifts([*steady, *rows(-0.001, 7, "worn")])
    assert (mark.robot, mark.quantity) == ("worn", "dc_gain")
    # 0.1 % a day is 3 % in 30 days, known to 30 * 0.2 % / sqrt(82.5): the days' sum of squares.
    change, deviation = re.match(
        r"changes by (-[\d.]+) ± ([\d.]+) % in 30 days", mark.text
    ).groups()
    assert float(deviation) == pytest.approx(0.66, abs=0.01)
    assert float(change) == pytest.approx(-3.0, abs=3 * 0.66)
    assert "4.6 standard deviations over 10 recordings in 9 days" in mark.text


def test_recordings_without_a_date_are_not_compared_over_time():
    undated = [replace(row, date=None) for row in rows(-0.01, 7)]
    assert drifts(undated) == []
    assert "10 without a date" in page(undated, [])


def test_outlier_motor_is_found_only_with_enough_robots():
    rng = np.random.default_rng(3)
    same = [row for k in range(8) for row in rows(0.0, k, f"r{k}", 25 + float(rng.normal(0, 0.3)))]
    other = rows(0.0, 9, "other", 28.0)
    assert [m.robot for m in outliers([*same, *other])] == ["other"]
    assert outliers([*same[:30], *other]) == []
    assert "other" in page([*same, *other], outliers([*same, *other]))


def identify_fake(path: str, settings: tuple[Any, ...]) -> list[Row]:
    """Identify a fake recording: broken, killing its worker once, or valid."""
    with (Path(path).parent / "log").open("a") as log:
        log.write(Path(path).name + "\n")
    text = Path(path).read_text()
    if text == "broken":
        return [command._make_row(path, failure=f"{path}: is not a recording")]
    killed = Path(path + ".killed")
    if text == "deadly" and not killed.exists():
        killed.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return [command._make_row(path, wheel="left", values={"dc_gain": gain(25.0)}, fit_percent=97.0)]


def test_a_broken_bag_and_a_killed_worker_lose_no_other_result(tmp_path, monkeypatch):
    monkeypatch.setattr(command, "identify_one", identify_fake)
    folder = tmp_path / "robot7"
    folder.mkdir()
    bags = [folder / f"{name}.csv" for name in ("broken", "deadly", "fine", "good")]
    for path in bags:
        path.write_text(path.stem)
    arguments = [*map(str, bags), "--fleet", "--output", str(tmp_path / "out")]
    assert main(arguments) == 1
    table = list(csv.DictReader((tmp_path / "out" / "fleet.csv").open()))
    assert [(r["robot"], r["dc_gain"], bool(r["failure"])) for r in table] == [
        ("robot7", "", True), ("robot7", "25.0", False),
        ("robot7", "25.0", False), ("robot7", "25.0", False),
    ]  # fmt: skip
    before = (folder / "log").read_text()
    bags[2].write_text("finer")
    assert main([*arguments, "--force"]) == 1
    # Only changed recordings are identified again.
    assert (folder / "log").read_text() == before + "fine.csv\n"


def test_a_cluster_without_dask_is_refused_with_advice(tmp_path, capsys):
    try:
        import distributed  # noqa: F401
    except ImportError:
        (tmp_path / "a.csv").write_text("t\n")
        code = main([str(tmp_path / "a.csv"), "--fleet", "--output", str(tmp_path / "out"),
                     "--scheduler", "127.0.0.1:1"])  # fmt: skip
        assert code == 2
        assert "pip install distributed" in capsys.readouterr().err


MAPPED = ["--map", "time=t", "voltage=u", "velocity=w"]
MONDAY = 1_788_767_600.0  # 2026-09-07 07:53:20 UTC


def test_one_signal_mapping_applies_to_every_recording(tmp_path):
    bags = [str(write_steps(tmp_path / name / "a.csv", 12.0)) for name in ("one", "two")]
    assert main([*bags, "--fleet", *MAPPED, "--output", str(tmp_path / "out"), "--quiet"]) == 0
    table = list(csv.DictReader((tmp_path / "out" / "fleet.csv").open()))
    assert [r["robot"] for r in table] == ["one", "two"]
    # 1 %: 1200 samples at 0.3 % noise determine the gain a hundred times better.
    assert [float(r["dc_gain"]) for r in table] == pytest.approx([25.0, 25.0], rel=0.01)
    assert all(float(r["dc_gain_low"]) < float(r["dc_gain"]) < float(r["dc_gain_high"])
               for r in table)  # fmt: skip
    assert [r["date"] for r in table] == ["", ""]  # stamps from 0 are not a date


def test_recording_date_is_read_and_results_are_printed_with_units(tmp_path, capsys):
    bags = [
        write_steps(tmp_path / robot / f"day{day}.csv", 12.0, begin=MONDAY + DAY * day)
        for robot in ("one", "two")
        for day in (0, 3)
    ]
    for bag in bags:  # file times of a copy
        os.utime(bag, (0.0, 0.0))
    out = tmp_path / "out"
    assert main([*map(str, bags), "--fleet", *MAPPED, "--output", str(out)]) == 0
    table = list(csv.DictReader((out / "fleet.csv").open()))
    assert [float(r["date"]) for r in table] == [MONDAY, MONDAY + 3 * DAY] * 2
    lines = capsys.readouterr().out.splitlines()
    for where in ("one/day0.csv", "one/day3.csv", "two/day0.csv", "two/day3.csv"):
        (line,) = [one for one in lines if one.startswith(where)]
        number = r"[\d.]+ ± [\d.]+"
        assert re.match(
            rf"{where}: motor: DC gain {number} rad/s/V, time constant {number} ms, "
            rf"static voltage {number} V, fit [\d.]+ %$", line
        )  # fmt: skip
    shown = (out / "fleet.html").read_text()
    assert "Fleet of 2 robots" in shown
    assert (
        "2 motors in 4 recordings, recorded 2026-09-07 07:53 UTC to 2026-09-10 07:53 UTC<" in shown
    )


def test_fleet_table_fits_screen_and_phone_widths(tmp_path, browser):
    units = {"dc_gain": "rad/s/V", "time_constant": "s", "static_voltage": "V", "resistance": "ohm"}
    numbers = {
        name: Quantity(25.54832, 0.00079, (25.54678, 25.54986), unit)
        for name, unit in {**units, "motor_constant": "N m/A"}.items()
    }
    row = Row("robot_of_the_workshop", "front_left", "2026-09-07_excitation", MONDAY, numbers, 98.4)
    file = tmp_path / "fleet.html"
    file.write_text(page([row, replace(row, wheel="rear_left", failure="it stood still")], []))
    cells = "[...document.querySelectorAll('td')].map(c => c.getBoundingClientRect())"
    for width in (1280, 1000, 720, 390):
        browser.open(file, width)
        assert browser.value("document.documentElement.scrollWidth") <= width
        assert browser.value(f"Math.max(...{cells}.map(c => c.right))") <= width
        text = browser.value("document.querySelector('tbody tr').textContent")
        assert "25.54832 ± 0.00079 25.54678 … 25.54986" in text
        assert browser.complaints == []
