# SPDX-License-Identifier: Apache-2.0
"""A reversed response is separated from a delayed one, or reported as ambiguous."""

from dataclasses import replace

import motors
import numpy as np
import pytest

from smp_motor_ident.errors import InsufficientExcitationError, SignalError
from smp_motor_ident.quality.screen import _check_signs
from smp_motor_ident.quality.signs import correlate_with_voltage

GOOD = motors.record("rear_left", seconds=4.0)
N = len(GOOD)


def sine(samples, rate=100.0, seconds=10.0):
    """Return counts under a sine with the given number of samples per period."""
    volts = 10.0 * np.sin(2 * np.pi * np.arange(int(rate * seconds)) / samples + 0.1)
    return motors.record("rear_left", voltage=volts, rate=rate)


def steps(rate=100.0):
    held = np.random.default_rng(1).choice([-10.0, 10.0], 40)
    return motors.record("rear_left", voltage=np.repeat(held, 25), rate=rate)


def swap_sign(record):
    return replace(record, count=-record.count, velocity=-record.velocity)


def delay_counts(record, samples):
    """Return a record with counts delayed by whole samples."""
    k = np.maximum(np.arange(len(record)) - samples, 0)
    return replace(record, count=record.count[k], velocity=record.velocity[k])


SLOW = {"steps": steps, "slow sine": lambda: sine(150.0), "fast sine": lambda: sine(25.0)}


@pytest.mark.parametrize("name", SLOW)
def test_swapped_leads_are_refused_and_correct_ones_accepted(name):
    for delay in (0, 1, 2):
        record = delay_counts(SLOW[name](), delay)
        _check_signs([record], "record")
        with pytest.raises(SignalError, match="swapped sign, speed"):
            _check_signs([swap_sign(record)], "record")


def test_swapped_current_sign_is_refused_and_the_correct_one_accepted():
    for name, make in SLOW.items():
        record = make()
        _check_signs([record], name)
        with pytest.raises(SignalError, match="swapped sign, current"):
            _check_signs([replace(record, current=-record.current)], name)


def test_sign_of_a_lagging_current_is_not_judged_in_a_decimated_record():
    """The command switches every eight rows and every fifth row is kept, so the current lags."""
    bits = np.random.default_rng(1).choice([-10.0, 10.0], 375)
    whole = motors.record("rear_left", voltage=np.repeat(bits, 8), rate=200.0)
    kept = np.arange(0, 2990, 5)
    there = {n: getattr(whole, n)[kept] for n in ("time", "voltage", "count")}
    thin = replace(whole, velocity=None, current=whole.current[kept + 8], **there)
    assert correlate_with_voltage([thin], [thin.current], lags=False).wrong > 0.4
    _check_signs([thin], "record")


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("samples", [2.9, 3.0, 3.1])
def test_three_samples_per_period_do_not_determine_the_sign(samples, sign):
    """Lag, sampling and the driver's clock may add up to any phase: no cause is named."""
    record = sine(samples) if sign > 0 else swap_sign(sine(samples))
    found = correlate_with_voltage([record], [record.velocity], lags=True)
    # Half a sample is 60 degrees: the nearest delay misses the phase by 30 at most.
    assert min(found.right, found.wrong) > 0.8 * max(found.right, found.wrong)
    with pytest.raises(InsufficientExcitationError, match=r"too fast, .* samples: a speed"):
        _check_signs([record], "record")


def test_a_motor_at_rest_has_no_swapped_sign():
    """The noise of a sensor at standstill has no sign, whatever its correlation."""
    for seed in range(12):
        rng = np.random.default_rng(seed)
        slow = np.cumsum(rng.standard_normal(N))  # drifts as a command does
        slow = 5.0 * (slow - slow.mean()) / np.abs(slow - slow.mean()).max()
        noise = rng.standard_normal(N)
        noise = replace(GOOD, voltage=slow, count=None, current=None, velocity=noise)
        _check_signs([noise], "record")
    with pytest.raises(SignalError, match="swapped sign"):
        _check_signs([swap_sign(GOOD)], "record")


def test_swapped_sign_is_found_despite_gaps_and_sensor_noise():
    rng = np.random.default_rng(2)
    speed = -GOOD.velocity + 200.0 * rng.standard_normal(N)
    speed[rng.random(N) < 0.2] = np.nan
    with pytest.raises(SignalError, match="swapped sign, speed"):
        _check_signs([replace(GOOD, count=None, velocity=speed)], "record")
