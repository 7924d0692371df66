"""A driver is believed where it explains more than a motor, chance or a fluctuating load does."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from driven import GAIN, STATIC, STEP, commands, run

from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation.driver_effect import (
    DriverFit,
    explains_no_more,
    leaves_torque_noise,
    suspects_driver,
)
from smp_motor_ident.estimation.driver_search import likeliest
from smp_motor_ident.estimation.fit import Options
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model import driver
from smp_motor_ident.model.driver import Driver
from smp_motor_ident.model.structures import FirstOrder
from smp_motor_ident.record import Record


def sized(kind: int, size: float, std: float) -> DriverFit:
    """Return an effect of a size beside a command of 5 V, switched every 10 ms and both ways."""
    effect = next(e for e in driver.EFFECTS if e.kind == kind)
    switched = np.tile([5.0, -5.0], 10)
    record = Record("motor", 0.01 * np.arange(20), switched, velocity=np.zeros(20))
    return DriverFit(effect, Driver(kind, size), std, [record], [record], None, None)


@pytest.mark.parametrize("kind", [driver.DEAD_ZONE, driver.SLEW, driver.SAG, driver.DROP])
def test_a_size_that_may_be_nothing_is_not_stated(kind):
    assert sized(kind, 0.5, 0.2).shown
    assert not sized(kind, 0.5, 0.3).shown


def test_a_clip_that_may_be_above_the_command_is_not_stated():
    assert sized(driver.CLIP, 4.5, 0.2).shown
    assert not sized(driver.CLIP, 4.5, 0.3).shown


def test_a_rise_that_is_over_between_two_rows_is_not_stated():
    assert sized(driver.SLEW, 10.0 / 0.006, 1.0).shown
    assert not sized(driver.SLEW, 10.0 / 0.004, 1.0).shown


@pytest.mark.parametrize(
    "before, behind, leaves", [(100.0, 10.0, False), (100.0, 90.0, True), (0.0, 1.0, True)]
)
def test_what_leaves_most_of_the_torque_noise_is_no_driver(before, behind, leaves):
    noise = Finding("torque_noise", "warning", "", {"intensity": behind})
    found, fit = SimpleNamespace(findings=(noise,)), SimpleNamespace(noise_ratio=before)
    assert leaves_torque_noise(found, fit) is leaves
    assert not leaves_torque_noise(SimpleNamespace(findings=()), fit)


@pytest.mark.parametrize(
    ("before", "behind", "codes", "no_more"),
    # Two numbers, e^5 samples: both cost 10. Without torque noise a motor is held against its own.
    [(0.1, -90.0, ["torque_noise"], True), (0.1, -91.0, ["torque_noise"], False),
     (0.1, -50.0, [], False), (0.0, -50.0, ["torque_noise"], False)],
)  # fmt: skip
def test_a_driver_under_torque_noise_has_to_be_likelier_than_none(before, behind, codes, no_more):
    chosen = SimpleNamespace(chosen=True, bic=behind)
    found = SimpleNamespace(findings=tuple(Finding(c, "warning", "") for c in codes),
                            candidates=(chosen,))  # fmt: skip
    fit = SimpleNamespace(noise_ratio=before, deviance=-100.0, samples=math.exp(5.0),
                          structure=SimpleNamespace(size=2))  # fmt: skip
    assert explains_no_more(found, fit) is no_more


@pytest.mark.parametrize(
    ("code", "severity", "suspected"),
    [("slew", "unreliable", True), ("slew", "note", False), ("current_lag", "unreliable", False)],
)
def test_a_driver_is_suspected_where_an_estimate_is_unreliable_for_one(code, severity, suspected):
    found = Finding(code, severity, "")
    assert suspects_driver(SimpleNamespace(findings=(found,))) is suspected


@pytest.mark.parametrize("seed", range(3))
def test_a_dead_zone_of_a_hundredth_of_the_voltage_is_frictions(seed):
    """A transistor's drop is as large, and a coarse speed's rounding looks like it."""
    command = commands(seed)
    speed = run(np.sign(command) * np.maximum(np.abs(command) - 0.12, 0.0), seed)
    found = estimate(Record("motor", np.arange(command.size) * STEP, command, velocity=speed))
    assert "dead_zone" not in found.combinations and not found.unreliable
    static, gain = found.combinations["static_voltage"], found.combinations["dc_gain"]
    assert abs(static.value - STATIC - 0.12) < 4 * static.std + 0.02  # a sixth of the zone
    assert abs(gain.value - GAIN) < 4 * gain.std + 1e-3 * GAIN


def test_a_driver_that_explains_hardly_more_than_none_leaves_room_for_none():
    command = commands(2)
    speed = run(np.sign(command) * np.maximum(np.abs(command) - 0.23, 0.0), 2, noise=20.0)
    record = Record("motor", np.arange(command.size) * STEP, command, velocity=speed)
    plain = initial_fit(prepare([record], False), FirstOrder(), Options())
    found = likeliest([record], plain, "held", Options())
    friction = plain.structure.free.index("vc_plus")
    std = math.sqrt(found.widened(found.fit, 0.0)[0].covariance()[friction, friction])
    # What lies between the two is within one deviation.
    assert abs(plain.z.vc_plus - found.fit.z.vc_plus) <= std
