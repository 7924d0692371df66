# SPDX-License-Identifier: Apache-2.0
"""Choice of clock, order of samples, losses, gaps, wrap-around and held inputs."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from recordings import (
    START,
    Motion,
    Sent,
    assert_read,
    floats,
    in_order,
    joint_state,
    motion,
    notes,
    read,
    read_one,
    write_bag,
    write_file,
)

from smp_motor_ident.bag import join_records, read_records
from smp_motor_ident.bag.clock import average_held_input, fit_clock
from smp_motor_ident.errors import BagError

# Without shrinking, which takes minutes when an example is a whole bag.
BAG_SETTINGS = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck),
                phases=(Phase.explicit, Phase.reuse, Phase.generate))  # fmt: skip


@BAG_SETTINGS
@given(data=st.data())
def test_written_states_are_read_back_unchanged(tmp_path_factory, data):
    n = data.draw(st.integers(2, 60))
    finite = st.floats(-1e12, 1e12)
    # A velocity of zero throughout, while the count moves, is dropped as never filled in.
    column = st.lists(finite, min_size=n, max_size=n).map(np.array).filter(np.any)
    # All intervals differ by a factor of 1.5 at most: no gap, no lost sample.
    steps = data.draw(st.lists(st.integers(8_000_000, 12_000_000), min_size=n, max_size=n))
    # A counter that stays at an end of its range is saturated, and refused.
    ends = {end for k in range(7, 63) for end in (2**k - 1, -(2**k))}
    count = st.integers(-(2**62), 2**62).filter(lambda c: c not in ends)
    counts = data.draw(st.lists(count, min_size=n, max_size=n))
    truth = Motion(
        "rear_right",
        START + np.cumsum(np.array(steps, np.int64)),
        *(data.draw(column) for _ in range(4)),
        count=np.array(counts, np.int64),
    )
    bag = tmp_path_factory.mktemp("bag") / "bag"
    write_bag(bag, truth.messages())
    assert_read(read_records(bag)["rear_right"], truth)


@BAG_SETTINGS
@given(order=st.permutations(range(50)), storage=st.sampled_from(["mcap", "db3"]))
def test_shuffled_samples_are_sorted_and_reported(tmp_path_factory, order, storage):
    truth = motion(n=50)
    messages = truth.messages(description=False)
    description = truth.messages()[:1]
    path = tmp_path_factory.mktemp("bag") / f"bag.{storage}"
    record = read_one(write_file(path, [*description, *(messages[k] for k in order)]))
    assert_read(record, truth)
    shuffled = list(order) != sorted(order)
    assert ("out of order" in notes(record)) is shuffled


def test_long_gap_between_irregular_samples_begins_a_segment(tmp_path):
    """The mean voltage over 0.4 s does not give the time of its changes."""
    truth = motion(n=200)
    steps = np.where(np.arange(200) % 3, 10_000_000, 19_000_000)
    steps[120] = 400_000_000
    truth = replace(truth, time=START + np.cumsum(steps))
    record = read(tmp_path / "bag.mcap", truth.messages())
    assert record.starts == (0, 120)
    assert "1 gaps of up to 0.4 s" in notes(record)


def test_short_gaps_are_bridged_and_long_gaps_begin_a_segment(tmp_path):
    truth = motion(n=400)
    ramp = np.linspace(-10, 10, 400)
    truth = replace(truth, voltage=ramp)
    lost = [50, 100, 101, *range(200, 205), *range(300, 350)]
    kept = np.setdiff1d(np.arange(400), lost)
    messages = truth.messages()
    some = [messages[0], *(messages[1 + k] for k in kept)]
    record = read(tmp_path / "bag.mcap", some)
    assert len(record) == kept.size
    assert [int(kept[s]) for s in record.starts] == [0, 205, 350]
    assert "3 samples missing in 2 places" in notes(record)
    assert "2 gaps of up to 0.51 s (55 samples missing)" in notes(record)
    # The mean of a ramp over two and three intervals; only the last was recorded.
    step = ramp[1] - ramp[0]
    index = list(kept)
    assert record.voltage[index.index(51)] == pytest.approx(ramp[51] - step / 2)
    assert record.voltage[index.index(102)] == pytest.approx(ramp[102] - step)
    untouched = np.setdiff1d(np.arange(kept.size), [index.index(51), index.index(102)])
    np.testing.assert_array_equal(record.voltage[untouched], ramp[kept][untouched])


def test_late_samples_are_not_counted_as_lost(tmp_path):
    truth = motion(n=400)
    time = truth.time.copy()
    # A stall of four periods, after which the sampler catches up in a burst.
    for k in (60, 200, 330):
        time[k : k + 4] = time[k + 3] + np.arange(4) * 100_000
    truth = replace(truth, time=time)
    record = read(tmp_path / "bag.mcap", truth.messages())
    assert_read(record, truth)
    assert record.starts == (0,)
    assert "missing" not in notes(record)


def test_duplicate_samples_are_removed_and_reported(tmp_path):
    truth = motion(n=100)
    messages = truth.messages()
    record = read(tmp_path / "bag.mcap", [*messages, *messages[40:60]])
    assert_read(record, truth)
    assert "20 samples with a repeated time were left out (duplicates)" in notes(record)


def test_samples_without_voltage_are_removed_and_reported(tmp_path):
    truth = motion(n=100)
    voltage, current = truth.voltage.copy(), np.full(100, np.nan)
    voltage[[10, 40]] = np.nan, np.inf
    velocity = truth.velocity.copy()
    velocity[70] = np.nan
    truth = replace(truth, voltage=voltage, current=current, velocity=velocity)
    record = read(tmp_path / "bag.mcap", truth.messages())
    assert len(record) == 98
    assert record.current is None
    assert np.isnan(record.velocity).sum() == 1
    assert "2 samples without a finite voltage were left out" in notes(record)
    assert "velocity: 1 values missing" in notes(record)


@pytest.mark.parametrize("days", [0, 3, -3])
def test_header_stamps_days_off_the_log_times_are_used_and_reported(tmp_path, days):
    truth = motion(n=100)
    record = read(tmp_path / "bag.mcap", truth.messages(latency=days * 86_400 * 10**9 + 7))
    assert_read(record, truth)
    assert "time: header stamps" in notes(record)
    assert (f"{days * 86400:+d}.000000 s from the header's" in notes(record)) is bool(days)


def stamp_headers(truth: Motion, stamps: np.ndarray) -> list[Sent]:
    """Return the messages of a motion with other header stamps, logged at its times."""
    messages = replace(truth, time=stamps).messages(description=False)
    logged = [replace(sent, stamp=int(at)) for sent, at in zip(messages, truth.time)]
    return [*truth.messages()[:1], *logged]


def test_log_times_are_used_when_header_stamps_are_not_set(tmp_path):
    truth = motion(n=100)
    record = read(tmp_path / "bag.mcap", stamp_headers(truth, np.zeros(100, np.int64)))
    assert_read(record, truth)
    assert "time: log times (the header stamps are not set)" in notes(record)


def test_clock_set_back_begins_a_segment(tmp_path):
    truth = motion(n=200)
    stamps = truth.time - 3_600 * 10**9 * (np.arange(200) >= 100)
    record = read(tmp_path / "bag.mcap", stamp_headers(truth, stamps))
    assert record.starts == (0, 100)
    np.testing.assert_array_equal(record.voltage, truth.voltage)
    assert "set back 1 times" in notes(record)


def test_stamped_output_and_unstamped_input_are_aligned_by_offset_and_drift(tmp_path):
    rng = np.random.default_rng(5)
    n, drift, offset = 3000, 50e-6, 12_345.678
    sampled = np.arange(n) * 0.01  # the microcontroller's clock
    on_log = sampled * (1 + drift) + offset
    latency = 0.0002 + rng.exponential(0.0005, n)
    messages = [
        joint_state(
            START + round((on_log[k] + latency[k]) * 1e9), ["w"], [on_log[k]], topic="/js",
            stamp=START + round(sampled[k] * 1e9),
        )
        for k in range(n)
    ]  # fmt: skip
    # The input's value is its time, so that a misalignment appears as a voltage error.
    input_times = np.arange(n // 2) * 0.02 + offset
    stamps = START + np.rint(input_times * 1e9).astype(np.int64)
    messages = in_order(messages, floats("/u", stamps, input_times))
    record = read(tmp_path / "bag.mcap", messages, "voltage=/u.data velocity=/js.velocity[w]")
    assert "offset and drift" in notes(record)
    assert "drifting by +50 ppm" in notes(record)
    # Mean of the held value over the interval: at most one input period old, never in the future
    lag = record.velocity - record.voltage
    assert lag.min() >= 0.0
    # Half an output period plus up to one input period, plus unknown latency.
    assert lag.max() < 0.005 + 0.02 + 0.001


def test_clock_offset_and_drift_are_estimated_despite_latency():
    rng = np.random.default_rng(6)
    stamp = np.arange(60_000, dtype=np.int64) * 1_000_000
    latency = rng.exponential(2_000_000, stamp.size).astype(np.int64)
    log = stamp + 5_000_000_000 + (stamp * 100e-6).astype(np.int64) + latency
    fit = fit_clock(stamp, log)
    # The fastest of 3000 messages is late by 2 ms / 3000: a microsecond, a little more by chance.
    assert fit.offset == pytest.approx(5e9, abs=10_000)
    assert fit.drift == pytest.approx(100e-6, abs=1e-6)


@BAG_SETTINGS
@given(data=st.data(), held=st.sampled_from(["after", "before"]))
def test_a_held_input_is_averaged_over_each_interval(data, held):
    increasing = st.sets(st.integers(0, 1000), min_size=2, max_size=30).map(sorted)
    time = np.array(data.draw(increasing), np.int64) * 1_000_000
    value = np.array([data.draw(st.floats(-10, 10)) for _ in time])
    at = np.array(data.draw(increasing), np.int64) * 1_000_000
    at = at[at >= time[0]]
    if at.size < 2:
        return
    found = average_held_input(time, value, held, at)
    # Reference: the mean over a grid of 1 ms.
    grid = np.arange(1_000_000, 1_001_000_000, 1_000_000)  # ends of the milliseconds
    if held == "after":
        level = value[np.maximum(np.searchsorted(time, grid - 1_000_000, "right") - 1, 0)]
    else:
        level = value[np.minimum(np.searchsorted(time, grid, "left"), value.size - 1)]
    for k in range(1, at.size):
        inside = (grid > at[k - 1]) & (grid <= at[k])
        # Rounding of a running integral over at most 10 V s.
        assert found[k] == pytest.approx(level[inside].mean(), abs=1e-9)


def test_samples_before_first_command_are_removed(tmp_path):
    times = START + np.arange(100) * 10_000_000
    messages = in_order(floats("/w", times, np.arange(100)), floats("/u", times[30:], np.ones(70)))
    record = read(tmp_path / "bag.mcap", messages, "voltage=/u.data velocity=/w.data")
    assert len(record) == 70
    assert "30 samples before the first voltage were left out" in notes(record)


def test_interruption_of_input_ends_the_segment(tmp_path):
    times = START + np.arange(200) * 10_000_000
    on = np.r_[0:60, 140:200]
    messages = in_order(floats("/w", times, np.arange(200)), floats("/u", times[on], np.ones(120)))
    record = read(tmp_path / "bag.mcap", messages, "voltage=/u.data velocity=/w.data")
    assert "no voltage came for more than 0.2 s" in notes(record)
    assert len(record.starts) == 2


def test_outputs_of_several_topics_are_interpolated_to_common_times(tmp_path):
    fast = START + np.arange(400) * 5_000_000
    slow = START + np.arange(200) * 10_000_000 + 1_000_000
    messages = in_order(
        floats("/u", slow, np.ones(200)),
        floats("/pos", slow, np.arange(200) * 0.01),
        floats("/w", fast, np.arange(400) * 0.5),
    )
    record = read(
        tmp_path / "bag.mcap", messages, "voltage=/u.data position=/pos.data velocity=/w.data"
    )
    assert record.sample_time == pytest.approx(0.01)
    # A straight line is interpolated exactly, but for rounding.
    np.testing.assert_allclose(record.velocity, (record.time + 0.001) * 100, rtol=1e-9)
    assert "velocity: interpolated" in notes(record)


def test_angle_wrapping_at_one_turn_is_unwrapped(tmp_path):
    times = START + np.arange(300) * 10_000_000
    angle = np.arange(300) * 7.0
    messages = in_order(floats("/u", times, np.ones(300)), floats("/angle", times, angle % 360))
    record = read(tmp_path / "bag.mcap", messages, "voltage=/u.data position=/angle.data:deg")
    np.testing.assert_allclose(np.diff(record.position), np.deg2rad(7.0), rtol=1e-9)
    assert "wraps at one turn" in notes(record)


def test_recordings_of_different_gearboxes_are_not_joined(tmp_path):
    record = read(tmp_path / "bag.mcap", motion(n=20).messages())
    other = replace(record, hardware=replace(record.hardware, gear_ratio=1.0))
    with pytest.raises(BagError, match=r"gear_ratio is 65\.5"):
        join_records([record, other])


def test_signal_missing_in_one_recording_is_nan_after_joining(tmp_path):
    record = read(tmp_path / "bag.mcap", motion(n=20).messages())
    other = replace(record, current=None)
    joined = join_records([record, other])
    np.testing.assert_array_equal(joined.current[:20], record.current)
    assert np.isnan(joined.current[20:]).all()
    assert np.all(np.diff(joined.time) > 0)


def test_recording_date_is_given_only_if_clock_was_set(tmp_path):
    truth = motion()
    record = read(tmp_path / "a.mcap", truth.messages())
    assert record.recorded == pytest.approx(1e-9 * START, abs=1.0)
    # A computer without a clock battery starts at 1970, which is not a date.
    early = replace(truth, time=truth.time - START)
    assert read(tmp_path / "b.mcap", early.messages()).recorded is None


@pytest.mark.parametrize("years", [0.01, 1.0, 56.0])
def test_clock_set_forward_begins_a_segment_and_adds_no_duration(tmp_path, years):
    truth = motion(n=400)
    leap = round(years * 365.25 * 86_400) * 10**9
    time = truth.time - START
    truth = replace(truth, time=time + leap * (np.arange(400) >= 250) + 10**9)
    record = read(tmp_path / "bag.mcap", truth.messages())
    assert record.starts == (0, 250)
    assert record.duration < 20.0
    np.testing.assert_allclose(np.diff(record.time)[[248, 250]], 0.01, rtol=1e-9)
    found = next(f for f in record.findings if f.code == "clock_set")
    assert found.evidence["longest"] == pytest.approx(leap * 1e-9, rel=1e-6)


def test_topics_stay_aligned_when_clock_is_set_forward(tmp_path):
    k, leap = np.arange(400), 10**18
    at = START + 10**7 * k + leap * (k >= 200)
    sent = in_order(floats("/u", at, k // 20 % 3), floats("/w", at, np.sin(0.1 * k)))
    record = read(tmp_path / "bag.mcap", sent, ["voltage=/u.data velocity=/w.data"])
    assert record.starts == (0, 200)
    np.testing.assert_allclose(record.velocity, np.sin(0.1 * np.arange(400)))
