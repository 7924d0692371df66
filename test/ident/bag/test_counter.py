# SPDX-License-Identifier: Apache-2.0
"""Unwrapping of counters and angles, and detection of counter resets."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import COUNTS, RATIO, assert_refused, motion, notes, read, read_table, write_table
from scipy.signal import lfilter

from smp_motor_ident.bag.counter import Wrap, find_full_count, round_to_counts, unwrap, unwrap_angle
from smp_motor_ident.errors import BagError
from smp_motor_ident.record import Record

MAP = "voltage=u count=c time=t counts_per_revolution"


def simulate_counts(samples: int = 400, most: int = 90, seed: int = 3) -> np.ndarray:
    """Return counts of a motor turning both ways, with at most ``most`` counts per sample."""
    steps = np.random.default_rng(seed).integers(-most // 3, most + 1, samples)
    return np.cumsum(steps).astype(np.int64)


def wrap_signed(count: np.ndarray, bits: int) -> np.ndarray:
    """Return the readings of a two's complement counter: -2^(bits-1) to 2^(bits-1) - 1."""
    half = 2 ** (bits - 1)
    return (count + half) % 2**bits - half


@pytest.mark.parametrize("bits", [8, 10, 16, 31])
@pytest.mark.parametrize("signed", [True, False])
def test_counter_of_known_width_is_unwrapped(bits, signed):
    most = min(2 ** (bits - 1) - 1, 10**6)
    true = simulate_counts(most=most, seed=bits)
    raw = wrap_signed(true, bits) if signed else true % 2**bits
    found = unwrap(raw, bits)
    assert np.array_equal(found.count - raw[0], true - true[0])
    assert found.resets.size == 0 and found.findings == []


@pytest.mark.parametrize("bits", [8, 16])
def test_step_of_half_the_counter_range_is_unwrapped_backwards(bits):
    half = 2 ** (bits - 1)
    for step, expected in ((half - 1, half - 1), (-half, -half), (half, -half)):
        raw = wrap_signed(np.array([0, 0, step, step]), bits)
        assert unwrap(raw, bits).count.tolist() == [0, 0, expected, expected]


@pytest.mark.parametrize("bits", [8, 10, 11, 12, 13, 14, 15, 16, 17, 18, 20, 24, 32])
def test_unknown_counter_width_is_found_from_jumps_and_reported(bits):
    most = 6 if bits < 10 else 15  # a wrap far exceeds ten typical steps plus 100
    true = simulate_counts(samples=4000, most=most, seed=bits)
    true += 2 ** (bits - 1) - true[2000]  # it wraps in the middle
    raw = wrap_signed(true, bits)
    assert np.abs(np.diff(raw)).max() > 2 ** (bits - 1) - most
    found = unwrap(raw, None)
    assert np.array_equal(found.count - raw[0], true - true[0])
    (finding,) = found.findings
    assert (finding.code, finding.evidence) == ("counter_wraps", {"bits": bits})


def test_counter_of_zero_width_or_without_jumps_is_unchanged():
    true = simulate_counts()
    for bits in (0, None):
        found = unwrap(true, bits)
        assert np.array_equal(found.count, true)
        assert found.resets.size == 0 and found.findings == []
    raw = wrap_signed(simulate_counts(samples=4000, most=15) * 8, 12)
    assert np.array_equal(unwrap(raw, 0).count, raw)


@pytest.mark.parametrize("raw", [[], [7]])
def test_a_counter_of_one_sample_is_unchanged(raw):
    found = unwrap(np.array(raw, np.int64), 16)
    assert found.count.tolist() == raw and found.resets.size == 0
    assert unwrap(np.array([5, 260]), 8).count.tolist() == [5, 4]


def test_a_measured_speed_resolves_multiple_wraps_of_a_narrow_counter():
    steps = np.random.default_rng(1).integers(300, 500, 200)  # more than the range of eight bits
    true = np.concatenate([[0], np.cumsum(steps)])
    expected = steps + np.random.default_rng(2).uniform(-100.0, 100.0, steps.size)
    expected[7] = np.nan
    raw = wrap_signed(true, 8)
    found = unwrap(raw, 8, expected)
    wrong = np.flatnonzero(np.diff(found.count) != steps)
    assert wrong.tolist() == [7], "where nothing was measured the nearest way is taken"


