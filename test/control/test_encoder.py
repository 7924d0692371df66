"""Counts from angles, rollover of counters of any width, speed from counts."""

from __future__ import annotations

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
def test_unwrapping_undoes_wrapping_while_steps_stay_below_half_the_range(bits, steps, start):
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


def test_count_is_the_angle_in_whole_counts_in_both_directions():
    encoder = Encoder(500.0)
    one = encoder.angle_per_count
    assert [encoder.count(k * one * 1.0001) for k in (0, 1, 250, 500)] == [0, 1, 250, 500]
    assert encoder.count(-0.5 * one) == -1


def test_speed_over_a_window_is_the_mean_speed_of_that_window():
    encoder = Encoder(500.0, bits=8)
    speed = DifferencedSpeed(encoder, window=4)
    assert math.isnan(speed.step(0.0, encoder.count(0.0)))
    for k in range(1, 200):
        value = speed.step(0.01 * k, encoder.count(30.0 * 0.01 * k))
    # One count over the window of 40 ms is 0.31 rad/s.
    assert value == pytest.approx(30.0, abs=0.32)


def test_speed_starts_anew_after_a_reset():
    speed = DifferencedSpeed(Encoder(500.0))
    speed.step(0.0, 0)
    speed.reset()
    assert math.isnan(speed.step(0.01, 10_000_000))


@pytest.mark.parametrize("bad", [{"counts_per_revolution": 0.0}, {"bits": 1}, {"bits": 64}])
def test_impossible_encoder_is_refused(bad):
    with pytest.raises(ParameterError):
        Encoder(**bad)
    with pytest.raises(ParameterError, match="window"):
        DifferencedSpeed(Encoder(), 0)
