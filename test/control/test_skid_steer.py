# SPDX-License-Identifier: Apache-2.0
"""Kinematics, odometry, limits and the URDF beyond the conformance cases."""

import math
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smp_motor_control import LEFT, RIGHT, get_joint_name
from smp_motor_control.body.command import HeadingHold
from smp_motor_control.body.description import robot_description
from smp_motor_control.body.kinematics import SkidSteer
from smp_motor_control.body.odometry import Odometry
from smp_motor_control.body.speed_limiter import SpeedLimiter
from smp_motor_control.errors import ParameterError

ROBOT = SkidSteer(
    wheel_separation=0.4, wheel_radius=0.1, wheel_separation_multiplier=1.5, max_wheel_speed=3.0
)
ROUNDING = 1e-9


@given(v=st.floats(-3.0, 3.0), w=st.floats(-6.0, 6.0))
def test_wheel_speed_limit_preserves_path_curvature(v, w):
    left, right = ROBOT.limit_wheel_speeds(v, w)
    assert max(abs(left), abs(right)) <= 3.0 * (1.0 + ROUNDING)
    linear, angular = ROBOT.body_velocity(left, right)
    # The same curvature, w/v, written without division.
    assert linear * w == pytest.approx(angular * v, abs=ROUNDING)
    assert linear * v >= 0.0


def test_command_within_wheel_speed_limit_is_unchanged():
    assert ROBOT.limit_wheel_speeds(0.1, 0.2) == ROBOT.wheel_speeds(0.1, 0.2)


def test_radius_multipliers_act_on_their_side():
    robot = SkidSteer(wheel_separation=0.4, wheel_radius=0.1, left_wheel_radius_multiplier=0.5,
                      right_wheel_radius_multiplier=2.0)  # fmt: skip
    assert robot.wheel_speeds(1.0, 0.0) == pytest.approx((20.0, 5.0))


def test_sides_have_the_documented_wheel_names():
    assert LEFT == ("front_left", "rear_left")
    assert RIGHT == ("front_right", "rear_right")


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_limiter_refuses_non_finite_input(bad):
    with pytest.raises(ParameterError, match="finite"):
        SpeedLimiter(max_velocity=1.0).limit(bad, 0.0, 0.0, 0.1)
    with pytest.raises(ParameterError, match="finite"):
        SpeedLimiter(max_velocity=1.0).limit(0.0, 0.0, 0.0, bad)


@pytest.mark.parametrize(
    "limits",
    [
        {"min_velocity": 0.1, "max_velocity": 1.0},
        {"min_velocity": -1.0, "max_velocity": -0.1},
        {"max_acceleration": 1.0, "max_deceleration": 0.5},
        {"max_acceleration": 1.0, "max_deceleration_reverse": -0.5},
        {"max_acceleration": -1.0},
        {"max_acceleration": 1.0, "max_acceleration_reverse": 1.0},
        {"min_jerk": 0.1, "max_jerk": 1.0},
    ],
)
def test_limits_that_exclude_zero_are_refused(limits):
    with pytest.raises(ParameterError, match="enclose zero"):
        SpeedLimiter(**limits)


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-1.0, 0.0)])
def test_velocity_is_clamped_to_one_sided_limit_including_zero(low, high):
    limiter = SpeedLimiter(min_velocity=low, max_velocity=high)
    for speed in (-0.5, 0.5):
        limited = limiter.limit(speed, speed, speed, 0.1).value
        assert limited == min(max(speed, low), high)


def make_odometry(**more: float) -> Odometry:
    return Odometry(wheel_separation=0.5, left_radius=0.1, right_radius=0.1, **more)


def test_covariance_matches_monte_carlo_of_noisy_drives():
    travel_noise, turn_noise, steps, drives = 4e-4, 1e-2, 100, 1000
    rng = np.random.default_rng(5)
    # Every step: left 9 mm, right 11 mm, each with a variance of travel_noise per metre, and
    # the turn with one of turn_noise per radian.
    left, right = 0.009, 0.011
    ends = []
    for _ in range(drives):
        ls = left + math.sqrt(travel_noise * left) * rng.standard_normal(steps)
        rs = right + math.sqrt(travel_noise * right) * rng.standard_normal(steps)
        turn_std = math.sqrt(turn_noise * (right - left) / 0.5)
        turns = (rs - ls) / 0.5 + turn_std * rng.standard_normal(steps)
        headings = np.cumsum(turns)
        middle = headings - turns / 2.0
        travel = (ls + rs) / 2.0
        ends.append(
            (np.sum(travel * np.cos(middle)), np.sum(travel * np.sin(middle)), headings[-1])
        )
    sampled = np.cov(np.array(ends).T)
    odometry = make_odometry(travel_noise=travel_noise, turn_noise=turn_noise)
    for _ in range(steps):
        odometry.update_from_velocity(left / 0.1, right / 0.1, 1.0)
    predicted = odometry.covariance
    # The sampled deviation of 1000 drives is known to 1/sqrt(2000) = 2.2 %; correlations to
    # 0.03. Allow four of those, and 5 % for linearisation.
    std = np.sqrt(np.diag(sampled))
    assert np.sqrt(np.diag(predicted)) == pytest.approx(std, rel=0.14)
    assert predicted / np.outer(std, std) == pytest.approx(sampled / np.outer(std, std), abs=0.2)


