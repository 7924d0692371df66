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
        names = ("dc_gain", "time_constant", "time_constant_product")
        motors.check(found, motors.truth("rear_left", 0.0), names, sigmas=3.5, total=True)


def test_a_delay_that_is_declared_stays_so_under_scatter():
    found = estimate(recorded(1.0, 0), fixed={"delay": 0.5 / RATE})
    assert found.combinations["delay"].value == 0.5 / RATE
    truth = motors.truth("rear_left", 0.0)
    motors.check(found, truth, ["time_constant"], sigmas=3.5, total=True)
