# SPDX-License-Identifier: Apache-2.0
"""Coarse counts are recovered from a speed that is their difference."""

from dataclasses import replace

import numpy as np
from motors import check

from smp_motor_ident.estimate import estimate
from smp_motor_ident.quality.differenced import (
    correct_nominal_period,
    read_count_rounding,
    recover_counts,
)
from smp_motor_ident.record import Hardware, Record

GAIN, LAG, STEP, TURN = 40.0, 0.03, 0.001, 2 * np.pi / 48
"""rad/s/V, s, sampling interval [s] and a count [rad]: one count a sample is 131 of 480 rad/s."""


def simulate_closed_loop(samples: int = 8000, over: int = 1) -> Record:
    """Return a closed-loop record with speed from counts over one or several samples."""
    rng = np.random.default_rng(2)
    wanted = np.repeat(rng.uniform(-130.0, 130.0, samples // 200), 200)
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


def test_closed_loop_estimate_from_differenced_counts_is_unbiased():
    record = simulate_closed_loop()
    (summed,) = recover_counts([record])
    moved = np.diff(summed.position) / TURN
    np.testing.assert_allclose(moved, np.rint(moved), atol=1e-6)  # rounding of a sum of thousands
    np.testing.assert_allclose(np.diff(summed.position) / STEP, record.velocity[1:], atol=1e-6)
    found = estimate(record)
    check(found, {"dc_gain": GAIN}, most=0.005)
    check(found, {"time_constant": LAG}, most=0.02)


def test_counts_are_detected_in_the_speed_of_an_unmodelled_motor():
    """Quantisation is detected even if a load swings on after the command."""
    t = STEP * np.arange(3000)
    speed = np.where(t < 1.5, 1 - np.exp(-t / 0.05), np.exp(-(t - 1.5)) * np.cos(3 * t))
    count = np.floor(np.cumsum(60.0 * speed) * STEP / TURN)
    record = Record("motor", t, 6.0 * (t < 1.5), velocity=np.diff(count, prepend=0) * TURN / STEP)
    (summed,) = recover_counts([record])
    np.testing.assert_allclose(summed.position / TURN, count, atol=1e-6)


def test_counts_are_not_recovered_from_speed_differenced_over_several_samples():
    record = simulate_closed_loop(over=4)
    assert recover_counts([record])[0] is record and read_count_rounding(record) == 0.0
    # The same next to a recoverable record.
    assert recover_counts([simulate_closed_loop(), record])[1] is record


def test_counts_are_not_recovered_from_speed_with_lost_samples():
    record = simulate_closed_loop()
    lost = np.delete(np.arange(len(record)), 500)
    gap = Record("motor", record.time[lost], record.voltage[lost], velocity=record.velocity[lost])
    assert recover_counts([gap])[0] is gap
    broken = record.velocity.copy()
    broken[500] = np.nan
    missing = replace(record, velocity=broken)
    assert recover_counts([missing])[0] is missing


PERIOD = 0.0115
"""Nominal loop period [s] by which the firmware divides; the real loop is jittered."""


def simulate_jittered_loop(per_turn: float | None, nominal: bool) -> Record:
    """Return speed from counts over the nominal period or over the true intervals."""
    rng = np.random.default_rng(7)
    interval = 0.01 + rng.exponential(0.001, 1500) + (rng.random(1500) < 0.01) * 0.03
    volts = np.repeat(rng.uniform(-12.0, 12.0, 50), 30)
    angle, speed, counts = 0.0, 0.0, []
    for u, h in zip(volts, interval, strict=True):
        keep = np.exp(-h / 0.1)
        angle += GAIN * u * h + (speed - GAIN * u) * 0.1 * (1 - keep)
        speed = GAIN * u + (speed - GAIN * u) * keep
        counts.append(np.floor(angle / TURN))
    moved = np.diff(counts, prepend=0.0) * TURN
    shown = moved / (PERIOD if nominal else interval)
    hardware = Hardware(counts_per_revolution=per_turn)
    time = np.cumsum(interval) - interval[0]
    return Record("motor", time, volts, velocity=shown, hardware=hardware)


def test_speed_over_the_nominal_period_is_corrected_to_true_intervals():
    put_right = correct_nominal_period(simulate_jittered_loop(48.0, nominal=True))
    real = simulate_jittered_loop(48.0, nominal=False)
    np.testing.assert_allclose(put_right.velocity[1:], real.velocity[1:], rtol=1e-9)
    assert correct_nominal_period(real) is real
    check(estimate(simulate_jittered_loop(48.0, nominal=True)), {"dc_gain": GAIN}, most=0.005)


def test_unknown_nominal_period_makes_the_estimate_unreliable():
    found = estimate(simulate_jittered_loop(None, nominal=True))
    (said,) = [f for f in found.findings if f.code == "nominal_period"]
    assert said.severity == "unreliable" and "counts_per_revolution" in said.advice


def test_stamp_jitter_of_a_periodic_sensor_is_not_corrected_as_nominal_period():
    record = simulate_jittered_loop(48.0, nominal=False)
    regular = PERIOD * np.arange(len(record))
    even = replace(record, time=regular, velocity=GAIN * record.voltage)
    late = np.random.default_rng(3).exponential(0.1 * PERIOD, len(record))
    stamped = replace(even, time=np.maximum.accumulate(regular + late) + 1e-9 * regular)
    assert correct_nominal_period(stamped) is stamped
