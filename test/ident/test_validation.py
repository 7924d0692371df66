"""Held-out data speak against a fit by what the motor does in them, not by their sensor's steps."""

from dataclasses import replace

import motors
import numpy as np
import pytest

from smp_motor_ident.diagnosis import validation
from smp_motor_ident.estimate import estimate
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.record import Record

RATE = 2000.0
TIME = np.arange(int(6 * RATE)) / RATE
CHIRP = 10.0 * np.sin(2 * np.pi * (0.3 * TIME + 6.0 * TIME**2))  # to 72 Hz: a small swing at last


def weaker(volts: np.ndarray, share: float, rate: float) -> Record:
    """Return counts of a motor that in the last three tenths gets this share of its voltage."""
    late = np.arange(volts.size) >= 0.7 * volts.size
    given = np.where(late, share * volts, volts)
    made = motors.record("rear_left", current=False, voltage=given, rate=rate)
    return replace(made, voltage=volts, velocity=None)


@pytest.mark.parametrize("share", [1.0, 0.7])
def test_held_out_data_are_judged_by_what_their_sensor_can_show(monkeypatch, share: float) -> None:
    judged = []
    held_out = validation.held_out
    monkeypatch.setattr(
        validation, "held_out", lambda *given: judged.append(held_out(*given)) or judged[-1]
    )
    if share == 1.0:  # a tail of a few counts is followed to a count: nothing speaks against it
        found = estimate(weaker(CHIRP, 1.0, RATE))
        assert all(np.isnan(own) and np.isnan(common) for own, common in judged)
    else:
        volts = motors.independent.excitation(np.arange(2000) / 200.0, "square", 10.0)
        found = estimate(weaker(volts, share, 200.0))
    assert judged
    assert ("validation" in [f.code for f in found.findings]) == (share < 1.0)


def test_no_speed_is_a_mean_over_more_than_the_longest_segment():
    record = motors.record("rear_left", current=False, seconds=2.0)
    record = replace(record, starts=tuple(range(0, len(record), 6)))
    data = replace(prepare([record], False, "auto", "held"), quantum=1.0)  # far above its motion
    assert validation._lag(data, data.output) < 6
