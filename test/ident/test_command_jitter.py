# SPDX-License-Identifier: Apache-2.0
"""Commands that take effect at instants that scatter are noticed, and the intervals cover them."""

import independent
import motors
import numpy as np

from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Record

RATE = 200.0
FINER = 20  # steps of the driver's clock to a sample


def recorded(latest: float, seed: int) -> Record:
    """Random steps that reach the motor up to so many samples late, each by a time of its own."""
    rng = np.random.default_rng(seed)
    asked = np.repeat(rng.uniform(-10.0, 10.0, 200), 10)
    fine = np.repeat(asked, FINER)
    changes = np.flatnonzero(np.diff(fine)) + 1
    given = fine.copy()
    for k, late in zip(changes, rng.integers(0, int(latest * FINER) + 1, changes.size)):
        given[k : k + late] = fine[k - 1]
    t = np.arange(given.size) / (RATE * FINER)
    out = independent.simulate(
        t, given, *independent.TABLE_1["rear_left"], 0.0, np.zeros(t.size), 4
    )
    rows = np.arange(FINER - 1, given.size, FINER)  # a row holds what ran up to its instant
    speed = out[rows, 1] + 0.2 * rng.standard_normal(rows.size)
    return Record("rear_left", t[rows] - t[rows[0]], asked, velocity=speed)


def test_the_scatter_of_commands_is_covered():
    for found in (estimate(recorded(1.0, seed)) for seed in range(3)):
        true = motors.truth("rear_left", 0.0)
        for name in ("dc_gain", "time_constant", "time_constant_product"):
            quantity = found.combinations[name]
            assert quantity.value is not None and quantity.total_std is not None
            assert abs(quantity.value - true[name]) < 3.5 * quantity.total_std, name


def test_a_delay_that_is_declared_stays_so_under_scatter():
    found = estimate(recorded(1.0, 0), fixed={"delay": 0.5 / RATE})
    assert found.combinations["delay"].value == 0.5 / RATE
    lag = found.combinations["time_constant"]
    assert lag.value is not None and lag.total_std is not None
    assert abs(lag.value - motors.truth("rear_left", 0.0)["time_constant"]) < 3.5 * lag.total_std
