# SPDX-License-Identifier: Apache-2.0
"""Held-out data contradict a fit by their motion, not by their sensor's quantisation."""

from dataclasses import replace

import motors
import numpy as np
import pytest

from smp_motor_ident.estimate import estimate
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
def test_held_out_data_are_judged_by_what_their_sensor_can_show(share):
    if share == 1.0:  # a tail of a few counts is followed to a count: nothing speaks against it
        found = estimate(weaker(CHIRP, 1.0, RATE))
    else:
        volts = motors.independent.excitation(np.arange(2000) / 200.0, "square", 10.0)
        found = estimate(weaker(volts, share, 200.0))
    codes = {f.code: f.severity for f in found.findings}
    assert ("validation" in codes or "supply_drift" in codes) == (share < 1.0)
