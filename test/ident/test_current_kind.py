"""A current that is not the armature's is told by the winding's equation, and left out."""

from __future__ import annotations

from dataclasses import replace

import motors
import numpy as np
import pytest

from smp_motor_ident.diagnosis.current_kind import ARMATURE, SUPPLY, UNSIGNED, current_kind
from smp_motor_ident.estimate import estimate

GOOD = motors.record("rear_left", seconds=3.0)
DUTY = GOOD.voltage / 12.0
CURRENTS = {
    ARMATURE: GOOD.current,
    UNSIGNED: np.abs(GOOD.current),
    SUPPLY: GOOD.current * DUTY,
}


@pytest.mark.parametrize("kind", CURRENTS)
def test_the_winding_tells_what_a_current_is(kind):
    assert current_kind([replace(GOOD, current=CURRENTS[kind])]) == kind


def test_one_direction_does_not_make_a_current_unsigned():
    levels = np.repeat([4.0, 8.0, 6.0, 10.0, 5.0, 9.0], 100)
    forward = motors.record("rear_left", voltage=levels, seconds=1.0)
    assert current_kind([forward]) == ARMATURE


@pytest.mark.parametrize("kind", [UNSIGNED, SUPPLY])
def test_without_its_current_a_record_still_says_what_the_speed_tells(kind):
    result = estimate(replace(GOOD, current=CURRENTS[kind]))
    true = motors.truth("rear_left", 0.3)
    assert not result.unreliable
    assert "current_left_out" in {f.code for f in result.findings}
    assert result.parameters["resistance"].value is None
    for name in ("dc_gain", "time_constant"):
        q = result.combinations[name]
        assert abs(q.value - true[name]) < 4 * q.std + 0.005 * true[name]  # four deviations
