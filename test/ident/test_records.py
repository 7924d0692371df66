"""Whether the Monday motor is the Tuesday motor, by numbers drawn from a formula."""

from __future__ import annotations

import numpy as np
import pytest

from smp_motor_ident.diagnosis.records import between_records, same_motor
from smp_motor_ident.result import Estimate, Quantity

STD = 0.1


def days(between: float, rng: np.random.Generator, n: int = 8) -> list[Estimate]:
    values = 25 + between * rng.standard_normal(n) + STD * rng.standard_normal(n)
    return [Estimate("w", "first_order", {}, {"dc_gain": Quantity(float(v), STD)}) for v in values]


def test_records_of_one_motor_agree_as_often_as_the_level_says() -> None:
    rng = np.random.default_rng(1)
    differ = sum(same_motor(days(0.0, rng))[0].code == "records_differ" for _ in range(400))
    assert differ <= 12  # 1 % of 400 are 4; more than 12 come by chance once in 3000


def test_the_scatter_between_records_is_found_and_widens_the_mean() -> None:
    rng = np.random.default_rng(2)
    found = [between_records(days(0.5, rng))[0] for _ in range(200)]
    # The mean of 200 estimates of a deviation from 8 values: within 5 % of 0.5, and bias.
    assert np.mean([s.between for s in found]) == pytest.approx(0.5, rel=0.1)
    assert np.mean([s.std for s in found]) == pytest.approx(
        (0.25 + STD**2) ** 0.5 / 8**0.5, rel=0.1
    )
    off = [abs(s.mean - 25) / s.std for s in found]
    assert np.mean(np.array(off) > 1.96) < 0.15  # 5 %, and what eight values say of a deviation


def test_another_motor_among_the_records_is_named() -> None:
    motors = [*days(0.0, np.random.default_rng(3)), days(0.0, np.random.default_rng(4))[0]]
    odd = Estimate("w", "first_order", {}, {"dc_gain": Quantity(27.0, STD)}, sources=("tuesday",))
    found = same_motor([*motors, odd])
    assert found[0].code == "records_differ"
    assert "tuesday" in found[0].message
