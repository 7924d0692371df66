"""What lost, late, wrong and unequal samples of wheels add up to."""

from __future__ import annotations

import math

import pytest

from smp_motor_control.body.wheel_travel import WheelFeedback, WheelSample

TIMEOUT = 0.5


def make() -> WheelFeedback:
    return WheelFeedback(("a", "b"), ("c", "d"), max_speed=100.0)


def feed(
    feedback: WheelFeedback, t: float, wheels: str, position: float, velocity=0.0, now=None
) -> None:
    for wheel in wheels:
        feedback.receive(wheel, WheelSample(t, position, velocity), t if now is None else now)


def test_wheels_that_report_at_different_instants_count_once() -> None:
    feedback = make()
    feed(feedback, 0.0, "abcd", 0.0)
    feedback.take(0.0, TIMEOUT)
    total = [0.0, 0.0]
    for k in range(1, 101):
        feed(feedback, 0.01 * k, "acd" if k % 2 else "b", 0.01 * k)
        travel = feedback.take(0.01 * k, TIMEOUT)
        total = [total[0] + travel.left, total[1] + travel.right]
    # a and the right side stand at 0.99 after 100 steps, b at 1.00.
    assert total == pytest.approx([0.995, 0.99])


def test_first_reading_is_no_motion() -> None:
    feedback = make()
    feed(feedback, 0.0, "abcd", 500.0)
    assert feedback.take(0.0, TIMEOUT) is None


def test_wheel_that_falls_silent_leaves_the_mean_and_comes_back_without_a_jump() -> None:
    feedback = make()
    for k in range(100):
        feed(feedback, 0.1 * k, "acd", 0.1 * k)
        if not 20 <= k < 60:
            feed(feedback, 0.1 * k, "b", 0.1 * k)
        travel = feedback.take(0.1 * k, TIMEOUT)
        if k > 0 and not 20 <= k <= 26:
            assert travel.left == pytest.approx(0.1 if k != 60 else 0.05)
    assert feedback.silent(9.9, TIMEOUT) == {}


def test_silence_of_a_whole_side_is_told_and_not_guessed() -> None:
    feedback = make()
    feed(feedback, 0.0, "abcd", 0.0)
    feedback.take(0.0, TIMEOUT)
    feed(feedback, 1.0, "ab", 1.0)
    assert feedback.take(1.0, TIMEOUT) is None
    assert feedback.silent(1.0, TIMEOUT) == {"c": 1.0, "d": 1.0}
    assert math.isinf(make().silent(0.0, TIMEOUT)["a"])


@pytest.mark.parametrize(
    ("stamp", "position"),
    [(0.02, 1e9), (0.02, -1e300), (-5.0, 1.0), (0.01, 1.0)],
    ids=["counter reset", "absurd", "time jumped back", "duplicate"],
)
def test_sample_that_cannot_be_is_no_motion(stamp: float, position: float) -> None:
    feedback = make()
    feed(feedback, 0.0, "abcd", 0.0)
    feedback.take(0.0, TIMEOUT)
    feed(feedback, 0.01, "abcd", 0.0)
    feedback.take(0.01, TIMEOUT)
    feed(feedback, stamp, "abcd", position, now=0.02)
    assert feedback.take(0.02, TIMEOUT) is None
    feed(feedback, stamp + 0.02, "abcd", position, now=0.04)
    assert feedback.take(0.04, TIMEOUT) is not None


def test_velocity_stands_in_for_a_position_that_is_nan() -> None:
    feedback = make()
    feed(feedback, 0.0, "abcd", math.nan, 2.0)
    feedback.take(0.0, TIMEOUT)
    feed(feedback, 0.01, "abcd", math.nan, 2.0)
    assert feedback.take(0.01, TIMEOUT) == pytest.approx((0.02, 0.02, 2.0, 2.0))


@pytest.mark.parametrize("stall", [0.1, 0.12, 0.5, 1.0])
def test_speed_over_a_stall_is_the_travel_over_the_time_it_was_travelled_in(stall: float) -> None:
    feedback = make()
    stamps = [0.005 * k for k in range(100)]
    stamps += [0.5 + stall + 0.005 * k for k in range(100)]
    speeds = []
    for k, stamp in enumerate(stamps):
        feed(feedback, stamp, "acd", 3.0 * stamp)
        if k % 4 == 0:
            feed(feedback, stamp, "b", 3.0 * stamp)
            feedback.receive("b", WheelSample(stamp, 3.0 * stamp, 0.0), stamp)
        if k % 4 == 3:  # taken in the middle of a round: b is three samples behind
            travel = feedback.take(stamp, 2.0)
            speeds += [] if travel is None else [travel.left_speed, travel.right_speed]
    assert speeds[2:] == pytest.approx([3.0] * (len(speeds) - 2))


def test_sample_without_a_number_is_no_sign_of_life() -> None:
    feedback = make()
    feed(feedback, 0.0, "abcd", 0.0)
    feed(feedback, 1.0, "abcd", math.nan, math.inf)
    assert set(feedback.silent(1.0, TIMEOUT)) == {"a", "b", "c", "d"}
