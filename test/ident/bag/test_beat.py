# SPDX-License-Identifier: Apache-2.0
"""Arrival times are fitted to the period of a regular sender; other times are unchanged."""

import numpy as np
import pytest
from motors import counted, simulate
from recordings import START, codes, floats, in_order, read, read_table

from smp_motor_ident.estimate import estimate
from smp_motor_ident.quality.stamps import find_beat, move_to_beat
from smp_motor_ident.record import Record

T = 10_000_000  # ns
MAP = ["voltage=u velocity=y time=t"]


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
def test_sampling_times_are_recovered_from_lower_envelope_of_arrivals(kind, seed):
    late, true = arrivals(kind, 4000, seed)
    beat = find_beat(late)
    wrong = beat.time - true
    # A twentieth of a sample: the line touches arrivals whose latency is a hundredth of that.
    assert np.ptp(wrong) < 0.05 * T
    assert beat.period == pytest.approx(1.0003 * T, rel=1e-4)


def test_sampling_times_are_recovered_when_few_samples_are_lost():
    rng = np.random.default_rng(4)
    true = T * np.arange(4000)
    late = np.maximum.accumulate(true + rng.exponential(0.3 * T, true.size))
    kept = np.sort(rng.choice(true.size, 3980, replace=False))
    beat = find_beat(np.rint(late[kept]).astype(np.int64))
    # A loss is located within a few samples; between the two places the index is off by one.
    assert np.median(np.abs(beat.time - true[kept])) < 0.05 * T
    assert np.std(beat.time - true[kept]) < np.std(late[kept] - true[kept])


def test_random_sampling_intervals_have_no_period():
    rng = np.random.default_rng(5)
    time = np.cumsum(rng.uniform(0.3 * T, 1.7 * T, 4000)).astype(np.int64)
    assert find_beat(time) is None


def test_regular_times_are_not_corrected():
    assert find_beat(arrivals("none", 1000, 1)[0]) is None


@pytest.mark.parametrize("kind", ["exponential", "coarse"])
def test_log_of_arrival_times_is_moved_to_sampling_times(tmp_path, kind):
    late, true = arrivals(kind, 2000, 6)
    motion = np.sin(2 * np.pi * true * 1e-9)  # 1 Hz, smooth on its true instants
    record = read_table(tmp_path, MAP, t=np.round(1e-9 * late, 6), u=np.arange(2000) % 7, y=motion)
    assert len(record) == 2000
    assert "arrival_beat" in codes(record)
    assert np.ptp(record.time - true * 1e-9) < 0.05e-9 * T


def test_jittered_stamps_consistent_with_motion_are_kept(tmp_path):
    rng = np.random.default_rng(7)
    time = T * np.arange(2000) + rng.uniform(0, 0.8 * T, 2000)
    motion = np.sin(2 * np.pi * time * 1e-9)  # sampled at the time of the stamp
    record = read_table(tmp_path, MAP, t=np.round(1e-9 * time, 9), u=np.arange(2000) % 7, y=motion)
    assert "arrival_beat" not in codes(record)


