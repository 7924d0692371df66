"""The plan of a commissioning, before anything moves."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from smp_motor_ident.cli import commissioning, steps
from smp_motor_ident.cli.commission import main


def test_a_dry_run_prints_and_draws_the_plan_and_touches_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "robot"
    arguments = ["--output", str(folder), "--amplitude", "8", "--duration", "10", "--dry-run"]
    assert main(arguments) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(",")[0] for line in lines if line.startswith("from")] == [
        "from   0.0 s: sine", "from  10.0 s: square", "from  20.0 s: fourier",
    ]  # fmt: skip
    # A square is at one of its ends: three quarters of 8 V either way.
    assert set(lines[3].strip()) == {"▁", "█"}
    assert "6 V" in lines[2] and "30 s" in lines[-1]
    assert not folder.exists()


class Client:
    """Of a robot that is there and whose wheels report."""

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def find_wheels(self) -> list[str]:
        return ["left"]

    def wait_for_wheels(self, wheels: Sequence[str], timeout: float) -> dict[str, float]:
        return dict.fromkeys(wheels, 200.0)

    def paused(self, wheels: Sequence[str]) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()


def test_what_was_cut_off_while_it_moved_moves_again_and_afterwards_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    cut = ["excite", "identify", ""]
    folder = tmp_path / "robot"

    def step(name: str) -> Callable[..., object]:
        def do(*_: object) -> dict[str, object]:
            done.append(name)
            if name == cut[0]:
                raise KeyboardInterrupt
            return {}

        return do

    def record(*_: object) -> Path:
        (folder / "excitation").mkdir()  # as record does, which refuses a folder that is there
        return folder / "excitation"

    monkeypatch.setattr(commissioning, "connect", lambda *_: Client())
    monkeypatch.setattr(steps, "record", record)
    for name, called in (
        ("excite", "excite"), ("identify", "identify_wheels"), ("tune", "tune_wheels"),
    ):  # fmt: skip
        monkeypatch.setattr(steps, called, step(name))
    given = ["--output", str(folder), "--yes"]
    other = tmp_path / "other"
    other.mkdir()
    (other / "diary").touch()
    assert main(["--output", str(other), "--yes", "--resume"]) == 2  # nothing of ours
    assert (other / "diary").exists()
    assert main(given) == 130
    assert main(given) == 2  # a folder that is there is not overwritten unasked
    cut.pop(0)
    assert main([*given, "--resume"]) == 130
    cut.pop(0)
    assert main([*given, "--resume"]) == 0
    # Cut off in the first signal; then in identify after all three; then no wheel moves again.
    assert done == ["excite", *["excite"] * 3, "identify", "identify", "tune"]
