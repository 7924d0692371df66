"""Signals that cannot be what they are said to be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from smp_motor_ident.bag import read_records
from smp_motor_ident.errors import BagError

N = 400
T = 0.01 * np.arange(N)
RNG = np.random.default_rng(8)
U = np.repeat(RNG.uniform(-6, 6, N // 20), 20)


def motion() -> np.ndarray:
    """Return the speed of a first-order motor, 20 rad/s/V and 0.1 s, from rest."""
    speed = np.zeros(N)
    for k in range(1, N):
        speed[k] = speed[k - 1] + (1 - np.exp(-0.1)) * (20 * U[k - 1] - speed[k - 1])
    return speed


def write(path: Path, **columns: np.ndarray) -> Path:
    rows = zip(*columns.values())
    lines = [",".join(columns), *(",".join(repr(float(v)) for v in row) for row in rows)]
    path.write_text("\n".join(lines))
    return path


def codes(record: object) -> list[str]:
    return [finding.code for finding in record.findings]  # type: ignore[attr-defined]


def test_values_that_jump_impossibly_are_left_out(tmp_path: Path) -> None:
    speed = motion()
    speed[100], speed[200] = 1e200, speed[200] + 500  # spoilt exponent, spoilt mantissa
    path = write(tmp_path / "log.csv", t=T, u=U, y=speed)
    record = read_records(path, ["voltage=u velocity=y time=t"])["motor"]
    assert record.velocity is not None
    assert np.flatnonzero(np.isnan(record.velocity)).tolist() == [100, 200]
    assert "impossible_jump" in codes(record)


@pytest.mark.parametrize("shape", ["pulses", "steps", "quantised", "rest"])
def test_nothing_is_left_out_of_what_motors_do(tmp_path: Path, shape: str) -> None:
    voltage, speed = U.copy(), motion()
    if shape == "pulses":
        voltage = np.where(np.arange(N) % 50 == 0, 12.0, 0.0)
    elif shape == "quantised":
        speed = np.rint(speed / 40) * 40
    elif shape == "rest":
        voltage[:350], speed[:350] = 0.0, 0.0
    path = write(tmp_path / "log.csv", t=T, u=voltage, y=speed)
    assert "impossible_jump" not in codes(
        read_records(path, ["voltage=u velocity=y time=t"])["motor"]
    )


@pytest.mark.parametrize("kind", ["armature", "offset", "without sign", "supply"])
def test_a_current_without_sign_is_left_out_and_the_speed_kept(tmp_path: Path, kind: str) -> None:
    speed = motion()
    armature = (U - 0.045 * speed) / 2 + 0.05 * np.sign(speed) + RNG.normal(0, 0.01, N)
    current = {
        "armature": armature,
        "offset": armature + 0.1,
        "without sign": np.abs(armature),
        "supply": armature * U / 12,
    }[kind]
    path = write(tmp_path / "log.csv", t=T, u=U, y=speed, i=current)
    record = read_records(path, ["voltage=u velocity=y current=i time=t"])["motor"]
    dropped = kind in ("without sign", "supply")
    assert ("unsigned_current" in codes(record)) is dropped
    assert (record.current is None) is dropped
    assert record.velocity is not None and np.isfinite(record.velocity).all()


@pytest.mark.parametrize("levels", [(0, 1), (-1, 1)])
def test_the_sign_comes_from_a_direction_column(tmp_path: Path, levels: tuple[int, int]) -> None:
    direction = np.where(U > 0, levels[1], levels[0])
    path = write(tmp_path / "log.csv", t=T, pwm=np.abs(U) / 12 * 255, dir=direction, y=motion())
    mapping = "voltage=pwm:pwm direction=dir velocity=y time=t supply_voltage=12"
    record = read_records(path, [f"{mapping} pwm_full_scale=255"])["motor"]
    np.testing.assert_allclose(record.voltage[1:], U[:-1], rtol=1e-12)
    with pytest.raises(BagError, match="needs pwm_full_scale"):
        read_records(path, [mapping])


def test_a_speed_of_the_rim_needs_the_wheels_radius(tmp_path: Path) -> None:
    path = write(tmp_path / "log.csv", t=T, u=U, y=0.03 * motion())
    record = read_records(path, ["voltage=u velocity=y:m/s time=t wheel_radius=0.03"])["motor"]
    np.testing.assert_allclose(record.velocity, motion(), atol=1e-12)
    with pytest.raises(BagError, match="needs wheel_radius"):
        read_records(path, ["voltage=u velocity=y:m/s time=t"])
