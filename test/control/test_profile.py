# SPDX-License-Identifier: Apache-2.0
"""Reference profiles: limits, smoothness and duration."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.optimize import linprog

from smp_motor_control.errors import ParameterError
from smp_motor_control.fields import build_settings
from smp_motor_control.reference.minimum_jerk import (
    PEAK_ACCELERATION,
    PEAK_JERK,
    MinimumJerk,
    minimum_jerk_duration,
)
from smp_motor_control.reference.profile import Drive, Profile, ProfileLimits, Reference
from smp_motor_control.reference.time_optimal import VoltageLimited

REST = Reference(0.0, 0.0, 0.0)


def test_minimum_jerk_has_stated_peak_acceleration_and_jerk():
    transition = MinimumJerk(Reference(1.0, 0.0, 0.0), 4.0, 0.2)
    seen = [transition.at(t) for t in np.linspace(0.0, 0.2, 20001)]
    # The grid misses the peak of a parabola by at most (1/40000)^2.
    assert max(x.acceleration for x in seen) == pytest.approx(PEAK_ACCELERATION * 3.0 / 0.2, 1e-6)
    assert max(x.jerk for x in seen) == pytest.approx(PEAK_JERK * 3.0 / 0.2**2, rel=1e-6)


def test_minimum_jerk_meets_its_six_boundary_conditions():
    start = Reference(1.0, -3.0, 40.0)
    transition = MinimumJerk(start, 4.0, 0.2)
    tiny = 1e-9
    assert transition.at(tiny) == pytest.approx(start, abs=1e-3)
    assert transition.at(0.2 - tiny) == pytest.approx((4.0, 0.0, 0.0), abs=1e-3)
    assert transition.at(0.2) == Reference(4.0, 0.0, 0.0)


def test_wheels_with_different_steps_arrive_at_the_same_instant():
    profiles = [Profile(transition_time=0.15) for _ in range(3)]
    for profile, target in zip(profiles, (0.1, -2.0, 5.0), strict=True):
        profile.set_target(target)
    for _ in range(149):
        for profile in profiles:
            profile.step(0.001)
    assert all(profile.duration for profile in profiles)
    shares = [profile.now.velocity / profile.target for profile in profiles]
    assert shares == pytest.approx([shares[0]] * 3, abs=1e-12)
    for profile in profiles:
        profile.step(0.00101)  # the sum of 149 steps of 1 ms may be short of 149 ms by rounding
    assert [profile.now.velocity for profile in profiles] == [0.1, -2.0, 5.0]


def test_transition_is_stretched_just_enough_for_acceleration_limit():
    limits = ProfileLimits(acceleration=10.0)
    profile = Profile(limits, transition_time=0.15)
    profile.set_target(4.0)
    expected = minimum_jerk_duration(4.0, limits, 0.15)
    assert expected == pytest.approx(15.0 / 8.0 * 4.0 / 10.0)
    elapsed = 0.0
    while profile.duration:
        assert abs(profile.step(0.001).acceleration) <= 10.0 * (1 + 1e-9)
        elapsed += 0.001
    assert elapsed == pytest.approx(expected, abs=0.0011)  # one step


targets = st.lists(st.tuples(st.floats(-6.0, 6.0), st.integers(1, 80)), min_size=1, max_size=8)


@settings(deadline=None)
@pytest.mark.parametrize("transition_time", [0.0, 0.15])
@given(targets=targets)
@example(targets=[(-3.0, 47), (-4.53125, 62), (-5.0, 42), (-1.65625, 52), (0.0, 8), (-5.0, 32)])
def test_reference_keeps_limits_under_any_target_changes(transition_time, targets):
    limits = ProfileLimits(velocity=5.0, acceleration=30.0, jerk=600.0)
    profile = Profile(limits, transition_time)
    dt = 0.002
    for target, steps in targets:
        profile.set_target(target)
        for _ in range(steps):
            before = profile.now
            now = profile.step(dt)
            # The profile checks polynomials on a grid: up to 2 % more between its points.
            assert abs(now.velocity) <= 5.0
            assert abs(now.acceleration) <= 30.0 * 1.02
            assert abs(now.velocity - before.velocity) <= 30.0 * 1.02 * dt + 1e-12
    for _ in range(5000):
        profile.step(dt)
    assert profile.now == Reference(min(max(targets[-1][0], -5.0), 5.0), 0.0, 0.0)


def test_fastest_transition_within_limits_has_analytic_duration():
    profile = Profile(ProfileLimits(acceleration=10.0, jerk=100.0))
    profile.set_target(4.0)
    elapsed = 0.0
    while profile.duration:
        profile.step(0.001)
        elapsed += 0.001
    assert elapsed == pytest.approx(4.0 / 10.0 + 10.0 / 100.0, abs=0.0011)  # D/a + a/j, one step


def test_retargeting_keeps_reference_and_its_derivatives_continuous():
    profile = Profile(transition_time=0.2)
    profile.set_target(4.0)
    for _ in range(80):
        profile.step(0.001)
    before = profile.now
    profile.set_target(-1.0)
    after = profile.step(1e-7)
    assert after == pytest.approx(before, abs=1e-2)  # snap times 0.1 us
    for _ in range(201):
        profile.step(0.001)
    assert profile.now == Reference(-1.0, 0.0, 0.0)


def test_repeated_target_does_not_restart_transition():
    profile = Profile(transition_time=0.1)
    for _ in range(101):
        profile.set_target(2.0)
        profile.step(0.001)
    assert profile.now == Reference(2.0, 0.0, 0.0)


def test_reference_is_a_step_without_limits():
    profile = Profile()
    profile.set_target(3.0)
    assert profile.step(0.001) == Reference(3.0, 0.0, 0.0)


def test_look_ahead_leaves_profile_unchanged():
    profile = Profile(transition_time=0.1)
    profile.set_target(2.0)
    profile.step(0.02)
    ahead = profile.ahead(0.03)
    assert profile.now != ahead
    assert profile.step(0.03) == pytest.approx(ahead, abs=1e-12)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_non_finite_target_is_refused_and_old_target_kept(bad):
    profile = Profile(transition_time=0.1)
    profile.set_target(2.0)
    with pytest.raises(ParameterError, match="target"):
        profile.set_target(bad)
    assert profile.target == 2.0


def test_zero_parameters_mean_no_limits():
    zeros = dict.fromkeys(("max_velocity", "max_acceleration", "max_jerk"), 0.0)
    assert build_settings(ProfileLimits, zeros) == ProfileLimits()


drives = st.builds(
    Drive,
    top_speed=st.floats(1.0, 20.0),
    time_constant=st.floats(0.01, 0.5),
    time_constant_product=st.just(0.0),
)


@settings(max_examples=200, deadline=None)
@given(
    drives,
    st.floats(0.0, 0.6),
    st.floats(-0.95, 0.95),
    st.floats(-0.95, 0.95),
    st.floats(-1.0, 1.0),
    st.sampled_from([0.001, 0.005, 0.01]),
)
def test_voltage_limited_transition_ends_at_rest_within_voltage(drive, bend, begin, end, push, dt):
    if bend > 0.001:
        drive = replace(drive, time_constant_product=bend * drive.time_constant**2)
    top, tau = drive.top_speed, drive.time_constant
    start = Reference(begin * top, push * (1 - abs(begin)) * top / tau, 0.0)
    change = VoltageLimited(start, end * top, drive, dt)
    if change.duration == 0.0:
        return
    # The duration is a whole number of samples, so that a held voltage can realise it.
    assert change.duration / dt == pytest.approx(round(change.duration / dt), abs=1e-6)
    last = change.at(change.duration * (1.0 - 1e-9))
    assert last.velocity == pytest.approx(end * top, abs=1e-5 * top)
    if drive.time_constant_product:
        assert last.acceleration * tau == pytest.approx(0.0, abs=1e-4 * top)
    seen = [change.at(change.duration * k / 50) for k in range(50)]
    if drive.time_constant_product:
        # Only rounding of the jerk, a difference of large numbers, may exceed the limit.
        assert max(abs(drive.needed(x)) for x in seen) <= top * (1 + 1e-6)


def test_voltage_limited_duration_is_analytic_for_first_order_motor():
    drive = Drive(top_speed=10.0, time_constant=0.1)
    change = VoltageLimited(REST, 5.0, drive, 1e-4)
    # w = U (1 - exp(-t / tau)), rounded up to samples.
    assert 0.1 * math.log(2.0) <= change.duration <= 0.1 * math.log(2.0) + 1e-4


def test_voltage_limited_transition_is_time_optimal():
    drive = Drive(top_speed=10.0, time_constant=0.05, time_constant_product=0.0008)
    dt, target = 0.005, 6.0
    samples = round(VoltageLimited(REST, target, drive, dt).duration / dt)
    # States reachable by bounded voltages in n samples form a zonotope. It contains the target if
    # and only if a linear programme is feasible.
    A = np.array([[0.0, 1.0], [-1.0 / 0.0008, -0.05 / 0.0008]])
    step = expm(A * dt)
    push = (np.eye(2) - step) @ np.array([1.0, 0.0])
    for n, possible in ((samples, True), (samples - 1, False)):
        columns = [np.linalg.matrix_power(step, n - 1 - k) @ push for k in range(n)]
        found = linprog(
            np.zeros(n), A_eq=np.array(columns).T, b_eq=[target, 0.0], bounds=[(-10.0, 10.0)] * n
        )
        assert found.success == possible


def test_small_step_takes_transition_time_and_large_step_is_voltage_limited():
    drive = Drive(top_speed=10.0, time_constant=0.05, time_constant_product=0.0008)
    profile = Profile(transition_time=0.05, drive=drive)
    durations = []
    for target in (0.5, 9.0):
        profile.reset()
        profile.set_target(target, 0.005)
        durations.append(profile.duration)
    assert durations[0] == 0.05
    assert durations[1] == pytest.approx(0.1)  # 20 samples


def test_acceleration_limit_holds_in_addition_to_voltage_limit():
    drive = Drive(top_speed=10.0, time_constant=0.05, time_constant_product=0.0008)
    profile = Profile(ProfileLimits(acceleration=40.0), transition_time=0.05, drive=drive)
    profile.set_target(8.0, 0.005)
    seen = [profile.step(0.001) for _ in range(round(profile.duration / 0.001))]
    assert max(x.acceleration for x in seen) <= 1.001 * 40.0
    assert max(drive.needed(x) for x in seen) <= 1.001 * 10.0


def test_acceleration_only_falls_after_limit_is_lowered_in_transition():
    profile = Profile(ProfileLimits(acceleration=30.0, jerk=600.0), transition_time=0.15)
    profile.set_target(3.0)
    for _ in range(30):
        profile.step(0.002)
    profile.configure(ProfileLimits(acceleration=5.0, jerk=600.0), transition_time=0.15)
    profile.set_target(4.0)
    largest = abs(profile.now.acceleration)
    assert largest > 5.0
    while profile.duration:
        # A decrease that starts without jerk does not overshoot; only rounding is allowed.
        assert abs(profile.step(0.002).acceleration) <= largest * (1 + 1e-6)
    assert profile.now == Reference(4.0, 0.0, 0.0)
