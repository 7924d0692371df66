# SPDX-License-Identifier: Apache-2.0
"""Odometry compared step by step with independent arc and covariance equations."""

import math
import random

import numpy as np
import pytest

from smp_motor_control.body.odometry import Odometry

B, LEFT, RIGHT = 0.5, 0.1, 0.125  # m
TRAVEL, TURN = 3e-4, 2e-2
ROUNDING = 1e-9


def make(**more: float) -> Odometry:
    return Odometry(B, LEFT, RIGHT, travel_noise=TRAVEL, turn_noise=TURN, **more)


def arc(pose: np.ndarray, left: float, right: float) -> np.ndarray:
    """Return the pose after an arc, whose chord follows from the sine of half the turn."""
    turn, travel = (right - left) / B, (left + right) / 2.0
    chord = travel * (math.sin(turn / 2.0) / (turn / 2.0) if turn else 1.0)
    x, y, heading = pose
    middle = heading + turn / 2.0
    return np.array([x + chord * math.cos(middle), y + chord * math.sin(middle), heading + turn])


def spread(p: np.ndarray, heading: float, left: float, right: float) -> np.ndarray:
    """Return ``F P F' + G Q G'``, where Q holds both sides' travel noise and the turn noise."""
    turn, travel = (right - left) / B, (left + right) / 2.0
    cos, sin = math.cos(heading + turn / 2.0), math.sin(heading + turn / 2.0)
    f = np.array([[1, 0, -travel * sin], [0, 1, travel * cos], [0, 0, 1]])
    to_body = np.array([[0.5, 0.5], [-1 / B, 1 / B]])  # sides to (travel, turn)
    q = to_body @ np.diag([TRAVEL * abs(left), TRAVEL * abs(right)]) @ to_body.T
    q[1, 1] += TURN * abs(turn)
    g = np.array([[cos, -travel * sin / 2], [sin, travel * cos / 2], [0, 1]])
    return f @ p @ f.T + g @ q @ g.T


def state(odometry: Odometry) -> np.ndarray:
    return np.array([odometry.x, odometry.y, odometry.heading])


@pytest.mark.parametrize("way", ["velocity", "position", "travel", "open loop"])
def test_pose_and_covariance_match_arcs_in_both_directions(way):
    draw, odometry = random.Random(way), make()
    pose, p = np.zeros(3), np.zeros((3, 3))
    angles = [4.0, -7.0]
    odometry.update_from_position(*angles, 0.1)
    for _ in range(200):
        dt, turned = draw.uniform(0.005, 0.1), [draw.uniform(-2.0, 2.0) for _ in range(2)]
        if draw.random() < 0.2:
            turned[1] = turned[0] * LEFT / RIGHT  # straight ahead
        left, right = turned[0] * LEFT, turned[1] * RIGHT
        if way == "velocity":
            took = odometry.update_from_velocity(turned[0] / dt, turned[1] / dt, dt)
        elif way == "position":
            angles = [a + t for a, t in zip(angles, turned)]
            took = odometry.update_from_position(*angles, dt)
        elif way == "travel":
            took = odometry.update_from_travel(*turned, 0.0, 0.0)
        else:
            took = odometry.update_open_loop((left + right) / 2 / dt, (right - left) / B / dt, dt)
        assert took is True
        p = spread(p, pose[2], left, right)
        pose = arc(pose, left, right)
        assert state(odometry) == pytest.approx(pose, rel=ROUNDING, abs=ROUNDING)
        assert odometry.covariance == pytest.approx(p, rel=ROUNDING, abs=1e-12)


@pytest.mark.parametrize("turn", [0.0, 1e-9, 0.9e-6, 1.1e-6, 1e-5, -1e-5, 3.0])
def test_arc_is_accurate_for_small_turns(turn):
    odometry = make()
    left, right = 1.0 - turn * B / 2, 1.0 + turn * B / 2
    odometry.set_odometry(1.0, 2.0, 0.7)
    odometry.update_from_travel(left / LEFT, right / RIGHT, 0.0, 0.0)
    # Two sines of almost the same angle differ by their rounding over the turn: 1e-16 / 1e-6.
    wanted = arc(np.array([1.0, 2.0, 0.7]), left, right)
    assert state(odometry) == pytest.approx(wanted, abs=1e-9)


def test_velocity_is_the_window_mean_with_variance_of_travel():
    odometry, speeds = make(window=4), []
    draw = random.Random(2)
    for _ in range(10):
        left, right = draw.uniform(-9.0, 9.0), draw.uniform(-9.0, 9.0)
        speeds.append((left * LEFT, right * RIGHT))
        odometry.update_from_velocity(left, right, 0.02)
        left, right = np.mean(speeds[-4:], axis=0)
        assert odometry.linear == pytest.approx((left + right) / 2.0)
        assert odometry.angular == pytest.approx((right - left) / B)
        # A side's mean speed over a span: its travel's variance over the span squared.
        span = 0.08
        of_sides = TRAVEL * (abs(left) + abs(right)) / span
        linear, angular = odometry.twist_variances(span)
        assert linear == pytest.approx(of_sides / 4.0)
        assert angular == pytest.approx(of_sides / B**2 + TURN * abs(odometry.angular) / span)