@pytest.mark.parametrize("measured", [True, False])
def test_counter_reset_adds_no_motion(measured):
    true = simulate_counts(samples=400, most=20) + 50_000
    raw = true.copy()
    raw[120:] -= true[120]  # restarts at zero
    raw[320:] -= raw[320] - 3
    found = unwrap(raw, 0, np.diff(true).astype(float) if measured else None)
    found_at = [120, 320]
    assert found.resets.tolist() == found_at
    for begin, end in zip([0, *found_at], [*found_at, raw.size]):
        assert np.array_equal(found.count[begin:end], raw[begin:end])
    (finding,) = found.findings
    assert (finding.code, finding.severity) == ("counter_reset", "warning")
    assert finding.evidence == {"times": 2}


def replace_row(raw: np.ndarray, row: int, value: int) -> np.ndarray:
    return np.where(np.arange(raw.size) == row, value, raw)


def simulate_reset(at: int) -> np.ndarray:
    """Return 200 counts far from zero that are reset to zero at a row."""
    raw = simulate_counts(samples=200, most=20) + 50_000
    raw[at:] -= raw[at]
    return raw


@pytest.mark.parametrize(
    ("raw", "measured"),
    [
        pytest.param(
            replace_row(simulate_counts(300, 20) + 50_000, 100, 0),
            None,
            id="single outlier of zero",
        ),
        pytest.param(
            replace_row(simulate_counts(300, 20) % 50, 100, 50_000), None, id="spike near zero"
        ),
        pytest.param(simulate_reset(1), None, id="reset after first sample"),
        pytest.param(simulate_reset(199), None, id="reset at last sample"),
        pytest.param(np.arange(1000, -1000, -5), None, id="reversal through zero"),
        pytest.param(
            np.arange(1000, -1000, -5), np.full(399, -5.0), id="reversal with measured speed"
        ),
    ],
)
def test_outliers_and_return_to_zero_are_not_counter_resets(raw, measured):
    found = unwrap(raw, 0, measured)
    assert found.resets.size == 0 and np.array_equal(found.count, raw)


@pytest.mark.parametrize(
    ("length", "blocks", "found_at"), [(40, 4, 3), (40, 5, 0), (100, 11, 10), (80, 10, 0)]
)
def test_resets_are_accepted_up_to_three_or_one_percent_of_rows(length, blocks, found_at):
    raw = np.tile(np.arange(0, 1000 * length, 1000), blocks)
    found = unwrap(raw, 0, np.full(raw.size - 1, 1000.0))
    assert found.resets.size == found_at
    assert found_at or np.array_equal(found.count, raw)


def test_only_angle_confined_to_one_turn_is_unwrapped():
    true = 0.05 * simulate_counts(samples=500, most=9)
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
def test_wrapping_counter_with_resets_is_unwrapped(measured):
    true = simulate_counts(samples=600, most=90, seed=8) + 30_000  # it wraps before the first reset
    true[250:] -= true[250] - 5
    true[450:] += 15_000 - true[450]
    true[451:] -= true[451] + 3  # a second reset, to just below zero
    raw = wrap_signed(true, 16)
    assert np.abs(np.diff(raw[:250])).max() > 60_000
    expected = np.diff(true).astype(float)
    expected[[249, 449, 450]] = 30.0  # an independent sensor shows the motor still turning
    found = unwrap(raw, 16, expected if measured else None)
    assert found.resets.tolist()[0] == 250
    assert np.array_equal(found.count[:250] - raw[0], true[:250] - true[0])
    assert np.array_equal(found.count[250:450], true[250:450])
    after = found.resets[-1]
    assert found.count[after] == raw[after]


def test_unknown_counter_width_is_found_with_measured_speed():
    steps = np.random.default_rng(6).integers(55, 66, 3000)
    true = np.concatenate([[0], np.cumsum(steps)])
    raw = wrap_signed(true, 11)
    found = unwrap(raw, None, steps.astype(float))
    assert np.array_equal(found.count, true) and found.findings[0].evidence == {"bits": 11}


def test_reset_without_measured_speed_must_exceed_largest_steps():
    steps = np.full(400, 5)
    steps[::40] = 400  # a few large steps: the bound of typical steps is 150
    for height, found_at in ((1900, False), (2100, True)):
        raw = np.cumsum(steps) - int(np.cumsum(steps)[221]) + height
        raw[222:] -= raw[222]
        assert unwrap(raw, 0).resets.tolist() == ([222] if found_at else [])
        measured = np.diff(raw).astype(float)
        measured[221] = 5.0
        assert unwrap(raw, 0, measured).resets.tolist() == [222]


