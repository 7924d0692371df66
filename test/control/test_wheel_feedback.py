# SPDX-License-Identifier: Apache-2.0
"""Wheel travel from lost, late, invalid and unequally timed samples."""

import math

import pytest

from smp_motor_control.body.wheel_travel import WheelFeedback, WheelSample

TIMEOUT = 0.5


def make() -> WheelFeedback:
    return WheelFeedback(("a", "b"), ("c", "d"), max_speed=100.0)


def feed(feedback, t, wheels, position, velocity=0.0, now=None):
    for wheel in wheels:
        feedback.receive(wheel, WheelSample(t, position, velocity), t if now is None else now)


def test_travel_is_counted_once_when_wheels_report_at_different_times():
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


def test_first_reading_adds_no_motion():
    feedback = make()
    feed(feedback, 0.0, "abcd", 500.0)
    assert feedback.take(0.0, TIMEOUT) is None


def test_silent_wheel_is_excluded_from_mean_and_rejoins_without_jump():
    feedback, total = make(), 0.0
    for k in range(100):
        feed(feedback, 0.1 * k, "acd", 0.1 * k)
        if not 20 <= k < 60:
            feed(feedback, 0.1 * k, "b", 0.1 * k)
        travel = feedback.take(0.1 * k, TIMEOUT)
        if k > 0 and not 20 <= k <= 26:
            assert travel.left == pytest.approx(0.1)
        total += 0.0 if travel is None else travel.left
    assert feedback.silent(9.9, TIMEOUT) == {} and total == pytest.approx(9.9)


def test_silence_of_a_whole_side_is_reported_without_travel():
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
def test_impossible_sample_adds_no_motion(stamp, position):
    feedback = make()
    feed(feedback, 0.0, "abcd", 0.0)
    feedback.take(0.0, TIMEOUT)
    feed(feedback, 0.01, "abcd", 0.0)
    feedback.take(0.01, TIMEOUT)
    feed(feedback, stamp, "abcd", position, now=0.02)
    assert feedback.take(0.02, TIMEOUT) is None
    feed(feedback, stamp + 0.02, "abcd", position, now=0.04)
    assert feedback.take(0.04, TIMEOUT) is not None


def test_velocity_replaces_nan_position():
    feedback = make()
    feed(feedback, 0.0, "abcd", math.nan, 2.0)
    feedback.take(0.0, TIMEOUT)
    feed(feedback, 0.01, "abcd", math.nan, 2.0)
    assert feedback.take(0.01, TIMEOUT) == pytest.approx((0.02, 0.02, 2.0, 2.0))


@pytest.mark.parametrize("stall", [0.1, 0.12, 0.5, 1.0])
def test_speed_after_stall_is_travel_over_elapsed_stamp_time(stall):
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


def test_non_finite_sample_does_not_reset_the_time_out():
    feedback = make()
    feed(feedback, 0.0, "abcd", 0.0)
    feed(feedback, 1.0, "abcd", math.nan, math.inf)
    assert set(feedback.silent(1.0, TIMEOUT)) == {"a", "b", "c", "d"}


RATE, MAX_SPEED = 200, 11.6
"""Sample rate [Hz] and maximum plausible wheel speed [rad/s]."""


def drive(
    see, seconds=6.0, ways=lambda wheel, t: (1.0 if wheel in "ab" else 2.0) * t, wheels=("ab", "cd")
):
    """Drive ``seconds`` with a fault, then 2 s without; return both sides' travel [rad]."""
    feedback = WheelFeedback(*wheels, max_speed=MAX_SPEED)
    left = right = 0.0
    for k in range(round((seconds + 2.0) * RATE) + 1):
        t = k / RATE
        for wheel in "".join(wheels):
            way = ways(wheel, t)
            velocity = (ways(wheel, t + 1e-6) - way) * 1e6
            sample = WheelSample(1e4 + t, way, velocity)
            seen = see(wheel, t, sample) if t < seconds else sample
            if seen is not None:
                feedback.receive(wheel, seen, t)
        if k % 4 == 0 and (travel := feedback.take(t, TIMEOUT)) is not None:
            left, right = left + travel.left, right + travel.right
    return left, right, feedback


@pytest.mark.parametrize("silence", [0.3, 0.8, 4.0])
@pytest.mark.parametrize("silent", ["a", "ab", "abcd", "ac"])
@pytest.mark.parametrize("wheels", [("ab", "cd"), ("a", "c")])
def test_travel_during_silence_is_recovered_from_positions(silence, silent, wheels):
    def see(wheel: str, t: float, sample: WheelSample) -> WheelSample | None:
        return None if wheel in silent and 1.0 < t < 1.0 + silence else sample

    left, right, feedback = drive(see, wheels=wheels)
    assert (left, right) == pytest.approx((8.0, 16.0), abs=0.01)
    assert not feedback.problems


