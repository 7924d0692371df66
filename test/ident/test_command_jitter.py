"""Commands that take effect at instants that scatter are noticed, and the intervals cover them."""

from __future__ import annotations

import independent
import motors
import numpy as np
import pytest

from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Record
from smp_motor_ident.result import Estimate

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


def jitter(found: Estimate) -> float:
    return max(
        (float(f.evidence["delay"]) for f in found.findings if f.code == "command_jitter"),
        default=0.0,
    )


@pytest.mark.parametrize("seed", range(3))
def test_commands_on_the_beat_show_no_scatter(seed: int) -> None:
    # One in a hundred of such records may.
    assert jitter(estimate(recorded(0.0, seed))) == 0.0


def test_the_scatter_of_commands_is_found_and_covered() -> None:
    records = [recorded(1.0, seed) for seed in range(3)]
    estimates = [estimate(record) for record in records]
    # Three variances of times of 0 to 20 steps, each alike.
    expected = np.sqrt(3 * ((FINER + 1) ** 2 - 1) / 12) / (FINER * RATE)
    # Each change weighs by its square, and a uniform time's square scatters by 0.8 of its own
    # square: three deviations of the root of the mean of three records, 12 %.
    weight = np.array([np.diff(record.voltage) ** 2 for record in records])
    changes = np.square(np.square(weight).sum()) / (weight**4).sum()
    assert np.mean([jitter(found) for found in estimates]) == pytest.approx(
        expected, rel=3 * 0.5 * np.sqrt(0.8 / changes)
    )
    for record, found in zip(records, estimates, strict=True):
        # Each change is an impulse of its size times how late it is.
        noise = np.sqrt(np.square(np.diff(record.voltage)).sum() / record.duration)
        late = next(f for f in found.findings if f.code == "command_jitter").evidence
        assert late["as_noise"] == pytest.approx(late["scatter"] * noise, rel=0.02)  # its ends
        true = motors.truth("rear_left", 0.0)
        for name in ("dc_gain", "time_constant", "time_constant_product"):
            quantity = found.combinations[name]
            assert quantity.value is not None and quantity.std is not None
            assert abs(quantity.value - true[name]) < 3.5 * quantity.std, name


def test_a_command_is_never_later_than_the_one_that_follows_it() -> None:
    t = np.arange(4000) / RATE
    asked = 6.0 + 4.0 * np.sin(2 * np.pi * 0.5 * t)
    out = independent.simulate(t, asked, *independent.TABLE_1["rear_left"], 0.0, 0 * t, 20)
    # As where friction hangs on the acceleration: noise that grows with the command's rate.
    noise = np.abs(np.cos(2 * np.pi * 0.5 * t)) * np.random.default_rng(3).standard_normal(t.size)
    found = estimate(Record("rear_left", t, asked, velocity=out[:, 1] + 2.0 * noise))
    assert jitter(found) == 0.0  # up to 67 ms late was said of rows 5 ms apart


def test_a_delay_that_is_declared_stays_so_under_scatter() -> None:
    found = estimate(recorded(1.0, 0), fixed={"delay": 0.5 / RATE})
    assert found.combinations["delay"].value == 0.5 / RATE
    lag = found.combinations["time_constant"]
    assert lag.value is not None and lag.std is not None
    assert abs(lag.value - motors.truth("rear_left", 0.0)["time_constant"]) < 3.5 * lag.std