def test_given_speeds_and_commands_are_reported_unchanged():
    odometry = make()
    odometry.update_from_travel(1.0, 1.0, 3.0, -2.0)
    assert odometry.linear == pytest.approx((3.0 * LEFT - 2.0 * RIGHT) / 2.0)
    assert odometry.angular == pytest.approx((-2.0 * RIGHT - 3.0 * LEFT) / B)
    odometry.update_open_loop(0.25, -0.5, 0.1)
    assert (odometry.linear, odometry.angular) == (0.25, -0.5)


def test_set_pose_has_zero_covariance_and_reset_clears_all():
    odometry = make()
    odometry.update_from_position(0.0, 0.0, 0.1)
    odometry.update_from_position(1.0, 2.0, 0.1)
    odometry.set_odometry(3.0, -2.0, 7.0)
    assert state(odometry).tolist() == [3.0, -2.0, 7.0] and not odometry.covariance.any()
    odometry.update_from_position(2.0, 3.0, 0.1)
    odometry.reset()
    assert not state(odometry).any() and not odometry.covariance.any()
    assert (odometry.linear, odometry.angular) == (0.0, 0.0)
    assert not odometry.update_from_position(50.0, 50.0, 0.1), "the first position is no motion"
    assert not state(odometry).any()
    odometry.update_from_velocity(10.0, 8.0, 0.1)
    assert odometry.linear == pytest.approx(1.0), "no speed of before the reset is in the mean"


BAD = [math.nan, math.inf, -math.inf]


@pytest.mark.parametrize("bad", BAD)
def test_non_finite_values_are_refused_and_leave_state_unchanged(bad):
    odometry = make()
    odometry.update_from_position(0.0, 0.0, 0.1)
    odometry.update_from_velocity(1.0, 2.0, 0.1)
    before, known = state(odometry).tolist(), (odometry.linear, odometry.angular)
    velocity, position = odometry.update_from_velocity, odometry.update_from_position
    command, travel = odometry.update_open_loop, odometry.update_from_travel
    for update in (velocity, position, command):
        for given in ((bad, 0.0, 0.1), (0.0, bad, 0.1), (0.0, 0.0, bad), (0.0, 0.0, 0.9e-6)):
            assert update(*given) is False
    assert velocity(1e308, 1e308, 1e9) is False and velocity(-1e308, 1e308, 1e9) is False
    for j in range(4):
        assert travel(*(bad if k == j else 0.0 for k in range(4))) is False
    assert state(odometry).tolist() == before
    assert (odometry.linear, odometry.angular) == known
    assert odometry.update_from_velocity(1.0, 1.0, 1e-6) is True, "a microsecond is the least"
    assert odometry.update_open_loop(1.0, 1.0, 1e-6) is True
    assert odometry.update_from_position(1e-9, 1e-9, 1e-6) is True


@pytest.mark.parametrize("side", [0, 1])
def test_position_steps_above_maximum_wheel_speed_are_rejected(side):
    odometry = make(max_wheel_speed=8.0)
    at = lambda angle: tuple(angle if k == side else 0.0 for k in range(2))  # noqa: E731
    odometry.update_from_position(*at(0.0), 0.125)
    assert odometry.update_from_position(*at(1.0), 0.125) is True, "at its limit"
    assert odometry.update_from_position(*at(2.0 + 2.0**-20), 0.125) is False
    assert odometry.update_from_position(*at(1.0), 0.125) is False
    assert odometry.update_from_position(*at(1.5), 0.125) is True
    radius = (LEFT, RIGHT)[side]
    assert odometry.heading == pytest.approx((1.0 + 0.5) * radius / B * (1 if side else -1))


def test_default_window_is_ten_steps_with_default_noise():
    plain = Odometry(B, LEFT, RIGHT)
    for k in range(12):  # defaults: a window of 10 steps, noise 1e-4 and 1e-2
        plain.update_from_velocity(10.0 * k, 8.0 * k, 0.1)
    assert plain.linear == pytest.approx(np.mean(range(2, 12)))
    plain.update_from_travel(0.0, 0.0, 10.0, 0.0)
    of_sides = 1e-4 * 1.0
    assert plain.twist_variances(1.0) == pytest.approx((of_sides / 4, of_sides / B**2 + 1e-2 * 2.0))


def test_new_geometry_applies_from_the_next_step():
    odometry = make()
    odometry.update_from_travel(1.0, 0.8, 0.0, 0.0)
    odometry.configure(1.0, 0.2, 0.3, 0.0, 0.0)
    before = odometry.covariance
    odometry.update_from_travel(1.0, 2.0 / 3.0, 0.0, 0.0)
    assert odometry.x == pytest.approx(0.1 + 0.2)
    # With zero noise the covariance is only propagated.
    carried = np.array([[1, 0, 0], [0, 1, 0.2], [0, 0, 1]])
    assert odometry.covariance == pytest.approx(carried @ before @ carried.T, abs=1e-15)
