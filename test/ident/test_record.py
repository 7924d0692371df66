# SPDX-License-Identifier: Apache-2.0
"""A Record refuses inconsistent signals by name."""

import numpy as np
import pytest

from smp_motor_ident.errors import SignalError
from smp_motor_ident.record import Record


def make_record(**changes):
    time = np.arange(6) * 0.01
    signals = {"wheel": "front_left", "time": time, "voltage": np.ones(6), "velocity": time * 3}
    return Record(**{**signals, **changes})


def test_duration_and_sample_time_come_from_the_time_axis():
    record = make_record()
    assert len(record) == 6
    # Sums of 0.01 in floating point: exact to a few units in the last place.
    assert record.duration == pytest.approx(0.05, rel=1e-12)
    assert record.sample_time == pytest.approx(0.01, rel=1e-12)


def test_signals_are_kept_contiguous_and_as_float():
    record = make_record(velocity=np.arange(12)[::2])
    assert record.velocity.dtype == np.float64
    assert record.velocity.flags["C_CONTIGUOUS"]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"time": np.array([0, 0.01, 0.01, 0.02, 0.03, 0.04])}, "sample 2"),
        ({"time": np.array([0.0])}, "at least 2 samples"),
        ({"voltage": np.ones(5)}, "voltage has 5 samples"),
        ({"voltage": np.array([1, 1, np.nan, 1, 1, 1])}, r"voltage is nan at t = 0\.02"),
        ({"velocity": None}, "neither velocity, position nor encoder counts"),
        ({"count": np.arange(3)}, "count has 3 samples"),
        ({"starts": (0, 4, 4)}, "must increase"),
        ({"starts": (1,)}, "must increase from 0"),
    ],
)
def test_contradictory_signals_are_refused_by_name(changes, named):
    with pytest.raises(SignalError, match=named):
        make_record(source="bench.mcap", **changes)


@pytest.mark.parametrize("name", ["current", "velocity", "position"])
def test_an_infinite_measurement_counts_as_missing(name):
    # Firmware that divides by the time between pulses sends them.
    measured = np.array([0.0, 1.0, np.inf, -np.inf, np.nan, 5.0])
    record = make_record(**{"velocity": np.ones(6), name: measured})
    lost = [False, False, True, True, True, False]
    np.testing.assert_array_equal(np.isnan(getattr(record, name)), lost)
    assert np.isinf(measured[2])  # the caller's array is as it was


def test_slice_starts_at_time_zero_and_keeps_inner_segments():
    part = make_record(starts=(0, 2, 4), count=np.arange(6)).slice(1, 5)
    assert part.starts == (0, 1, 3)
    assert part.time[0] == 0
    np.testing.assert_array_equal(part.count, [1, 2, 3, 4])