def test_heading_hold_cancels_yaw_drift():
    hold, yaw, dt = HeadingHold(p=2.0, i=1.0), 0.0, 0.02
    for _ in range(1000):
        command = hold.step(0.0, yaw, dt)
        yaw += (command + 0.1) * dt  # the ground turns it by 0.1 rad/s
    assert yaw == pytest.approx(0.0, abs=1e-3)  # the slow pole, 1 rad/s, has had 20 s
    assert command == pytest.approx(-0.1, abs=1e-3)


def test_jerk_limit_does_not_disturb_constant_speed():
    limiter = SpeedLimiter(max_jerk=1.0)
    assert limiter.limit_jerk(1.0, v0=1.0, v1=0.5, dt=0.1).value == 1.0
    assert limiter.limit_jerk(1.1, v0=1.0, v1=0.9, dt=0.1).value == pytest.approx(1.1)
    assert limiter.limit_jerk(1.2, v0=1.0, v1=0.9, dt=0.1).value == pytest.approx(1.11)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_saturated_heading_integral_unwinds_when_error_changes_sign(sign):
    hold = HeadingHold(p=0.0, i=2.0, max_correction=0.5, max_error=3.0)
    hold.step(0.0, yaw=0.0, dt=0.05)
    for _ in range(100):
        saturated = hold.step(0.0, yaw=-0.4 * sign, dt=0.05)
    assert saturated == 0.5 * sign
    after = [hold.step(0.0, yaw=0.4 * sign, dt=0.05) for _ in range(40)]
    # It exceeds its limit by at most one step, 0.04, which takes two steps to unwind.
    assert after[2] * sign < 0.5
    assert after[-1] == -0.5 * sign, "and winds up the other way"


def test_heading_hold_follows_commanded_turn_across_angle_wrap():
    hold, yaw, dt = HeadingHold(p=2.0, i=0.5), 3.0, 0.02
    for _ in range(500):
        yaw = math.remainder(yaw + 0.9 * hold.step(0.5, yaw, dt) * dt, 2.0 * math.pi)
    # 10 s at 0.5 rad/s although the body turns 10 % less than its wheels.
    assert math.remainder(yaw - 3.0 - 5.0, 2.0 * math.pi) == pytest.approx(0.0, abs=0.02)


def test_heading_hold_resets_on_error_above_maximum():
    hold = HeadingHold(max_error=0.7)
    hold.step(0.0, 0.0, 0.02)
    assert hold.step(0.0, 0.1, 0.02) < 0.0, "which begins an integral"
    assert hold.step(0.0, 2.0, 0.02) == 0.0
    assert hold.step(0.0, 2.0, 0.02) == 0.0


def test_heading_correction_is_limited_and_skipped_for_nan_yaw():
    hold = HeadingHold(p=10.0, i=10.0, max_correction=0.3)
    hold.step(0.0, 0.0, 0.02)
    for _ in range(100):
        assert abs(hold.step(0.0, 0.6, 0.02)) <= 0.3
    assert hold.step(0.2, math.nan, 0.02) == 0.2


@pytest.mark.parametrize(
    ("left", "right"), [(LEFT, RIGHT), (("left",), ("right",)), (("a", "b", "c"), ("d", "e", "f"))]
)
def test_urdf_has_one_joint_per_wheel_on_its_side(left, right):
    robot = ElementTree.fromstring(robot_description(left, right, separation=0.3, radius=0.05))
    joints = {joint.attrib["name"]: joint for joint in robot.iter("joint")}
    assert list(joints) == [get_joint_name(wheel) for wheel in (*left, *right)]
    links = [link.attrib["name"] for link in robot.iter("link")]
    assert len(set(links)) == len(links) == 1 + len(joints)
    for wheel in (*left, *right):
        joint = joints[get_joint_name(wheel)]
        x, y, z = map(float, joint.find("origin").attrib["xyz"].split())
        assert y == pytest.approx(0.15 if wheel in left else -0.15)
        assert z == 0.0
        # A positive turn about y rolls forward, as a positive set-point does (REP-103).
        assert joint.find("axis").attrib["xyz"] == "0 1 0"
        assert joint.find("parent").attrib["link"] == "base_link"
        assert joint.find("child").attrib["link"] in links
    ahead = [float(joints[get_joint_name(w)].find("origin").attrib["xyz"].split()[0]) for w in left]
    assert ahead == sorted(ahead, reverse=True)
    assert sum(ahead) == pytest.approx(0.0)
