# SPDX-License-Identifier: Apache-2.0
"""Samples with equal stamps are repaired or merged, with a finding."""

from dataclasses import replace

import motors
import numpy as np
import pytest

from smp_motor_ident.estimate import estimate
from smp_motor_ident.quality.stamps import merge_bunches
from smp_motor_ident.record import Record


def make_bunched_record(size: int) -> Record:
    """Return a record with stamps equal to 1 ns in bunches, as from a coarse clock."""
    made = motors.record("rear_left", current=False, seconds=8.0)
    row = np.arange(len(made))
    last = np.minimum((row // size + 1) * size - 1, len(made) - 1)
    return replace(made, time=made.time[last] + 1e-9 * (row % size))


def test_equal_stamps_of_a_periodic_sensor_are_repaired_with_a_finding():
    plain = estimate(motors.record("rear_left", current=False, seconds=8.0))
    found = estimate(make_bunched_record(4))
    assert "arrival_beat" in [f.code for f in found.findings]
    # The sampling instants are known to 1/20 of a sample: about 1/100 of the time constant.
    assert found.value("dc_gain") == pytest.approx(plain.value("dc_gain"), rel=0.002)
    assert found.value("time_constant") == pytest.approx(plain.value("time_constant"), rel=0.02)


def test_merging_bunches_keeps_one_sample_per_stamp_with_a_warning():
    merged = merge_bunches(make_bunched_record(4))
    assert len(merged) == pytest.approx(len(make_bunched_record(4)) / 4, abs=1)
    assert [f.severity for f in merged.findings if f.code == "stamps_equal"] == ["warning"]


def test_merging_bunches_keeps_segment_start_times():
    made = make_bunched_record(4)
    made = replace(made, starts=(0, 401, 1203))
    merged = merge_bunches(made)
    assert [made.time[s] for s in made.starts] == pytest.approx(
        [merged.time[s] for s in merged.starts],
        abs=1e-8,  # the nanoseconds within a bunch
    )


def test_merging_bunches_leaves_distinct_stamps_unchanged():
    made = motors.record("rear_left", current=False, seconds=5.0)
    assert merge_bunches(made) is made
