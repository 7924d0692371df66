# SPDX-License-Identifier: Apache-2.0
"""The PID controller beyond the conformance cases."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smp_motor_control.errors import ParameterError
from smp_motor_control.pid import Pid, PidGains

VOLTS = {"u_clamp_min": -12.0, "u_clamp_max": 12.0}


def settle(pid: Pid, reference: float, measurement: float, steps: int, dt: float = 0.01):
    for _ in range(steps):
        out = pid.step(reference, measurement, dt)
    return out


@pytest.mark.parametrize("strategy", ["back_calculation", "conditional_integration"])
def test_integral_does_not_wind_up_while_output_saturates(strategy):
    pid = Pid(PidGains(p=1.0, i=10.0, antiwindup_strategy=strategy, **VOLTS))
    out = settle(pid, 20.0, 0.0, 1000)
    assert out.saturated
    assert out.output == 12.0
    # Without anti-windup it would be i e t = 2000 V; the clamp allows at most 12 V.
    assert abs(out.i_term) <= 12.0


@pytest.mark.parametrize("p", [0.0, 2.0])
def test_back_calculation_with_zero_time_constant_stays_finite(p):
    pid = Pid(PidGains(p=p, i=3.0, antiwindup_strategy="back_calculation", **VOLTS))
    out = settle(pid, 50.0, 0.0, 500)
    assert math.isfinite(out.i_term)
    assert out.output == 12.0
    # The output leaves the clamp a few steps after the error changes sign: no windup.
    assert settle(pid, -50.0, 0.0, 20).output < 12.0


@pytest.mark.parametrize("dt", [-1e-3, -math.inf, math.nan, math.inf])
def test_invalid_time_step_is_refused_and_leaves_integral_unchanged(dt):
    pid = Pid(PidGains(p=1.0, i=2.0))
    settle(pid, 1.0, 0.0, 5)
    before = pid.i_term
    with pytest.raises(ParameterError, match="dt"):
        pid.step(1.0, 0.0, dt)
    assert pid.i_term == before


def test_time_step_of_zero_repeats_the_last_command():
    pid = Pid(PidGains(p=1.0, i=2.0))
    first = pid.step(1.0, 0.0, 0.1)
    assert pid.step(5.0, 0.0, 0.0) == first


def test_output_is_immutable():
    pid = Pid(PidGains(p=1.0))
    first = pid.step(1.0, 0.0, 0.1)
    pid.step(2.0, 0.0, 0.1)
    assert first.output == 1.0
    with pytest.raises(AttributeError):
        first.output = 3.0


finite = st.floats(-1e6, 1e6)
gain = st.floats(0.0, 1e3)


@given(
    p=gain, i=gain, d=gain,
    strategy=st.sampled_from(["none", "back_calculation", "conditional_integration"]),
    tracking=st.floats(0.0, 10.0),
    inputs=st.lists(st.tuples(finite, finite, st.floats(1e-4, 1.0), finite), max_size=20),
)  # fmt: skip
def test_output_is_clamped_and_the_integral_finite(p, i, d, strategy, tracking, inputs):
    gains = PidGains(p=p, i=i, d=d, antiwindup_strategy=strategy, tracking_time_constant=tracking,
                     feedforward_velocity=1.0, feedforward_static=1.0, **VOLTS)  # fmt: skip
    pid = Pid(gains)
    for reference, measurement, dt, acceleration in inputs:
        out = pid.step(reference, measurement, dt, acceleration)
        assert -12.0 <= out.output <= 12.0
        assert math.isfinite(out.i_term)
        assert out.saturated == (out.output != out.unsaturated)
