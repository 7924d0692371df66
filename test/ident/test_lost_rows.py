# SPDX-License-Identifier: Apache-2.0
"""Commands are interpolated over rows that a log lost."""

from dataclasses import replace

import numpy as np
import pytest

from smp_motor_ident.estimate import estimate
from smp_motor_ident.finding import Finding
from smp_motor_ident.quality.stamps import interpolate_lost_voltage
from smp_motor_ident.record import Record

GAIN, LAG, FRICTION, RATE = 60.0, 0.014, 1.0, 500.0


def simulate_ramps(lost: float, seed: int = 0) -> Record:
    """Return a first-order motor under a triangle wave of 7 V, with a share of rows lost."""
    rng = np.random.default_rng(seed)
    n, fine = 1700, 100
    t = np.arange(n) / RATE
    volts = 7.0 * 2 / np.pi * np.arcsin(np.sin(2 * np.pi * 1.2 * t))
    keep, w, speed = np.exp(-1 / RATE / fine / LAG), 0.0, np.zeros(n)
    for k in range(1, n):
        for _ in range(fine):
            target = GAIN * (volts[k] - FRICTION * np.sign(w or volts[k]))
            free = abs(volts[k]) > FRICTION or w != 0.0
            new = keep * w + (1 - keep) * target if free else 0.0
            w = 0.0 if new * w < 0.0 else new
        speed[k] = w
    speed += 1.0 * rng.standard_normal(n)
    kept = rng.random(n) >= lost
    return Record("motor", t[kept], volts[kept], velocity=speed[kept])


@pytest.mark.parametrize("seed", range(3))
def test_varying_command_is_interpolated_over_lost_rows(seed):
    found = estimate(simulate_ramps(0.1, seed))
    lag = found.combinations["time_constant"]
    # 5 standard deviations count as a silent error; a command held over the gap would come
    # a tenth of a sample early on average, and as straight lines half a sample: 1 ms.
    assert abs(lag.value - LAG) < 5 * lag.std
    assert abs(lag.value - LAG) < 0.5e-3
    assert any(f.code == "samples_missing" for f in found.findings)


def test_interpolated_voltage_is_the_mean_over_the_gap():
    t = np.delete(np.arange(60.0), [20, 30, 31])
    record = interpolate_lost_voltage(Record("motor", t, t.copy(), velocity=t))
    own = dict(zip(t, record.voltage, strict=True))
    assert own[21.0] == pytest.approx((20 + 21) / 2)
    assert own[32.0] == pytest.approx((30 + 31 + 32) / 3)
    assert own[22.0] == 22.0 and own[33.0] == 33.0


@pytest.mark.parametrize("begin", [40, 41, 60])
def test_segment_at_another_rate_has_no_lost_rows(begin):
    """Rows of 1 s, a row by itself, and rows of 2 s."""
    t = np.r_[np.arange(40.0), 50.0, 100.0 + 2 * np.arange(30)]
    record = Record("motor", t, t.copy(), velocity=t, starts=tuple(sorted({0, 40, 41, begin})))
    assert interpolate_lost_voltage(record) is record


def test_complete_or_already_interpolated_records_are_unchanged():
    whole = simulate_ramps(0.0)
    assert interpolate_lost_voltage(whole) is whole
    noted = replace(
        simulate_ramps(0.1), findings=(Finding("samples_missing", "note", "by the reader"),)
    )
    assert interpolate_lost_voltage(noted) is noted
    jittered = replace(whole, time=whole.time + 0.3 / RATE * np.sin(np.arange(len(whole))))
    assert interpolate_lost_voltage(jittered) is jittered
    long = replace(whole, time=whole.time + 4.0 / RATE * (np.arange(len(whole)) > 900))
    assert interpolate_lost_voltage(long) is long
