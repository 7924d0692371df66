"""A speed that is a difference of coarse counts is summed up to them again."""

from dataclasses import replace

import numpy as np
import pytest

from smp_motor_ident.diagnosis.differenced import counts_again, rounding
from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Record

GAIN, LAG, STEP, TURN = 40.0, 0.03, 0.001, 2 * np.pi / 48
"""rad/s/V, s, sampling interval [s] and a count [rad]: one count a sample is 131 of 480 rad/s."""


def looped(samples: int = 8000, over: int = 1) -> Record:
    """A speed loop that feeds differences of counts back, over one sample or several."""
    rng = np.random.default_rng(2)
    wanted = np.repeat(rng.uniform(-300.0, 300.0, samples // 200), 200)
    keep = np.exp(-STEP / LAG)
    angle, speed, integral = rng.uniform(0.0, TURN), 0.0, 0.0
    counts, voltage, shown = [np.floor(angle / TURN)] * (over + 1), [0.0], [0.0]
    for target in wanted[1:]:
        error = target - shown[-1]
        integral = np.clip(integral + 0.4 * STEP * error, -10.0, 10.0)
        u = float(np.clip(integral + 0.01 * error, -12.0, 12.0))
        steady = GAIN * u
        angle += steady * STEP + (speed - steady) * LAG * (1 - keep)
        speed = steady + (speed - steady) * keep
        counts.append(np.floor(angle / TURN))
        voltage.append(u)
        shown.append((counts[-1] - counts[-1 - over]) * TURN / (over * STEP))
    t = STEP * np.arange(samples)
    return Record("motor", t, np.array(voltage), velocity=np.array(shown))


def test_a_speed_of_one_count_a_sample_is_its_counts_and_no_loop_biases_them():
    record = looped()
    (summed,) = counts_again([record])
    moved = np.diff(summed.position) / TURN
    np.testing.assert_allclose(moved, np.rint(moved), atol=1e-6)  # rounding of a sum of thousands
    np.testing.assert_allclose(np.diff(summed.position) / STEP, record.velocity[1:], atol=1e-6)
    found = estimate(record)
    gain, lag = found.combinations["dc_gain"], found.combinations["time_constant"]
    assert abs(gain.value - GAIN) < 4 * gain.std and gain.std < 0.005 * GAIN
    assert abs(lag.value - LAG) < 4 * lag.std and lag.std < 0.02 * LAG
    # What a loop gets to see is the speed: two roundings of a uniform error.
    assert found.speed_noise == pytest.approx(TURN / STEP / np.sqrt(6), rel=1e-6)
    assert found.value("averaging_window") == pytest.approx(STEP)


def test_a_speed_over_several_samples_is_no_difference_of_neighbouring_counts():
    record = looped(over=4)
    assert counts_again([record])[0] is record and rounding(record) == 0.0
    assert counts_again([looped(), record])[1] is record  # and none of the others is


def test_what_has_lost_samples_or_values_cannot_be_summed():
    record = looped()
    lost = np.delete(np.arange(len(record)), 500)
    gap = Record("motor", record.time[lost], record.voltage[lost], velocity=record.velocity[lost])
    assert counts_again([gap])[0] is gap
    broken = record.velocity.copy()
    broken[500] = np.nan
    missing = replace(record, velocity=broken)
    assert counts_again([missing])[0] is missing
