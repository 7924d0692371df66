# SPDX-License-Identifier: Apache-2.0
"""Counters that wrap, of every width, and counters that start again: by the test's own counting."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import COUNTS, RATIO, motion, notes, read

from smp_motor_ident.bag import read_records
from smp_motor_ident.bag.counter import Wrap, find_full_count, round_to_counts, unwrap, unwrap_angle
from smp_motor_ident.errors import BagError
from smp_motor_ident.record import Record


def turning(samples: int = 400, most: int = 90, seed: int = 3) -> np.ndarray:
    """Whole counts of a motor that goes both ways, by at most so many from sample to sample."""
    steps = np.random.default_rng(seed).integers(-most // 3, most + 1, samples)
    return np.cumsum(steps).astype(np.int64)


def shown(count: np.ndarray, bits: int) -> np.ndarray:
    """Return the readings of a two's complement counter: -2^(bits-1) to 2^(bits-1) - 1."""
    half = 2 ** (bits - 1)
    return (count + half) % 2**bits - half


@pytest.mark.parametrize("bits", [8, 10, 16, 31])
@pytest.mark.parametrize("signed", [True, False])
def test_a_known_width_is_undone_to_the_count(bits, signed):
    most = min(2 ** (bits - 1) - 1, 10**6)
    true = turning(most=most, seed=bits)
    raw = shown(true, bits) if signed else true % 2**bits
    found = unwrap(raw, bits)
    assert np.array_equal(found.count - raw[0], true - true[0])
    assert found.resets.size == 0 and found.findings == []


@pytest.mark.parametrize("bits", [8, 16])
def test_the_longest_step_of_a_width_is_half_of_its_range_and_counts_backwards(bits):
    half = 2 ** (bits - 1)
    for step, expected in ((half - 1, half - 1), (-half, -half), (half, -half)):
        raw = shown(np.array([0, 0, step, step]), bits)
        assert unwrap(raw, bits).count.tolist() == [0, 0, expected, expected]


@pytest.mark.parametrize("bits", [8, 10, 11, 12, 13, 14, 15, 16, 17, 18, 20, 24, 32])
def test_an_unknown_width_is_seen_from_the_jumps_and_told(bits):
    most = 6 if bits < 10 else 15  # so that a wrap is far beyond ten usual steps and 100
    true = turning(samples=4000, most=most, seed=bits)
    true += 2 ** (bits - 1) - true[2000]  # it wraps in the middle
    raw = shown(true, bits)
    assert np.abs(np.diff(raw)).max() > 2 ** (bits - 1) - most
    found = unwrap(raw, None)
    assert np.array_equal(found.count - raw[0], true - true[0])
    (finding,) = found.findings
    assert (finding.code, finding.evidence) == ("counter_wraps", {"bits": bits})


def test_a_width_of_zero_and_a_counter_that_never_jumps_stay_as_they_are():
    true = turning()
    for bits in (0, None):
        found = unwrap(true, bits)
        assert np.array_equal(found.count, true)
        assert found.resets.size == 0 and found.findings == []
    raw = shown(turning(samples=4000, most=15) * 8, 12)
    assert np.array_equal(unwrap(raw, 0).count, raw)


@pytest.mark.parametrize("raw", [[], [7]])
def test_a_counter_of_one_sample_is_unchanged(raw):
    found = unwrap(np.array(raw, np.int64), 16)
    assert found.count.tolist() == raw and found.resets.size == 0
    assert unwrap(np.array([5, 260]), 8).count.tolist() == [5, 4]


def test_a_measured_speed_resolves_multiple_wraps_of_a_narrow_counter():
    steps = np.random.default_rng(1).integers(300, 500, 200)  # more than a turn of eight bits
    true = np.concatenate([[0], np.cumsum(steps)])
    expected = steps + np.random.default_rng(2).uniform(-100.0, 100.0, steps.size)
    expected[7] = np.nan
    raw = shown(true, 8)
    found = unwrap(raw, 8, expected)
    wrong = np.flatnonzero(np.diff(found.count) != steps)
    assert wrong.tolist() == [7], "where nothing was measured the nearest way is taken"