def test_permanently_silent_wheel_is_assumed_to_turn_with_its_side():
    left, right, _ = drive(lambda wheel, t, s: None if wheel == "a" else s, seconds=6.0)
    assert (left, right) == pytest.approx((8.0, 16.0), abs=0.01)


def shifted(when, by):
    """Return a fault that offsets positions at selected times."""
    return lambda w, t, s: s._replace(position=s.position + by) if when(w, t) else s


@pytest.mark.parametrize("spike", [3.0, -50.0, 1e9, -1e300, math.nan])
def test_position_spikes_do_not_change_travel(spike):
    see = shifted(lambda wheel, t: wheel == "a" and round(t * RATE) % 50 == 17, spike)
    left, right, feedback = drive(see)
    # A non-finite position is bridged by the velocity, and the next one corrects the sum.
    assert (left, right) == pytest.approx((8.0, 16.0), abs=0.01)
    assert not feedback.problems


def test_counter_reset_loses_less_than_one_sample_of_travel():
    left, right, feedback = drive(shifted(lambda w, t: w == "a" and t > 3.0, -40.0), seconds=8.0)
    assert (left, right) == pytest.approx((10.0, 20.0), abs=0.01)
    assert "position jumped" in feedback.problems["a"]


def test_travel_continues_from_new_position_of_restarted_publisher():
    feedback = WheelFeedback(("a",), ("c",), max_speed=MAX_SPEED)
    for t, position, restarted in ((0.0, 100.0, False), (0.1, 100.2, False), (30.0, 0.0, True),
                                   (30.1, 0.3, False)):  # fmt: skip
        for wheel in "ac":
            feedback.receive(wheel, WheelSample(t, position, 2.0), t, restarted)
        travel = feedback.take(t, TIMEOUT)
    assert travel is not None and travel.left == pytest.approx(0.3)


@pytest.mark.parametrize("lowest", [0.0, -math.pi])
@pytest.mark.parametrize("speed", [1.0, -5.0])
def test_wrapping_position_is_reported_and_loses_no_travel(lowest, speed):
    def see(wheel: str, t: float, sample: WheelSample) -> WheelSample:
        return sample._replace(position=(sample.position - lowest) % (2 * math.pi) + lowest)

    left, right, feedback = drive(see, seconds=8.0, ways=lambda wheel, t: speed * min(t, 7.9))
    # The last step, back to the true position, is a jump of whole turns.
    assert (left, right) == pytest.approx((7.9 * speed, 7.9 * speed), abs=0.05)
    assert "position wraps" in feedback.problems["a"]


def ahead(wheel: str, t: float) -> float:
    return 2.0 * min(t, 7.9)


def test_position_wrap_at_unusual_range_is_bridged_by_velocity():
    left, right, feedback = drive(lambda w, t, s: s._replace(position=s.position % 3.7), 8.0, ahead)
    assert (left, right) == pytest.approx((15.8, 15.8), abs=0.05)
    assert "position jumped" in feedback.problems["c"]


def test_constant_position_is_reported_and_replaced_by_velocity():
    def see(wheel: str, t: float, sample: WheelSample) -> WheelSample:
        return sample._replace(position=0.0)

    left, right, feedback = drive(see, seconds=8.0, ways=ahead)
    assert (left, right) == pytest.approx((15.8, 15.8), abs=0.05)
    feedback = make()
    for k in range(RATE):
        feed(feedback, k / RATE, "abcd", 0.0, velocity=2.0)
    assert set(feedback.problems) == set("abcd")
    assert "never changes" in feedback.problems["a"]
    speeds = feedback.take(1.0, TIMEOUT)
    assert speeds is not None and speeds.left_speed == 2.0
    still, _, feedback = drive(see, ways=lambda wheel, t: 0.01 * math.sin(9.0 * t))
    assert abs(still) < 0.02 and not feedback.problems, "a wheel that stands is not blamed"


def test_late_and_repeated_samples_neither_add_nor_lose_motion():
    late: dict[str, WheelSample] = {}

    def see(wheel: str, t: float, sample: WheelSample) -> WheelSample:
        before = late.get(wheel, sample)
        late[wheel] = sample
        return before if round(t * RATE) % 10 == 3 else sample

    left, right, feedback = drive(see)
    assert (left, right) == pytest.approx((8.0, 16.0), abs=0.01)
    assert not feedback.problems


def test_backward_clock_jump_loses_one_sample_of_travel():
    left, right, _ = drive(lambda w, t, s: s._replace(stamp=s.stamp - 3600.0 * (t > 3.0)), 8.0)
    assert (left, right) == pytest.approx((10.0, 20.0), abs=0.05)
