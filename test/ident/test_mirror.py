# SPDX-License-Identifier: Apache-2.0
"""A motor that is driven backwards is the same motor."""

from dataclasses import replace

import numpy as np
import pytest

from smp_motor_ident.estimate import estimate
from smp_motor_ident.fit.data import speed_quantum
from smp_motor_ident.record import Record

WINDOW, STEP, UNIT = 32, 1e-3, 0.12982  # samples, s, rounding of the log [rad/s]
TAU, GAIN = 0.025, 17.0


def logged_step(volts: float) -> Record:
    """Return a step whose speed is a position difference in counts, logged as whole units."""
    rng = np.random.default_rng(3)
    time = STEP * np.arange(1900)
    since = np.maximum(time - 0.4085, 0.0)
    turned = GAIN * volts * (since - TAU * (1 - np.exp(-since / TAU)))
    quantum = 31.25 * UNIT  # no whole number of units: the log shows steps of 31 and 32
    count = np.floor(turned / (quantum * WINDOW * STEP) + rng.uniform())
    difference = count - np.concatenate([np.full(WINDOW, count[0]), count[:-WINDOW]])
    speed = np.round(difference * 31.25) * UNIT + UNIT
    voltage = np.where(time < 0.4085, 0.00226, volts)
    return Record("motor", time, voltage, velocity=speed)


@pytest.mark.parametrize("volts", [8.1, -8.1])
def test_a_step_and_its_mirror_image_tell_the_same_motor(volts):
    record = logged_step(volts)
    mirror = replace(record, voltage=-record.voltage, velocity=-record.velocity)
    one, other = estimate(record), estimate(mirror)
    assert one.model == other.model
    assert [f.severity for f in one.findings] == [f.severity for f in other.findings]
    for name in ("time_constant", "averaging_window"):
        # The same sums in other signs: nothing but rounding may differ.
        assert one.value(name) == pytest.approx(other.value(name), rel=1e-6)
    # A remaining lag takes up to 3 ms from the window; under one step a driver's ramp looks alike.
    ramp = one.chain.values.get("ramp_time", 0.0)
    assert one.value("averaging_window") + ramp == pytest.approx(WINDOW * STEP, abs=0.004)
    lag = one.combinations["time_constant"]
    assert abs(lag.value - TAU) < 2 * lag.total_std


@pytest.mark.parametrize("sign", [1, -1])
def test_steps_that_a_log_rounds_unevenly_are_steps(sign):
    speed = logged_step(sign * 8.1).velocity
    # A line through 36 levels, each out by half a unit, is out by far less than a unit.
    assert speed_quantum(speed) == pytest.approx(31.25 * UNIT, rel=0.005)
