# SPDX-License-Identifier: Apache-2.0
"""Outliers that return within a sample are removed; real motion is not."""

import numpy as np
import pytest
from motors import check, first_order

from smp_motor_ident.estimate import estimate
from smp_motor_ident.quality.glitches import remove_glitches
from smp_motor_ident.record import Record

GAIN, TAU, STEP = 25.0, 0.06, 0.01
ROWS = 3_000


def simulate_record(seed: int, noise: float = 0.3, hold: int = 25, tau: float = TAU) -> Record:
    """Return the speed of a linear motor of first order under random levels of voltage."""
    rng = np.random.default_rng(seed)
    voltage = np.repeat(rng.uniform(-10.0, 10.0, ROWS // hold), hold)
    speed = first_order(voltage, GAIN, tau, STEP) + noise * rng.standard_normal(ROWS)
    return Record("motor", STEP * np.arange(ROWS), voltage, velocity=speed)


def add_glitches(record: Record, share: float, size: float, seed: int = 0) -> Record:
    rng = np.random.default_rng(seed)
    wrong = rng.random(len(record)) < share
    speed = np.where(wrong, size * rng.uniform(-1.0, 1.0, len(record)), record.velocity)
    return Record(record.wheel, record.time, record.voltage, velocity=speed)


@pytest.mark.parametrize(("share", "size"), [(0.001, 700.0), (0.005, 700.0), (0.02, 1e4)])
@pytest.mark.parametrize("seed", range(2))
def test_glitches_are_reported_and_do_not_bias_the_estimate(seed, share, size):
    found = estimate(add_glitches(simulate_record(seed), share, size, seed))
    (words,) = [f for f in found.findings if f.code == "glitches"]
    assert words.severity == "warning" and words.evidence["signal"] == "velocity"
    assert not found.unreliable
    # Outliers within a twentieth of the speed range remain and widen the intervals.
    check(found, {"dc_gain": GAIN, "time_constant": TAU}, most=0.01)


@pytest.mark.parametrize(
    "kind",
    [{}, {"noise": 0.0}, {"noise": 30.0}, {"hold": 1}, {"tau": 1e-3}, {"tau": 1e-3, "hold": 1}],
    ids=["usual", "no noise", "noise", "level per sample", "fast", "fast, level per sample"],
)
@pytest.mark.parametrize("seed", range(5))
def test_noise_and_fast_motion_are_not_glitches(seed, kind):
    record = simulate_record(seed, **kind)
    assert remove_glitches(record) is record


@pytest.mark.parametrize("quantum", [0.1, 2.0, 20.0])
def test_quantised_speed_has_no_glitches(quantum):
    record = simulate_record(3)
    coarse = Record(
        "motor", record.time, record.voltage,
        velocity=quantum * np.round(record.velocity / quantum),
    )  # fmt: skip
    assert remove_glitches(coarse) is coarse


def test_the_response_to_a_short_pulse_is_not_a_glitch():
    voltage = np.zeros(1_000)
    voltage[50::100] = 10.0
    speed = np.concatenate([[0.0], GAIN * voltage[:-1]])
    record = Record("motor", STEP * np.arange(1_000), voltage, velocity=speed)
    assert remove_glitches(record) is record


def test_consecutive_glitches_of_an_angle_are_removed():
    record = simulate_record(1)
    angle = np.cumsum(record.velocity) * STEP
    wrong = angle.copy()
    wrong[500], wrong[900:903], wrong[1500] = 900.0, (-700.0, 800.0, 650.0), 0.0
    cleaned = remove_glitches(Record("motor", record.time, record.voltage, position=wrong))
    lost = np.flatnonzero(~np.isfinite(cleaned.position))
    assert list(lost) == [500, 900, 901, 902, 1500]
    np.testing.assert_array_equal(np.delete(cleaned.position, lost), np.delete(angle, lost))


def test_frequent_outliers_are_not_removed_as_glitches():
    record = add_glitches(simulate_record(2), 0.15, 700.0)
    assert remove_glitches(record) is record


@pytest.mark.parametrize("lost", [0, 150])
def test_lost_readings_are_reported_in_addition_to_glitches(lost):
    record = add_glitches(simulate_record(1), 0.005, 700.0)
    speed = record.velocity.copy()
    speed[1_000 : 1_000 + lost] = np.nan
    found = estimate(Record("motor", record.time, record.voltage, velocity=speed)).findings
    shares = [f.evidence["share"] for f in found if f.code == "samples_lost"]
    assert shares == ([pytest.approx(lost / ROWS)] if lost else [])
    assert "glitches" in [f.code for f in found]
