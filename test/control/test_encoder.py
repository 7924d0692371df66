# SPDX-License-Identifier: Apache-2.0
"""Counts from angles, rollover of counters of any width, speed from counts."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smp_motor_control.encoder import DifferencedSpeed, Encoder, Unwrapper, unwrap, wrap
from smp_motor_control.errors import ParameterError


@given(
    bits=st.integers(2, 62),
    steps=st.lists(st.floats(-0.49, 0.49), min_size=1, max_size=50),
    start=st.integers(-(2**40), 2**40),
)
def test_unwrapping_inverts_wrapping_for_steps_below_half_the_range(bits, steps, start):
    moved = np.array([int(s * 2**bits) for s in steps], dtype=object)
    total = [start, *(start + np.cumsum(moved))]
    shown = [wrap(int(c), bits) for c in total]
    if max(abs(c) for c in total) < 2**62:
        recovered = unwrap(np.array(shown, dtype=np.int64), bits)
        assert [int(c) - shown[0] for c in recovered] == [int(c) - start for c in total]
    one_by_one = Unwrapper(bits)
    assert [one_by_one(c) - shown[0] for c in shown] == [int(c) - start for c in total]


@pytest.mark.parametrize("bits", [8, 16, 32])
def test_unsigned_counters_unwrap_like_signed_ones(bits):
    total = np.cumsum(np.random.default_rng(1).integers(-100, 100, 1000))
    unsigned = total % (1 << bits)
    assert np.array_equal(np.diff(unwrap(unsigned, bits)), np.diff(total))


def test_count_is_the_angle_rounded_down_to_whole_counts():
    encoder = Encoder(500.0)
    one = encoder.angle_per_count
    assert [encoder.count(k * one * 1.0001) for k in (0, 1, 250, 500)] == [0, 1, 250, 500]
    assert encoder.count(-0.5 * one) == -1


def test_window_of_zero_samples_is_refused():
    with pytest.raises(ParameterError, match="window"):
        DifferencedSpeed(Encoder(), 0)


@pytest.mark.parametrize("bits", [2, 8, 16, 63])
def test_counter_wraps_in_twos_complement_at_range_ends(bits):
    half = 2 ** (bits - 1)
    shows = {half - 1: half - 1, half: -half, -half: -half, -half - 1: half - 1, 2 * half: 0}
    for count, expected in shows.items():
        assert wrap(count, bits) == expected
        assert wrap(count, 0) == count
        # One step from zero, along the shorter direction.
        for unwrapped in (Unwrapper(bits), Unwrapper(0)):
            assert unwrapped(0) == 0
        one = Unwrapper(bits)
        one(0)
        assert one(count if bits < 63 else expected) == expected
        assert Encoder(500.0, bits).bits == bits


@pytest.mark.parametrize("bits", [-1, 1, 64, 2.5])
def test_invalid_counter_width_is_refused(bits):
    for make in (lambda: Encoder(bits=bits), lambda: Unwrapper(bits), lambda: unwrap([0, 1], bits)):
        with pytest.raises(ParameterError, match="encoder_bits"):
            make()


def test_unwrap_copies_counts_without_wraps_and_empty_arrays():
    counts = np.array([0, 200, -300, 2**40])
    for bits, shown in ((0, counts), (8, counts[:0])):
        result = unwrap(shown, bits)
        assert np.array_equal(result, shown) and result is not shown
    result = unwrap(counts, 0)
    result[0] = 7
    assert counts[0] == 0
    assert unwrap([1], 8).tolist() == [1]


def test_unwrapper_starts_from_next_count_after_reset():
    one = Unwrapper(8)
    assert [one(c) for c in (100, 127, -128)] == [100, 127, 128]
    one.reset()
    assert [one(c) for c in (-100, -90)] == [-100, -90]


@pytest.mark.parametrize("window", [1, 2, 5])
def test_speed_is_the_count_difference_over_its_window(window):
    speed, counts = DifferencedSpeed(Encoder(64.0), window), [0, 3, 4, 4, 9, 2, 30, 31]
    assert speed.total == 0
    times = np.cumsum([0.5, 0.25, 0.125, 0.5, 1.0, 0.25, 0.125, 2.0])
    for k, (time, count) in enumerate(zip(times, counts)):
        value, first = speed.step(float(time), count), max(k - window, 0)
        assert speed.total == count
        if k == 0:
            assert math.isnan(value)
        else:
            moved = (count - counts[first]) * 2.0 * math.pi / 64.0
            assert value == pytest.approx(moved / (times[k] - times[first]))
    assert math.isnan(DifferencedSpeed(Encoder()).step(1.0, 5))
    again = DifferencedSpeed(Encoder(64.0), 1)
    again.step(1.0, 5)
    assert math.isnan(again.step(1.0, 9)), "no time has passed"
    plain = DifferencedSpeed(Encoder(64.0))  # a window of one
    for k in range(3):
        value = plain.step(float(k), k * k)
    assert value == pytest.approx(3.0 * 2.0 * math.pi / 64.0)


def test_reset_clears_counter_and_window():
    speed = DifferencedSpeed(Encoder(64.0, 8), window=2)
    speed.step(0.0, 100)
    speed.step(1.0, 120)
    speed.reset()
    assert math.isnan(speed.step(2.0, -100)) and speed.total == -100


def test_counts_per_revolution_has_default_and_accepts_its_limits():
    assert Encoder().counts_per_revolution == 500.0 and Encoder().bits == 0
    for value in (1e-3, 1e9):
        assert Encoder(value).angle_per_count == pytest.approx(2.0 * math.pi / value)
