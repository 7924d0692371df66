# SPDX-License-Identifier: Apache-2.0
"""A voltage logged after it acts is moved back; one that leads its motion is not."""

import time

import numpy as np
import pytest
from recordings import read_table

from smp_motor_ident.bag.drives import find_late_rows

N = 2000
RNG = np.random.default_rng(17)
DRIVES = {
    "levels": np.repeat(RNG.uniform(-8, 8, N // 25), 25),
    "binary": 6 * np.sign(RNG.normal(size=N)),
    "sines": sum(2 * np.sin(w * np.arange(N) + w**2) for w in (0.03, 0.11, 0.23, 0.57)),
    "square": 6 * np.sign(np.sin(np.arange(N) * 2 * np.pi / 200)),
}


def simulate_speed(voltage: np.ndarray, lag: float = 8.0, winding: float = 0.0) -> np.ndarray:
    """Return a motor's speed at the end of each row, with Coulomb friction; lags in rows."""
    speed, driven, out = 0.0, 0.0, []
    for volts in voltage:
        for _ in range(10):
            driven = volts if not winding else driven + 0.1 / winding * (volts - driven)
            speed += 0.1 / lag * (25 * (driven - 0.3 * np.tanh(20 * speed)) - speed)
        out.append(speed)
    return np.array(out)


def add_noise(speed: np.ndarray, share: float = 0.01) -> np.ndarray:
    return speed + np.random.default_rng(3).normal(0, share * np.std(speed), speed.size)


@pytest.mark.parametrize("drive", list(DRIVES))
@pytest.mark.parametrize("rows", [2, 3, 10, 40])
def test_delay_is_estimated_when_commands_are_logged_several_rows_late(drive, rows):
    if drive == "square" and rows > 10:
        pytest.skip("a delay of most of a half period of a square wave equals a lead by the rest")
    speed = add_noise(simulate_speed(DRIVES[drive]))
    assert find_late_rows(DRIVES[drive][rows:], speed[: N - rows]) == 0  # it leads
    assert find_late_rows(np.roll(DRIVES[drive], rows)[rows:], speed[rows:]) == rows


@pytest.mark.parametrize("drive", [*DRIVES, "sine"])
@pytest.mark.parametrize("winding", [0.0, 2.0])
@pytest.mark.parametrize("lag", [2.0, 50.0])
def test_command_logged_on_time_is_not_moved(drive, lag, winding):
    voltage = DRIVES.get(drive, 6 * np.sin(np.arange(N) * 2 * np.pi / 150))
    assert find_late_rows(voltage, add_noise(simulate_speed(voltage, lag, winding))) == 0


def test_command_with_noise_feedback_is_not_moved():
    target, speed, rows = np.repeat(RNG.uniform(-100, 100, N // 50), 50), 0.0, []
    for k in range(N):
        measured = speed + RNG.normal(0, 3)
        voltage = 0.1 * (target[k] - measured)
        rows.append((voltage, measured))
        speed += 0.1 * (25 * voltage - speed)
    voltage, measured = np.array(rows).T
    assert find_late_rows(voltage, measured) == 0


def test_delay_of_long_log_is_estimated_quickly():
    voltage = RNG.normal(size=20_000)
    find_late_rows(voltage[:500], voltage[:500])  # compiles
    begin = time.perf_counter()
    find_late_rows(voltage, np.cumsum(voltage))
    assert time.perf_counter() - begin < 5.0  # on a busy machine


@pytest.mark.parametrize("motion", ["velocity", "count"])
def test_late_voltage_is_moved_back_in_every_segment(tmp_path, motion):
    voltage = DRIVES["levels"]
    speed = simulate_speed(voltage)
    moved = speed if motion == "velocity" else np.rint(np.cumsum(speed) * 0.01 * 318)
    at = 0.01 * np.arange(N) + 60.0 * (np.arange(N) >= N // 2)
    late = np.concatenate([np.zeros(3), voltage[:-3]])
    late[N // 2 : N // 2 + 3] = 0.0
    mapping = [f"voltage=u {motion}=y time=t held=before counts_per_revolution=2000"]
    record = read_table(tmp_path, mapping, t=at, u=late, y=moved)
    found = next(f for f in record.findings if f.code == "voltage_late")
    assert found.evidence == {"rows": 3, "late": pytest.approx(0.03)}
    assert "30 ms (3 rows) after it acts" in found.message
    assert record.starts == (0, N // 2 - 3) and len(record) == N - 6
    np.testing.assert_allclose(record.voltage[: N // 2 - 3], voltage[: N // 2 - 3], atol=1e-6)
    np.testing.assert_allclose(record.voltage[N // 2 - 3 :], voltage[N // 2 : N - 3], atol=1e-6)
