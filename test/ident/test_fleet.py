"""Many recordings: each by itself, kept once it is known, compared in one table."""

from __future__ import annotations

import csv
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smp_motor_ident.cli import fleet as command
from smp_motor_ident.cli.identify import main
from smp_motor_ident.report.fleet import DAY, Row, drifts, outliers, page


def rows(slope: float, seed: int = 0, robot: str = "one", level: float = 25.0) -> list[Row]:
    """Ten recordings of a motor on as many days."""
    rng = np.random.default_rng(seed)
    return [
        Row(robot, "front_left", f"bag{k}", k * DAY,
            {"dc_gain": (level * (1 + slope * k) + float(rng.normal(0, 0.05)), 0.05)}, 97.0)
        for k in range(10)
    ]  # fmt: skip


def test_a_motor_that_drifts_is_told_from_those_that_do_not() -> None:
    # Of a hundred motors that stay, none: 100 times 6 in 100,000.
    steady = [row for k in range(100) for row in rows(0.0, k, f"robot{k}")]
    (mark,) = drifts([*steady, *rows(-0.001, 7, "worn")])
    assert (mark.robot, mark.quantity) == ("worn", "dc_gain")


def test_a_motor_unlike_the_others_stands_out_and_a_few_robots_are_not_compared() -> None:
    rng = np.random.default_rng(3)
    same = [row for k in range(8) for row in rows(0.0, k, f"r{k}", 25 + float(rng.normal(0, 0.3)))]
    other = rows(0.0, 9, "other", 28.0)
    assert [m.robot for m in outliers([*same, *other])] == ["other"]
    assert outliers([*same[:30], *other]) == []
    assert "other" in page([*same, *other], outliers([*same, *other]))


def fake(path: str, settings: tuple[Any, ...]) -> list[Row]:
    """A recording as its file says: broken, deadly once, or a motor."""
    with (Path(path).parent / "log").open("a") as log:
        log.write(Path(path).name + "\n")
    text = Path(path).read_text()
    if text == "broken":
        return [command._row(path, failure=f"{path}: is no recording")]
    killed = Path(path + ".killed")
    if text == "deadly" and not killed.exists():
        killed.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return [command._row(path, wheel="left", values={"dc_gain": (25.0, 0.1)}, fit_percent=97.0)]


def test_a_broken_bag_fails_alone_a_killed_worker_loses_nothing_and_no_work_is_done_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "identify_one", fake)
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
    # Only what has changed since is identified anew.
    assert (folder / "log").read_text() == before + "fine.csv\n"


def test_a_cluster_needs_dask_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        import distributed  # noqa: F401
    except ImportError:
        (tmp_path / "a.csv").write_text("t\n")
        code = main([str(tmp_path / "a.csv"), "--fleet", "--output", str(tmp_path / "out"),
                     "--scheduler", "127.0.0.1:1"])  # fmt: skip
        assert code == 2
        assert "pip install distributed" in capsys.readouterr().err


def test_signals_are_mapped_alike_for_every_recording(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        volts = np.repeat(rng.uniform(-6, 6, 60), 20)
        speed = np.zeros(volts.size)
        for k in range(1, speed.size):  # 25 rad/s/V, 60 ms, exact over a step of 10 ms
            speed[k] = speed[k - 1] + 0.1535 * (25.0 * volts[k - 1] - speed[k - 1])
        speed += rng.normal(0.0, 0.5, speed.size)
        rows = np.column_stack((0.01 * np.arange(volts.size), volts, speed))
        np.savetxt(tmp_path / name / "a.csv", rows, delimiter=",", header="t,u,w", comments="")
    bags = [str(tmp_path / name / "a.csv") for name in ("one", "two")]
    mapped = ["--map", "time=t", "voltage=u", "velocity=w"]
    assert main([*bags, "--fleet", *mapped, "--output", str(tmp_path / "out"), "--quiet"]) == 0
    table = list(csv.DictReader((tmp_path / "out" / "fleet.csv").open()))
    assert [r["robot"] for r in table] == ["one", "two"]
    # A hundredth: 1200 samples at 0.3 % of noise tell the gain a hundred times better.
    assert [float(r["dc_gain"]) for r in table] == pytest.approx([25.0, 25.0], rel=0.01)