@pytest.mark.parametrize("measured", [True, False])
def test_a_reset_adds_no_motion_and_keeps_the_counts_around_it(measured):
    true = turning(samples=400, most=20) + 50_000
    raw = true.copy()
    raw[120:] -= true[120]  # starts at zero again
    raw[320:] -= raw[320] - 3
    found = unwrap(raw, 0, np.diff(true).astype(float) if measured else None)
    found_at = [120, 320]
    assert found.resets.tolist() == found_at
    for begin, end in zip([0, *found_at], [*found_at, raw.size]):
        assert np.array_equal(found.count[begin:end], raw[begin:end])
    (finding,) = found.findings
    assert (finding.code, finding.severity) == ("counter_reset", "warning")
    assert finding.evidence == {"times": 2}


def spoilt(raw: np.ndarray, row: int, value: int) -> np.ndarray:
    return np.where(np.arange(raw.size) == row, value, raw)


def fallen(at: int) -> np.ndarray:
    """Return 200 counts of a motor far from zero that begin at zero again."""
    raw = turning(samples=200, most=20) + 50_000
    raw[at:] -= raw[at]
    return raw


@pytest.mark.parametrize(
    ("raw", "measured"),
    [
        pytest.param(spoilt(turning(300, 20) + 50_000, 100, 0), None, id="a jump to and fro"),
        pytest.param(spoilt(turning(300, 20) % 50, 100, 50_000), None, id="a spike near zero"),
        pytest.param(fallen(1), None, id="a fall from the first sample"),
        pytest.param(fallen(199), None, id="a fall to the last sample"),
        pytest.param(np.arange(1000, -1000, -5), None, id="a way back through zero"),
        pytest.param(np.arange(1000, -1000, -5), np.full(399, -5.0), id="a measured way back"),
    ],
)
def test_wrong_samples_and_a_way_back_to_zero_are_no_resets(raw, measured):
    found = unwrap(raw, 0, measured)
    assert found.resets.size == 0 and np.array_equal(found.count, raw)


@pytest.mark.parametrize(
    ("length", "blocks", "found_at"), [(40, 4, 3), (40, 5, 0), (100, 11, 10), (80, 10, 0)]
)
def test_up_to_three_resets_or_one_in_a_hundred_rows_count(length, blocks, found_at):
    raw = np.tile(np.arange(0, 1000 * length, 1000), blocks)
    found = unwrap(raw, 0, np.full(raw.size - 1, 1000.0))
    assert found.resets.size == found_at
    assert found_at or np.array_equal(found.count, raw)


def test_an_angle_within_one_turn_is_unwrapped_and_any_other_left():
    true = 0.05 * turning(samples=500, most=9)
    wrap_angle = np.angle(np.exp(1j * true))
    gaps = wrap_angle.copy()
    gaps[[40, 41, 90]] = np.nan
    for raw in (wrap_angle, gaps):
        result, undone = unwrap_angle(raw)
        sound = np.isfinite(raw)
        # Angles of 2 pi and less, through a complex exponential: rounding alone.
        assert undone == 2 * np.pi and result[sound] - result[0] == pytest.approx(
            (true - true[0])[sound], abs=1e-9
        )
        assert np.array_equal(np.isnan(result), ~sound)
    for left in (true, 0.3 * np.sin(true), np.array([1.0]), np.array([np.nan, 1.0])):
        result, undone = unwrap_angle(left)
        assert not undone and result is left


@pytest.mark.parametrize("measured", [True, False])
def test_a_counter_is_unwrapped_at_the_width_found_in_its_data(measured):
    true = turning(samples=600, most=90, seed=8) + 30_000  # it wraps before the first reset
    true[250:] -= true[250] - 5
    true[450:] += 15_000 - true[450]
    true[451:] -= true[451] + 3  # a second reset, to just below zero
    raw = shown(true, 16)
    assert np.abs(np.diff(raw[:250])).max() > 60_000
    expected = np.diff(true).astype(float)
    expected[[249, 449, 450]] = 30.0  # by a sensor of its own the motor goes on
    found = unwrap(raw, 16, expected if measured else None)
    assert found.resets.tolist()[0] == 250
    assert np.array_equal(found.count[:250] - raw[0], true[:250] - true[0])
    assert np.array_equal(found.count[250:450], true[250:450])
    after = found.resets[-1]
    assert found.count[after] == raw[after]


