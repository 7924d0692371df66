# SPDX-License-Identifier: Apache-2.0
"""A regulated current stays at its command; a clipped one stays at the sensor's limit."""

import motors
import numpy as np
import pytest

from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Record

RATE, RESISTANCE, CONSTANT = 200.0, 2.0, 0.03
INERTIA, VISCOUS, COULOMB = 4e-5, 2e-5, 2e-3


def simulate_regulated_current() -> Record:
    """Return a record of a motor whose driver regulates the current."""
    fine, steps = 20, 2000
    levels = np.random.default_rng(3).uniform(-1.0, 1.0, 40)
    asked = np.repeat(np.clip(levels, -0.5, 0.5), 50)
    speed, angle, rows = 0.0, 0.0, []
    for amps in asked:
        volts = 0.0
        for _ in range(fine):
            torque = CONSTANT * amps - VISCOUS * speed
            friction = COULOMB * np.sign(speed) if speed else np.clip(torque, -COULOMB, COULOMB)
            after = speed + (torque - friction) / INERTIA / RATE / fine
            after = 0.0 if after * speed < 0 else after
            volts += (RESISTANCE * amps + CONSTANT * 0.5 * (speed + after)) / fine
            angle += 0.5 * (speed + after) / RATE / fine
            speed = after
        rows.append((volts, angle))
    volts, angles = np.array(rows).T
    time = np.arange(steps) / RATE
    count = np.floor(angles / motors.QUANTUM).astype(np.int64)
    return Record("motor", time, volts, current=asked, count=count,
                  hardware=motors.record(seconds=1.0).hardware)  # fmt: skip


def test_regulated_current_is_not_refused_as_clipped():
    record = simulate_regulated_current()
    assert (record.current == record.current.max()).mean() > 0.1
    found = estimate(record)
    assert "current_regulated" in {f.code for f in found.findings}
    gain = CONSTANT / (RESISTANCE * VISCOUS + CONSTANT**2)
    for name, true in (("resistance", RESISTANCE), ("dc_gain", gain)):
        assert found.value(name) == pytest.approx(true, rel=0.02)  # 2 % is negligible for a loop
