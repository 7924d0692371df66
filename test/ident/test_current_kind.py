"""A current that is not the armature's is shown by the winding's equation, and left out."""

from __future__ import annotations

import importlib
from dataclasses import replace

import motors
import numpy as np
import pytest

from smp_motor_ident.diagnosis.current_kind import ARMATURE, SUPPLY, UNSIGNED, current_kind
from smp_motor_ident.errors import CurrentError, InsufficientExcitationError
from smp_motor_ident.estimate import estimate

estimate_module = importlib.import_module("smp_motor_ident.estimate")
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


@pytest.mark.parametrize("whose", ["sensor", "driver"])
def test_an_offset_of_current_or_driver_is_no_reason_to_refuse(whose):
    """The winding's equation has one constant for both, R times the one is the other."""
    time = np.arange(1000) / 200.0
    asked = 4.0 * np.sin(2.0 * time) + 4.0 * np.sin(5.0 * time)  # slowly: little current
    made = motors.record("rear_left", voltage=asked + (whose == "driver"), seconds=5.0)
    amps = made.current + (0.3 if whose == "sensor" else 0.0)
    result = estimate(replace(made, voltage=asked, velocity=None, current=amps))
    (left,) = [f for f in result.findings if f.code == "current_left_out"]
    assert left.severity == "warning" and "sensor or of the driver" in left.message
    true = motors.truth("rear_left", 0.3)
    assert not result.unreliable and result.parameters["resistance"].value is None
    for name in ("dc_gain", "time_constant"):
        q = result.combinations[name]
        assert abs(q.value - true[name]) < 4 * q.std + 0.005 * true[name]  # four deviations


def test_an_offset_of_a_current_that_is_asked_for_is_refused_with_both_causes():
    with pytest.raises(CurrentError, match=r"offset of 1.* its sensor's, or the driver"):
        estimate(replace(GOOD, current=GOOD.current + 1.0), "electromechanical")


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_size_of_a_current_is_left_out_where_the_motor_is_driven_back_only(sign):
    step = np.r_[np.zeros(100), np.full(700, -8.0)]
    back = motors.record("rear_left", voltage=step, seconds=4.0)
    kind = current_kind([replace(back, current=sign * back.current)])
    assert kind == (ARMATURE if sign > 0 else UNSIGNED)


@pytest.mark.parametrize("seed", range(3))
def test_a_small_current_of_the_supply_is_left_out_where_the_motor_is_driven_back_only(seed):
    """At a low duty the supply's is a fraction of the armature's, next to nothing in the noise."""
    step = np.r_[np.zeros(20), np.full(160, -6.0)]
    back = motors.record("rear_left", voltage=step, seconds=0.9)
    noise = 0.004 * 12.0 / 3.28 * np.random.default_rng(seed).standard_normal(len(back))
    record = replace(back, current=back.current * back.voltage / 12.0 + noise)
    found = estimate(record)
    assert "current_left_out" in {f.code for f in found.findings}
    true = motors.truth("rear_left", 0.3)["time_constant"]
    lag = found.combinations["time_constant"]
    assert abs(lag.value - true) < 4 * lag.std + 0.005 * true  # four deviations


def test_a_coarse_encoder_does_not_hide_that_a_current_has_no_sign():
    coarse = replace(GOOD, velocity=None, count=GOOD.count // 20 * 20, current=np.abs(GOOD.current))
    assert current_kind([coarse]) == UNSIGNED


def test_data_that_tell_nothing_with_their_current_are_not_believed_without_it(monkeypatch):
    inner = estimate_module._estimated

    def refused(group, request, found):
        if request.use_current:
            raise InsufficientExcitationError("the data do not tell time_constant")
        return inner(group, request, found)

    monkeypatch.setattr(estimate_module, "_estimated", refused)
    result = estimate(GOOD)
    assert "current_left_out" in [f.code for f in result.findings if f.severity == "unreliable"]
