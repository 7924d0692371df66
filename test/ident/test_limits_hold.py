# SPDX-License-Identifier: Apache-2.0
"""Limits that no other test covers, checked through `estimate` alone."""

from dataclasses import replace

import motors
import numpy as np
import pytest

from smp_motor_ident.estimate import estimate
from smp_motor_ident.result import NORMAL_95, Quantity, Share


def share_of(quantity: Quantity, cause: str) -> Share | None:
    return next((s for s in quantity.systematic if s.cause == cause), None)


@pytest.mark.parametrize("scale", [0.96, 1.04])
def test_scale_error_of_a_current_is_within_the_systematic_uncertainty(scale):
    # 4 %: the specified tolerance of a Hall sensor.
    made = motors.record("rear_left", seconds=3.0)
    truth = motors.truth("rear_left", 0.3)
    found = estimate(replace(made, current=scale * made.current)).parameters
    for name in ("resistance", "inertia", "coulomb_friction"):
        value, low, high = found[name].value, *(found[name].total_ci95 or (np.nan, np.nan))
        assert low < truth[name] < high
        share = share_of(found[name], "current_scale")
        assert share.size == pytest.approx(0.03 * value)
        # A scale error is not random: the random interval excludes the truth.
        assert abs(value - truth[name]) > NORMAL_95 * (found[name].std or 0.0)
    assert share_of(found["motor_constant"], "current_scale") is None


def test_stated_current_accuracy_replaces_the_assumed_one():
    made = motors.record("rear_left", seconds=3.0)
    stated = replace(made, hardware=replace(made.hardware, current_accuracy=0.2))
    share = share_of(estimate(stated).parameters["resistance"], "current_scale")
    assert share is not None and share.share == pytest.approx(0.2)


def test_gain_at_one_amplitude_has_a_narrow_interval_and_a_stated_range():
    made = motors.record("rear_left", current=False, kinds=("square",), seconds=10.0)
    found = estimate(made)
    gain = found.combinations["dc_gain"]
    assert gain.value == pytest.approx(motors.truth("rear_left", 0.3)["dc_gain"], rel=0.01)
    assert gain.std is not None and gain.std < 0.005 * gain.value
    assert gain.valid == {"voltage": (-10.0, 10.0)}
    one_size = share_of(gain, "one_size_of_voltage")
    assert 0.02 < one_size.share < 0.5
    # Ten times the assumed voltage accuracy leaves a tenth of the uncertainty.
    meter = replace(made, hardware=replace(made.hardware, voltage_accuracy=0.01))
    measured = share_of(estimate(meter).combinations["dc_gain"], "one_size_of_voltage")
    assert measured is None or measured.size == pytest.approx(0.1 * one_size.size, rel=0.05)


def test_estimate_is_unreliable_if_friction_dominates_the_voltage():
    held = estimate(motors.record("rear_left", static_voltage=5.5, seconds=4.0))
    assert next(f for f in held.findings if f.code == "friction_dominates").severity == "unreliable"
    turns = estimate(motors.record("rear_left", static_voltage=4.5, seconds=4.0))
    assert "friction_dominates" not in [f.code for f in turns.findings]


def test_sampling_instant_error_is_part_of_the_systematic_uncertainty():
    """A delay of the readings is confounded with the time constant."""
    made = replace(motors.record("rear_left", current=False), velocity=None)
    known = replace(made, hardware=replace(made.hardware, timing_accuracy=0.0))
    moves = [
        {s.cause: s.moves["time_constant"] for s in estimate(one).systematic}.get("timing", 0.0)
        for one in (made, known)
    ]
    assert abs(moves[0]) == pytest.approx(0.02 * made.sample_time, rel=0.05)
    assert moves[1] == 0.0
