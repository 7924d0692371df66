# SPDX-License-Identifier: Apache-2.0
"""Friction compensation in feed-forward, bounded by the interval of the estimate."""

import math

import pytest

from smp_motor_ident.errors import DesignError
from smp_motor_ident.result import Estimate, Quantity
from smp_motor_ident.tune.motors import bound_friction

SUPPLY = 12.0
Z95 = 1.959963985  # of the normal distribution


def estimate(quantity: Quantity | None, **parameters: Quantity) -> Estimate:
    combinations = {} if quantity is None else {"static_voltage": quantity}
    return Estimate("front_left", "first_order", parameters, combinations)


def test_a_standard_deviation_alone_gives_a_normal_interval():
    found = bound_friction(estimate(Quantity(1.0, 0.1)), SUPPLY)
    assert (found.low, found.high) == pytest.approx((1.0 - Z95 * 0.1, 1.0 + Z95 * 0.1), abs=1e-4)
    assert found.known == found.planned == 1.0 and found.finding is None


@pytest.mark.parametrize(("half", "known"), [(0.239, True), (0.241, False)])
def test_friction_is_known_if_its_interval_is_within_2_percent_of_supply(half, known):
    found = bound_friction(estimate(Quantity(1.0, 0.1, (1.0 - half, 1.0 + half))), SUPPLY)
    assert found.known == (1.0 if known else 1.0 - half)
    assert found.planned == (1.0 if known else 1.0 + half)
    assert (found.finding is None) is known
    if found.finding is not None:
        assert found.finding.code == "friction_range"
        assert found.finding.evidence == {"low": 1.0 - half, "high": 1.0 + half}


def test_friction_interval_is_clipped_to_zero_and_supply():
    found = bound_friction(estimate(Quantity(0.1, 0.5, (-0.9, 1.1))), SUPPLY)
    assert (found.low, found.high) == (0.0, 1.1)
    found = bound_friction(estimate(Quantity(10.0, 2.0, (8.0, 14.0))), SUPPLY)
    assert (found.low, found.high) == (8.0, SUPPLY)
    fixed = bound_friction(estimate(Quantity(13.0, None, None, status="fixed")), SUPPLY)
    assert (fixed.low, fixed.high, fixed.known) == (13.0, 13.0, 13.0), "the user's word"


@pytest.mark.parametrize(("width", "refused"), [(5.99, False), (6.01, True)])
def test_friction_interval_wider_than_half_the_supply_is_refused(width, refused):
    given = estimate(Quantity(None, None, (0.0, width), status="unidentifiable"))
    if refused:
        with pytest.raises(DesignError, match=r"anything from 0 to 6\.01 V of the 12 V supply"):
            bound_friction(given, SUPPLY)
    else:
        assert bound_friction(given, SUPPLY).high == width


def test_unidentified_friction_is_left_to_integral_action():
    found = bound_friction(estimate(None), SUPPLY)
    assert (found.known, found.low, found.high) == (0.0, 0.0, 0.0)
    assert found.finding is not None and found.finding.code == "friction_unknown"
    for nothing in (Quantity(None), Quantity(1.0, math.inf)):
        with pytest.raises(DesignError, match="from 0 to 12 V"):
            bound_friction(estimate(nothing), SUPPLY)


def test_friction_torque_is_converted_to_voltage_by_resistance_and_motor_constant():
    parts = {"resistance": Quantity(12.0, 0.0), "motor_constant": Quantity(0.02, 0.0)}
    given = estimate(None, coulomb_friction=Quantity(1e-3, 1e-5), **parts)
    found = bound_friction(given, SUPPLY)
    assert found.known == pytest.approx(0.6)  # R T / K
    assert found.high - found.low == pytest.approx(2 * Z95 * 0.006, rel=1e-4)