def test_a_motor_at_speed_wraps_an_unknown_width_that_its_speed_tells():
    steps = np.random.default_rng(6).integers(55, 66, 3000)
    true = np.concatenate([[0], np.cumsum(steps)])
    raw = shown(true, 11)
    found = unwrap(raw, None, steps.astype(float))
    assert np.array_equal(found.count, true) and found.findings[0].evidence == {"bits": 11}


def test_without_a_speed_a_reset_falls_further_than_the_largest_steps():
    steps = np.full(400, 5)
    steps[::40] = 400  # a few large ones: the bound of usual steps is 150
    for height, found_at in ((1900, False), (2100, True)):
        raw = np.cumsum(steps) - int(np.cumsum(steps)[221]) + height
        raw[222:] -= raw[222]
        assert unwrap(raw, 0).resets.tolist() == ([222] if found_at else [])
        measured = np.diff(raw).astype(float)
        measured[221] = 5.0
        assert unwrap(raw, 0, measured).resets.tolist() == [222]


def test_a_narrow_counter_that_turns_as_fast_as_may_be_told_is_told():
    # Ten usual steps of 13 and 100 are 230; around the wrap it moves by 256 less 14 at the least.
    true = turning(samples=4000, most=14, seed=5)
    raw = shown(true, 8)
    found = unwrap(raw, None)
    assert np.array_equal(found.count - raw[0], true - true[0])
    assert found.findings[0].evidence == {"bits": 8}


@pytest.mark.parametrize("measured", [True, False])
def test_a_jump_of_no_counter_width_is_kept(measured):
    raw = turning(samples=300, most=20) + 50_000
    expected = np.diff(raw).astype(float) if measured else None
    raw[150:] += 5000
    raw[200:] -= 30_000
    found = unwrap(raw, None, expected)
    assert np.array_equal(found.count, raw)
    assert found.resets.size == 0 and found.findings == []


def test_an_angle_that_leaves_one_turn_was_never_wrapped():
    for beyond, undone in ((0.0, True), (0.003, True), (0.2, False)):
        edge = np.pi + beyond
        raw = np.array([edge - 0.1, edge, -edge, -edge + 0.1])
        assert bool(unwrap_angle(raw)[1]) is undone
    assert unwrap_angle(np.array([2.0, -2.0]))[1] == 2 * np.pi
    assert unwrap_angle(np.array([1.5, -1.5]))[1] == 0


@settings(max_examples=25, deadline=None)
@given(
    bits=st.sampled_from([8, 12, 16, 24, 31, 32, 48, 63, 64]),
    seed=st.integers(0, 2**32 - 1),
    known=st.booleans(),
)
def test_a_counter_that_wraps_at_any_width_is_unwrapped(bits, seed, known):
    rng = np.random.default_rng(seed)
    # A motor's counts change smoothly, by at most a sixteenth of the range from sample to sample.
    speed = np.sin(np.arange(400) / rng.uniform(20, 60)) * 2.0 ** min(bits - 4, 40)
    truth = np.cumsum(speed.astype(np.int64)) + rng.integers(0, 2 ** min(bits - 1, 40))
    half = np.int64(64 - bits)
    raw = (truth << half) >> half
    if not known and bits not in (16, 32):
        return
    found = unwrap(raw, bits if known else None)
    np.testing.assert_array_equal(found.count - found.count[0], truth - truth[0])
    assert found.resets.size == 0
    wrap_angle = bool((raw != truth - truth[0] + raw[0]).any())
    if not known:
        assert bool(found.findings) == wrap_angle


def read_counts(path: Path, count: np.ndarray, a_sample: int, bits: int = 0) -> Record:
    """Return the record of a bag whose speed comes to so many counts a sample."""
    speed = np.full(count.size, a_sample / 0.01 * 2 * np.pi / COUNTS / RATIO)
    truth = motion(n=count.size, bits=bits)
    truth = dataclasses.replace(truth, count=count, velocity=speed)
    return read(path / "bag.mcap", truth.messages())