def test_unknown_width_of_8_bit_counter_is_found_at_maximum_speed():
    # Ten typical steps of 13, plus 100, are 230; a wrap jumps by at least 256 - 14 counts.
    true = simulate_counts(samples=4000, most=14, seed=5)
    raw = wrap_signed(true, 8)
    found = unwrap(raw, None)
    assert np.array_equal(found.count - raw[0], true - true[0])
    assert found.findings[0].evidence == {"bits": 8}


@pytest.mark.parametrize("measured", [True, False])
def test_jump_unrelated_to_counter_width_is_kept(measured):
    raw = simulate_counts(samples=300, most=20) + 50_000
    expected = np.diff(raw).astype(float) if measured else None
    raw[150:] += 5000
    raw[200:] -= 30_000
    found = unwrap(raw, None, expected)
    assert np.array_equal(found.count, raw)
    assert found.resets.size == 0 and found.findings == []


def test_angle_exceeding_one_turn_is_not_unwrapped():
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
    """Return the record of a bag whose speed is ``a_sample`` counts per sample."""
    speed = np.full(count.size, a_sample / 0.01 * 2 * np.pi / COUNTS / RATIO)
    truth = motion(n=count.size, bits=bits)
    truth = dataclasses.replace(truth, count=count, velocity=speed)
    return read(path / "bag.mcap", truth.messages())


@pytest.mark.parametrize(
    ("bits", "step"), [(16, 2**13), (32, 2**29), pytest.param(8, 700, id="2.7 ranges per sample")]
)
def test_counter_in_bag_is_unwrapped_by_description_and_speed(tmp_path, bits, step):
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


