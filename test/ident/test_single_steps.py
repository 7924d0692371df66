# SPDX-License-Identifier: Apache-2.0
"""A step from rest to one level of voltage: its identifiable quantities."""

from dataclasses import replace

import motors
import numpy as np
import pytest

from smp_motor_ident.estimate import estimate
from smp_motor_ident.fit.data import speed_quantum
from smp_motor_ident.quality.lag import apply_lag
from smp_motor_ident.record import Record


def test_gain_from_one_step_is_unidentifiable_or_within_its_uncertainty():
    """A step from rest identifies only the gain times the voltage above friction."""
    gain, tau, friction = 11.45, 0.1967, 0.294
    t = np.arange(60) / 20.0
    voltage = np.where(t > 0.5, 4.8, 0.0)
    on = np.maximum(t - 0.5, 0.0)
    angle = gain * (4.8 - friction) * (on - tau * (1 - np.exp(-on / tau)))
    step = 2 * np.pi / 1024
    speed = np.diff(np.floor(angle / step), prepend=0.0) * step * 20.0
    found = estimate(Record("motor", t, voltage, velocity=speed))
    q = found.combinations["dc_gain"]
    assert q.value is None or abs(q.value - gain) < 2 * q.total_std
    steady = found.combinations["steady_speed"]
    assert abs(steady.value - gain * (4.8 - friction)) < 4 * steady.std < 1.0


def _step(rows: int, seed: int) -> Record:
    """Return 1.5 s at 8 V, from rest to a steady speed, and ``rows`` rows of coasting."""
    gain, tau, friction = 15.0, 0.12, 2.0
    t = np.arange(60 + rows) / 40.0
    up = gain * (8.0 - friction) * (1 - np.exp(-t / tau))
    down = (up[59] + gain * friction) * np.exp(-(t - t[59]) / tau) - gain * friction
    speed = np.where(t <= t[59], up, np.maximum(down, 0.0))
    noise = 0.5 * np.random.default_rng(seed).standard_normal(t.size)
    return Record("motor", t, np.where(t <= t[59], 8.0, 0.0), velocity=speed + noise)


def test_one_coast_separates_gain_and_friction_in_steps_to_one_level():
    found = estimate([_step(30 if n == 3 else 0, n) for n in range(7)])
    # Friction without a load; four standard deviations are one in 16,000.
    motors.check(found, {"dc_gain": 15.0, "static_voltage": 2.0}, most=0.25)


def test_steps_of_one_size_are_reported_as_hiding_a_driver_ramp():
    """A driver ramp of constant duration is confounded with averaging by the sensor."""
    rng, tau = np.random.default_rng(4), 0.02
    for sizes, said in (((2.0,), True), ((1.0, 2.0, 4.0), False)):
        steps = rng.choice(sizes, 24) * np.r_[np.ones(12), -np.ones(12)]
        command = np.repeat(np.r_[0.0, np.cumsum(steps)], 100)
        speed = apply_lag(8.0 * command, tau / 0.005) + 0.3 * rng.standard_normal(command.size)
        t = 0.005 * np.arange(command.size)
        codes = [f.code for f in estimate(Record("motor", t, command, velocity=speed)).findings]
        assert ("one_size_of_step" in codes) is said and "one_size_of_voltage" not in codes


WINDOW, STEP, UNIT = 32, 1e-3, 0.12982  # samples, s, rounding of the log [rad/s]
TAU, GAIN = 0.025, 17.0


def simulate_logged_step(volts: float) -> Record:
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
def test_mirrored_step_gives_the_same_estimate(volts):
    record = simulate_logged_step(volts)
    mirror = replace(record, voltage=-record.voltage, velocity=-record.velocity)
    one, other = estimate(record), estimate(mirror)
    assert one.model == other.model
    assert [f.severity for f in one.findings] == [f.severity for f in other.findings]
    for name in ("time_constant", "averaging_window"):
        # The same sums with opposite signs: only rounding may differ.
        assert one.value(name) == pytest.approx(other.value(name), rel=1e-6)
    # A remaining lag takes up to 3 ms from the window; one step is confounded with a driver ramp.
    ramp = one.chain.values.get("ramp_time", 0.0)
    assert one.value("averaging_window") + ramp == pytest.approx(WINDOW * STEP, abs=0.004)
    lag = one.combinations["time_constant"]
    assert abs(lag.value - TAU) < 2 * lag.total_std


@pytest.mark.parametrize("sign", [1, -1])
def test_speed_quantum_is_found_despite_uneven_rounding_of_the_log(sign):
    speed = simulate_logged_step(sign * 8.1).velocity
    # A line through 36 levels, each out by half a unit, is out by far less than a unit.
    assert speed_quantum(speed) == pytest.approx(31.25 * UNIT, rel=0.005)