@pytest.mark.parametrize(
    ("bits", "step"), [(16, 2**13), (32, 2**29), pytest.param(8, 700, id="2.7 ranges a sample")]
)
def test_a_wrapping_counter_in_a_bag_follows_its_description_and_its_speed(tmp_path, bits, step):
    record = read_counts(tmp_path, np.arange(400, dtype=np.int64) * step - 3 * step, step, bits)
    np.testing.assert_array_equal(np.diff(record.count), step)
    assert record.starts == (0,)


def test_a_reset_counter_begins_a_new_segment(tmp_path):
    count = np.arange(300, dtype=np.int64) * 50 + 20_000
    count[120:] -= count[120]
    record = read_counts(tmp_path, count, 50)
    assert record.starts == (0, 120)
    assert np.all(np.diff(record.count)[np.arange(299) != 119] == 50)
    assert "reset 1 times" in notes(record)


def with_inertia(samples: int, most: float, seed: int) -> np.ndarray:
    """Return the way of a motor that goes both ways and changes its speed within 50 samples."""
    rng = np.random.default_rng(seed)
    aims = np.repeat(rng.uniform(-most, most, samples // 100 + 1), 100)[:samples]
    speed = np.zeros(samples)
    for k in range(1, samples):
        speed[k] = speed[k - 1] + 0.05 * (aims[k] - speed[k - 1])
    return np.cumsum(speed)


@pytest.mark.parametrize("width", [360, 400, 1000, 1440, 2400, 3000])
def test_a_counter_that_starts_again_each_turn_is_undone(width):
    true = np.rint(with_inertia(4000, width / 15, seed=width)).astype(np.int64)
    found = unwrap(true % width, None)
    assert np.array_equal(found.count - found.count[0], true - true[0])
    assert found.findings[0].evidence == {"counts": width}


def test_a_width_that_is_not_known_well_enough_is_refused():
    # Steps of a seventh of the width that scatter by a third of that: eight wraps tell it to 1 %.
    steps = np.random.default_rng(5).integers(100, 200, 60)
    with pytest.raises(BagError, match=r"starts again \d times, at about .* record faster"):
        unwrap(np.cumsum(steps) % 1023, None)


@pytest.mark.parametrize("turns", [0.5, 1.0, 2.0, 3.0])
def test_an_angle_that_wraps_at_turns_or_a_part_of_one_is_unwrapped(turns):
    true = with_inertia(2000, 0.5 * turns, seed=4)
    result, width = unwrap_angle(true % (2 * np.pi * turns) - 1.0)
    assert width == pytest.approx(2 * np.pi * turns, rel=1e-12)
    assert result - result[0] == pytest.approx(true - true[0], abs=1e-8)


def test_an_angle_that_toggles_is_not_unwrapped():
    # A position loop that reaches its target in a sample, overshoots and settles.
    cycle = np.concatenate([np.zeros(20), [8.0, 7.3, 7.1], np.full(17, 7.0)])
    angle = np.tile(cycle, 10) + np.random.default_rng(7).normal(0, 0.01, 400)
    result, width = unwrap_angle(angle)
    assert width == 0 and result is angle


@pytest.mark.parametrize("last", [65535, 255, 32767, -32768])
def test_a_counter_that_stays_at_the_end_of_its_width_is_full(last):
    true = (np.arange(400) * last) // 300
    clipped = np.minimum(true, last) if last > 0 else np.maximum(true, last)
    assert find_full_count(clipped) == last
    assert find_full_count(clipped[:302]) == 0, "it is there for two samples only"
    assert find_full_count(clipped - 3) == 0, "no width ends there"


def test_an_angle_that_begins_anew_at_each_run_of_a_joined_log_begins_a_segment(tmp_path):
    voltage = np.repeat([3.0, 6.0, 0.0], 100)
    run = np.cumsum(voltage * 400.0) * 0.01  # degrees, from zero
    table = np.column_stack([0.01 * np.arange(900), np.tile(voltage, 3), np.tile(run, 3)])
    joined = tmp_path / "joined.csv"
    np.savetxt(joined, table, delimiter=",", header="t,u,angle", comments="", fmt="%.6f")
    record = read_records(joined, ["time=t", "voltage=u", "position=angle:deg"])["motor"]
    assert record.starts == (0, 300, 600)
    assert [f.evidence for f in record.findings if f.code == "counter_reset"] == [{"times": 2}]
    np.testing.assert_allclose(record.position[300:600], np.deg2rad(run), atol=1e-9)


@pytest.mark.parametrize("offset", [2**53, 2**60, 2**62 + 12_345, -(2**63) + 10**6, 2**64 - 99])
def test_counts_far_from_zero_keep_every_step(tmp_path, offset):
    """The last is an unsigned counter, which wraps."""
    true = turning()
    shown = [(n + offset) % 2**64 if offset > 2**63 else n + offset for n in true.tolist()]
    rows = (f"{0.01 * k:.2f},{k % 5},{n}" for k, n in enumerate(shown))
    (tmp_path / "log.csv").write_text("\n".join(["t,u,c", *rows]))
    mapping = ["voltage=u count=c time=t counts_per_revolution=2000"]
    record = read_records(tmp_path / "log.csv", mapping)["motor"]
    assert np.array_equal(record.count - record.count[0], true - true[0])


def test_counts_that_no_encoder_makes_are_refused(tmp_path):
    rows = (f"{0.01 * k:.2f},8,{k**2 * 10**14}" for k in range(300))
    (tmp_path / "log.csv").write_text("\n".join(["t,u,c", *rows]))
    with pytest.raises(BagError, match="the count moves by"):
        read_records(tmp_path / "log.csv", ["voltage=u count=c time=t counts_per_revolution=2000"])


def test_a_refusal_of_counts_names_the_file(tmp_path):
    counts = np.rint(folded(1.5, 15.0, "levels") / (2 * np.pi) * 256).astype(np.int64) % 256
    rows = (f"{0.01 * k:.2f},{k % 5},{n}" for k, n in enumerate(counts.tolist()))
    (tmp_path / "log.csv").write_text("\n".join(["t,u,c", *rows]))
    with pytest.raises(BagError, match=r"log\.csv: the encoder's count turns by more than half"):
        read_records(tmp_path / "log.csv", ["voltage=u count=c time=t counts_per_revolution=256"])


def test_the_roundest_width_is_found_at_once_however_many_are_admitted():
    assert round_to_counts(Wrap(3.1e17, 1e16, 5), 10**9) == 2**58
    assert round_to_counts(Wrap(2.0e17 - 100, 1e14, 5), 10**9) % 1000 == 0
    assert round_to_counts(Wrap(1999.8, 0.1, 5), 1990) == 2000


def folded(top: float, lag: float, drive: str) -> np.ndarray:
    """An angle within a turn of a motor whose speed comes to so many half turns a sample."""
    k = np.arange(2000)
    levels = np.repeat(np.random.default_rng(5).uniform(-1, 1, 50), 40)
    target = {"levels": levels, "sine": np.sin(k / 30), "step": np.where(k < 200, 0.0, 1.0)}[drive]
    speed = np.zeros(k.size)
    for n in range(1, k.size):
        speed[n] = speed[n - 1] + (np.pi * top * target[n] - speed[n - 1]) / lag
    return np.mod(np.cumsum(speed), 2 * np.pi)


@pytest.mark.parametrize("drive", ["levels", "sine", "step"])
@pytest.mark.parametrize("lag", [4.0, 15.0])
def test_more_than_half_a_turn_a_sample_is_refused_as_aliasing(drive, lag):
    angle, width = unwrap_angle(folded(0.9, lag, drive))
    assert width == 2 * np.pi and np.abs(np.diff(angle)).max() < np.pi
    with pytest.raises(BagError, match=r"turns by more than half of its 6\.283 from"):
        unwrap_angle(folded(1.5, lag, drive))


@pytest.mark.parametrize("faults", [1, 2])
def test_single_faults_of_a_fast_angle_are_not_aliasing(faults):
    angle = folded(0.9, 15.0, "levels")
    angle[[500, 900][:faults]] += 3.0
    assert unwrap_angle(np.mod(angle, 2 * np.pi))[1] == 2 * np.pi


def test_a_narrow_counter_that_turns_over_half_of_its_width_is_refused():
    counts = np.rint(folded(1.5, 15.0, "levels") / (2 * np.pi) * 256).astype(np.int64) % 256
    for bits in (8, None):
        with pytest.raises(BagError, match="turns by more than half of its 256"):
            unwrap(counts, bits)
