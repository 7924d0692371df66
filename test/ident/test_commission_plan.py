"""The plan of a commissioning, before anything moves."""

from __future__ import annotations

from pathlib import Path

import pytest

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