def simulate_angle(samples: int, most: float, seed: int) -> np.ndarray:
    """Return the angle of a motor that turns both ways and changes speed within 50 samples."""
    rng = np.random.default_rng(seed)
    aims = np.repeat(rng.uniform(-most, most, samples // 100 + 1), 100)[:samples]
    return np.cumsum(lfilter([0.05], [1.0, -0.95], aims))


@pytest.mark.parametrize("width", [360, 400, 1000, 1440, 2400, 3000])
def test_counter_restarting_each_turn_is_unwrapped(width):
    true = np.rint(simulate_angle(4000, width / 15, seed=width)).astype(np.int64)
    found = unwrap(true % width, None)
    assert np.array_equal(found.count - found.count[0], true - true[0])
    assert found.findings[0].evidence == {"counts": width}


def test_uncertain_counter_width_is_refused():
    # Steps of 1/7 of the width, spread by a third: eight wraps give the width to 1 %.
    steps = np.random.default_rng(5).integers(100, 200, 60)
    with pytest.raises(BagError, match=r"starts again \d times, at about .* record faster"):
        unwrap(np.cumsum(steps) % 1023, None)


@pytest.mark.parametrize("turns", [0.5, 1.0, 2.0, 3.0])
def test_angle_wrapping_at_multiple_or_fraction_of_turn_is_unwrapped(turns):
    true = simulate_angle(2000, 0.5 * turns, seed=4)
    result, width = unwrap_angle(true % (2 * np.pi * turns) - 1.0)
    assert width == pytest.approx(2 * np.pi * turns, rel=1e-12)
    assert result - result[0] == pytest.approx(true - true[0], abs=1e-8)


def test_angle_stepping_between_setpoints_is_not_unwrapped():
    # A position loop reaches its target within one sample, overshoots and settles.
    cycle = np.concatenate([np.zeros(20), [8.0, 7.3, 7.1], np.full(17, 7.0)])
    angle = np.tile(cycle, 10) + np.random.default_rng(7).normal(0, 0.01, 400)
    result, width = unwrap_angle(angle)
    assert width == 0 and result is angle


@pytest.mark.parametrize("last", [65535, 255, 32767, -32768])
def test_counter_saturated_at_end_of_range_is_detected(last):
    true = (np.arange(400) * last) // 300
    clipped = np.minimum(true, last) if last > 0 else np.maximum(true, last)
    assert find_full_count(clipped) == last
    assert find_full_count(clipped[:302]) == 0, "it is there for two samples only"
    assert find_full_count(clipped - 3) == 0, "no width ends there"


def test_angle_restarting_at_each_run_of_joined_log_begins_a_segment(tmp_path):
    voltage = np.repeat([3.0, 6.0, 0.0], 100)
    run = np.cumsum(voltage * 400.0) * 0.01  # degrees, from zero
    columns = dict(t=0.01 * np.arange(900), u=np.tile(voltage, 3), angle=np.tile(run, 3))
    record = read_table(tmp_path, ["time=t", "voltage=u", "position=angle:deg"], **columns)
    assert record.starts == (0, 300, 600)
    assert [f.evidence for f in record.findings if f.code == "counter_reset"] == [{"times": 2}]
    np.testing.assert_allclose(record.position[300:600], np.deg2rad(run), atol=1e-9)


@pytest.mark.parametrize("offset", [2**53, 2**60, 2**62 + 12_345, -(2**63) + 10**6, 2**64 - 99])
def test_counts_far_from_zero_lose_no_resolution(tmp_path, offset):
    """The last offset makes an unsigned counter wrap."""
    true = simulate_counts()
    shown = [(n + offset) % 2**64 if offset > 2**63 else n + offset for n in true.tolist()]
    k = np.arange(len(shown))
    record = read_table(tmp_path, [f"{MAP}=2000"], t=0.01 * k, u=k % 5, c=shown)
    assert np.array_equal(record.count - record.count[0], true - true[0])


def test_impossibly_fast_counts_are_refused(tmp_path):
    k = np.arange(300)
    path = write_table(tmp_path / "log.csv", t=0.01 * k, u=300 * [8], c=k**2 * 10**14)
    assert_refused("the count moves by", path, [f"{MAP}=2000"])


def test_a_refusal_of_counts_names_the_file(tmp_path):
    k = np.arange(2000)
    path = write_table(tmp_path / "log.csv", t=0.01 * k, u=k % 5, c=simulate_aliased_counts())
    message = r"log\.csv: the encoder's count turns by more than half"
    assert_refused(message, path, [f"{MAP}=256"])


def test_roundest_counter_width_within_uncertainty_is_chosen():
    assert round_to_counts(Wrap(3.1e17, 1e16, 5), 10**9) == 2**58
    assert round_to_counts(Wrap(2.0e17 - 100, 1e14, 5), 10**9) % 1000 == 0
    assert round_to_counts(Wrap(1999.8, 0.1, 5), 1990) == 2000


def simulate_wrapped_angle(top: float, lag: float, drive: str) -> np.ndarray:
    """Return the wrapped angle of a motor with at most ``top`` half turns per sample."""
    k = np.arange(2000)
    levels = np.repeat(np.random.default_rng(5).uniform(-1, 1, 50), 40)
    target = {"levels": levels, "sine": np.sin(k / 30), "step": np.where(k < 200, 0.0, 1.0)}[drive]
    speed = lfilter([np.pi * top / lag], [1.0, 1 / lag - 1.0], target)
    return np.mod(np.cumsum(speed), 2 * np.pi)


def simulate_aliased_counts() -> np.ndarray:
    """Return counts of 256 a turn that move by more than half a turn per sample."""
    angle = simulate_wrapped_angle(1.5, 15.0, "levels")
    return np.rint(angle / (2 * np.pi) * 256).astype(np.int64) % 256


@pytest.mark.parametrize("drive", ["levels", "sine", "step"])
@pytest.mark.parametrize("lag", [4.0, 15.0])
def test_more_than_half_a_turn_per_sample_is_refused_as_aliasing(drive, lag):
    angle, width = unwrap_angle(simulate_wrapped_angle(0.9, lag, drive))
    assert width == 2 * np.pi and np.abs(np.diff(angle)).max() < np.pi
    with pytest.raises(BagError, match=r"turns by more than half of its 6\.283 from"):
        unwrap_angle(simulate_wrapped_angle(1.5, lag, drive))


@pytest.mark.parametrize("faults", [1, 2])
def test_outliers_of_fast_angle_are_not_taken_for_aliasing(faults):
    angle = simulate_wrapped_angle(0.9, 15.0, "levels")
    angle[[500, 900][:faults]] += 3.0
    assert unwrap_angle(np.mod(angle, 2 * np.pi))[1] == 2 * np.pi


def test_counter_moving_over_half_its_range_per_sample_is_refused():
    for bits in (8, None):
        with pytest.raises(BagError, match="turns by more than half of its 256"):
            unwrap(simulate_aliased_counts(), bits)
