# SPDX-License-Identifier: Apache-2.0
"""Magnitudes without a sign are detected and named."""

from dataclasses import replace

import motors
import numpy as np
import pytest

from smp_motor_ident.errors import SignalError
from smp_motor_ident.estimate import estimate


def make_record(kinds=("square", "fourier")):
    return motors.record("rear_left", current=False, kinds=kinds)


@pytest.mark.parametrize("kind", ["sine", "square", "fourier"])
def test_a_command_without_its_sign_is_refused_by_name(kind):
    record = make_record((kind,))
    with pytest.raises(SignalError, match="no sign; map its direction"):
        estimate(replace(record, voltage=np.abs(record.voltage)))


@pytest.mark.parametrize("kind", ["sine", "square", "fourier"])
def test_a_speed_without_its_sign_is_refused_by_name(kind):
    record = make_record((kind,))
    size = replace(record, velocity=np.abs(record.velocity), count=None)
    with pytest.raises(SignalError, match="velocity is never negative"):
        estimate(size)


def test_braking_pulses_in_one_direction_are_not_a_lost_sign():
    """A speed may be non-negative because the motor never reverses."""
    rng = np.random.default_rng(1)
    runs = [(volts, n) for n in rng.integers(20, 60, 40) for volts, n in ((8.0, n), (-2.0, 8))]
    volts = np.concatenate([np.full(n, v) for v, n in runs])
    record = motors.record("rear_left", current=False, kinds=("square",), voltage=volts,
                           seconds=(volts.size + 0.5) / 200)  # fmt: skip
    assert record.velocity.min() >= 0
    found = estimate(replace(record, count=None))
    truth = motors.truth("rear_left", 0.3)
    assert found.value("dc_gain") == pytest.approx(truth["dc_gain"], rel=0.05)


@pytest.mark.parametrize("speed", [True, False])
def test_noise_at_rest_is_not_backward_motion(speed):
    volts = np.repeat([0.0, 3.0, 6.0, 2.0], [1800, 40, 60, 40])
    record = motors.record("rear_left", current=False, voltage=volts, seconds=4.0)
    rng = np.random.default_rng(2)
    noise = rng.standard_normal(len(record))
    own = {"velocity": record.velocity + 0.15 * np.ptp(record.velocity) * noise}
    if not speed:
        own = {"velocity": None, "position": record.count * motors.QUANTUM + 5.0 * noise}
    found = estimate(replace(record, count=None, **own))
    assert found.value("dc_gain") == pytest.approx(motors.truth("rear_left", 0.3)["dc_gain"], 0.5)


@pytest.mark.parametrize("full", [100, 255, 1023])
def test_duty_cycle_counts_mapped_as_voltage_are_reported(full):
    record = make_record()
    counts = np.rint(record.voltage / 10.0 * full)
    codes = [f.code for f in estimate(replace(record, voltage=counts)).findings]
    assert "whole_volts" in codes


def test_voltage_in_whole_volts_is_not_reported():
    record = make_record()
    volts = [f.code for f in estimate(replace(record, voltage=np.rint(record.voltage))).findings]
    assert "whole_volts" not in volts


@pytest.mark.parametrize(
    ("scale", "severity"), [(1.0, None), (20.3, "warning"), (300.7, "unreliable")]
)
def test_implausibly_high_voltage_is_reported(scale, severity):
    record = make_record()
    found = estimate(replace(record, voltage=scale * record.voltage)).findings
    said = [f.severity for f in found if f.code == "high_voltage"]
    assert said == ([severity] if severity else [])


def test_counts_without_counts_per_revolution_are_refused():
    record = make_record()
    bare = replace(record, velocity=None, hardware=replace(record.hardware,
                                                           counts_per_revolution=None))  # fmt: skip
    with pytest.raises(SignalError, match="map counts_per_revolution"):
        estimate(bare)