def _record_with_late_stamps(kind: str, seed: int) -> tuple[Record, float]:
    """Return a chirp's record with arrival stamps, and the motor's L/R [s]."""
    rng = np.random.default_rng(seed)
    r, l, k, j, b, tc = 0.84, 1.75e-3, 0.0508, 8e-4, 2.06e-4, 0.02
    t = np.arange(8000) * 1e-3
    v = 9.0 * np.sin(2 * np.pi * (0.2 * t + 0.15 * t * t))
    out = simulate(t, v, r, l, k, j, b, tc, np.zeros(t.size), 4)
    stamp = t + rng.exponential(0.7e-3, t.size)
    if kind == "bursts":
        stamp = t[np.minimum((np.arange(t.size) // 4 + 1) * 4, t.size - 1)]
    stamp = np.maximum.accumulate(stamp) + 1e-9 * np.arange(t.size)
    current = out[:, 0] + 0.02 * rng.standard_normal(t.size)
    return counted(stamp - stamp[0], v, out[:, 2], current=current), l / r


@pytest.mark.parametrize("kind", ["exponential", "bursts"])
def test_inductance_is_estimated_from_record_with_arrival_stamps(kind):
    record, electric = _record_with_late_stamps(kind, 8)
    found = estimate(record)
    assert "arrival_beat" in codes(found)
    assert not found.unreliable
    ratio = found.parameters["inductance"].value / found.parameters["resistance"].value
    # A tenth: the beat is known to a twentieth of a sample, L/R here is two samples.
    assert ratio == pytest.approx(electric, rel=0.1)


def test_record_with_irregular_sampling_stamps_is_unchanged():
    rng = np.random.default_rng(9)
    time = np.sort(1e-2 * np.arange(2000) + rng.uniform(0, 0.8e-2, 2000))
    record = Record("m", time, np.sin(time), velocity=np.sin(2 * np.pi * time))
    assert move_to_beat(record) is record


@pytest.mark.parametrize("rounding", [np.floor, np.rint])
def test_rounding_of_regular_times_is_undone_when_motion_is_noisy(rounding):
    rng = np.random.default_rng(12)
    period, multiple = 2.3e-3, 1e-3  # a loop stamped by a clock with a resolution of 1 ms
    at = period * np.arange(3000)
    speed = np.sin(3 * at) + rng.standard_normal(at.size)  # noise hides the sampling times
    sampled_late = at + rng.uniform(0, 1.2e-3, at.size)

    def stamped(time: np.ndarray) -> Record:
        stamp = multiple * rounding(time / multiple)
        return Record("m", stamp - stamp[0], np.sin(at), velocity=speed)

    np.testing.assert_allclose(np.diff(move_to_beat(stamped(at)).time), period, rtol=1e-3)
    late = stamped(sampled_late)
    assert move_to_beat(late) is late


def _record_with_stalls(seed: int, sampled_late: bool) -> Record:
    """Return a record with stalls that delay its stamps alone or its samples as well."""
    rng = np.random.default_rng(seed)
    beat = 5e-3 * np.arange(1600)
    stamp = beat + 1e-4 * rng.random(beat.size)
    stalls = np.sort(rng.choice(np.arange(10, 1590, 8), 24, replace=False))
    stamp[stalls] += rng.uniform(2e-3, 4.8e-3, stalls.size)
    at = stamp if sampled_late else beat
    angle = 300 * np.sin(0.8 * at) + 20 * np.sin(7 * at)  # [rad], up to 330 rad/s
    count = np.floor(angle * 48 / (2 * np.pi)).astype(np.int64)
    return Record("m", stamp - stamp[0], np.sin(beat), count=count)


@pytest.mark.parametrize("seed", range(8))
def test_stalled_samples_keep_their_stamps_and_delayed_stamps_are_corrected(seed):
    honest, arrived = _record_with_stalls(seed, True), _record_with_stalls(seed, False)
    assert move_to_beat(honest) is honest
    assert "arrival_beat" in codes(move_to_beat(arrived))


def test_standard_error_of_period_matches_scatter_of_estimates():
    found = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        late = np.maximum.accumulate(T * np.arange(300) + rng.exponential(0.8 * T, 300))
        beat = find_beat(np.rint(late).astype(np.int64))
        found.append((beat.period, beat.deviation))
    periods, deviations = np.array(found).T
    # A jackknife of eight parts of a hull's edge is conservative, by a factor of 2.2 here.
    assert 0.5 < np.sqrt(np.mean(deviations**2)) / np.std(periods - T) < 3.0


@pytest.mark.parametrize("held", [1, 40])
def test_bunched_commands_are_moved_to_their_sampling_times(tmp_path, held):
    n = 900
    volts = np.repeat(np.random.default_rng(2).uniform(-6, 6, n // held + 1), held)[:n]
    at = START + 30_000_000 * (np.arange(n) // 3 + 1)
    sent = in_order(floats("/pwm", at, volts), floats("/w", at, np.sin(0.1 * np.arange(n))))
    record = read(tmp_path / "bag.mcap", sent, ["voltage=/pwm.data velocity=/w.data"])
    assert len(record) > n - 5
    np.testing.assert_allclose(np.diff(record.time), 0.01, rtol=1e-3)
    assert "duplicate_samples" not in codes(record)
