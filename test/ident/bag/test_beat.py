"""Arrival times put back on the beat of a regular sender; honest times left as they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from smp_motor_ident.bag import read_records
from smp_motor_ident.bag.beat import find_beat

T = 10_000_000  # ns


def arrivals(kind: str, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return arrival times [ns] in order, and the instants of sampling."""
    rng = np.random.default_rng(seed)
    true = 1.0003 * T * np.arange(n)
    if kind == "exponential":
        late = np.maximum.accumulate(true + rng.exponential(0.8 * T, n))
    elif kind == "bursts":
        late = np.ceil(true / (7.3 * T)) * 7.3 * T + np.arange(n)  # a nanosecond apart
    elif kind == "coarse":
        late = np.floor(true / (3.7 * T)) * 3.7 * T
    else:
        late = true
    return np.rint(late).astype(np.int64), true


@pytest.mark.parametrize("kind", ["exponential", "bursts", "coarse"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_lower_envelope_of_the_arrivals_is_the_beat(kind: str, seed: int) -> None:
    late, true = arrivals(kind, 4000, seed)
    beat = find_beat(late)
    assert beat is not None
    wrong = beat.time - true
    # A twentieth of a sample: the line touches arrivals whose latency is a hundredth of that.
    assert np.ptp(wrong) < 0.05 * T
    assert beat.period == pytest.approx(1.0003 * T, rel=1e-4)


def test_few_lost_samples_leave_the_beat_where_it_is() -> None:
    rng = np.random.default_rng(4)
    true = T * np.arange(4000)
    late = np.maximum.accumulate(true + rng.exponential(0.3 * T, true.size))
    kept = np.sort(rng.choice(true.size, 3980, replace=False))
    beat = find_beat(np.rint(late[kept]).astype(np.int64))
    assert beat is not None
    # A loss is placed within a few samples: beside it the number of a sample is off by one.
    assert np.median(np.abs(beat.time - true[kept])) < 0.05 * T
    assert np.std(beat.time - true[kept]) < np.std(late[kept] - true[kept])


def test_intervals_that_are_random_by_themselves_have_no_beat() -> None:
    rng = np.random.default_rng(5)
    time = np.cumsum(rng.uniform(0.3 * T, 1.7 * T, 4000)).astype(np.int64)
    assert find_beat(time) is None


def test_a_regular_time_is_left_as_it_is() -> None:
    assert find_beat(arrivals("none", 1000, 1)[0]) is None


@pytest.mark.parametrize("kind", ["exponential", "coarse"])
def test_a_log_of_arrival_times_is_read_on_the_beat(tmp_path: Path, kind: str) -> None:
    late, true = arrivals(kind, 2000, 6)
    motion = np.sin(2 * np.pi * true * 1e-9)  # 1 Hz, smooth on its true instants
    rows = [f"{t * 1e-9:.6f},{k % 7},{y:.9f}" for k, (t, y) in enumerate(zip(late, motion))]
    (tmp_path / "log.csv").write_text("t,u,y\n" + "\n".join(rows))
    record = read_records(tmp_path / "log.csv", ["voltage=u velocity=y time=t"])["motor"]
    assert len(record) == 2000
    assert "arrival_beat" in [finding.code for finding in record.findings]
    assert np.ptp(record.time - true * 1e-9) < 0.05e-9 * T


def test_honest_stamps_with_jitter_are_kept(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    time = T * np.arange(2000) + rng.uniform(0, 0.8 * T, 2000)
    motion = np.sin(2 * np.pi * time * 1e-9)  # measured when the stamp says so
    rows = [f"{t * 1e-9:.9f},{k % 7},{y:.9f}" for k, (t, y) in enumerate(zip(time, motion))]
    (tmp_path / "log.csv").write_text("t,u,y\n" + "\n".join(rows))
    record = read_records(tmp_path / "log.csv", ["voltage=u velocity=y time=t"])["motor"]
    assert "arrival_beat" not in [finding.code for finding in record.findings]
