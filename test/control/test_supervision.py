# SPDX-License-Identifier: Apache-2.0
"""Freshness of feedback, leases, faults of motors, and recovery."""

import math

import pytest

from smp_motor_control.wheel.faults import Fault, FaultDetector, FaultLimits
from smp_motor_control.wheel.freshness import FeedbackClock, Verdict
from smp_motor_control.wheel.lease import Lease

MS = 1_000_000
START = 1_700_000_000 * 1_000_000_000


def clock() -> FeedbackClock:
    return FeedbackClock(max_age=0.2, max_gap=0.2)


def feed(c: FeedbackClock, *instants: tuple[float, float]) -> list[Verdict]:
    """Feed samples with stamps and arrivals in milliseconds; return their verdicts."""
    return [c.accept(START + round(s * MS), START + round(a * MS)) for s, a in instants]


def test_steady_feedback_is_fresh_and_dt_comes_from_the_stamps():
    c = clock()
    verdicts = feed(c, *((5 * k, 5 * k + (3 if k % 2 else 0)) for k in range(10)))
    assert verdicts == [Verdict.FIRST] + [Verdict.FRESH] * 9
    assert c.dt == pytest.approx(0.005, abs=1e-12)
    assert c.age == pytest.approx(0.003, abs=1e-9)


def test_duplicate_and_reordered_samples_are_distinguished_and_skipped():
    c = clock()
    verdicts = feed(c, (0, 0), (5, 5), (5, 6), (15, 15), (10, 16), (20, 20))
    assert verdicts[2] is Verdict.DUPLICATE and verdicts[4] is Verdict.REORDERED
    assert verdicts[5] is Verdict.FRESH and c.dt == pytest.approx(0.005)


def test_lost_samples_lengthen_dt_up_to_the_maximum_gap():
    c = clock()
    assert feed(c, (0, 0), (5, 5), (150, 150))[2] is Verdict.FRESH
    assert c.dt == pytest.approx(0.145)
    assert feed(c, (400, 400)) == [Verdict.FIRST]


@pytest.mark.parametrize("from_the_start", [True, False])
def test_feedback_delayed_by_half_a_second_is_late_while_delayed(from_the_start):
    c = clock()
    if not from_the_start:
        feed(c, *((5 * k, 5 * k) for k in range(10)))
    assert set(feed(c, *((45 + 5 * k, 545 + 5 * k) for k in range(1, 50)))) == {Verdict.LATE}
    assert c.age == pytest.approx(0.5)
    assert feed(c, (600, 600), (605, 605))[-1] is Verdict.FRESH


@pytest.mark.parametrize("jump", [-10_000, 10_000, -1_500, 86_400_000])
def test_clock_jump_and_its_reversal_cost_one_sample_each(jump):
    c = clock()
    feed(c, (0, 0), (5, 5))
    there = feed(c, *((jump + 10 + 5 * k, 10 + 5 * k) for k in range(5)))
    back = feed(c, *((35 + 5 * k, 35 + 5 * k) for k in range(5)))
    assert there == back == [Verdict.FIRST] + [Verdict.FRESH] * 4
    assert c.jumps == 2 and c.offset == 0.0


def test_offset_of_unset_hardware_clock_is_learnt():
    c = clock()
    verdicts = [c.accept(k * 5 * MS + 1, START + k * 5 * MS) for k in range(5)]
    assert verdicts[1:] == [Verdict.FRESH] * 4
    assert c.offset == pytest.approx(1.7e9)
    late = c.accept(25 * MS, START + 525 * MS)
    assert late is Verdict.LATE


def test_zero_stamps_are_replaced_by_arrival_time():
    c = clock()
    assert [c.accept(0, START + k * 5 * MS) for k in range(3)][-1] is Verdict.FRESH
    assert c.dt == pytest.approx(0.005)


def test_growing_queue_is_late_feedback_and_not_a_clock_jump():
    c = clock()
    feed(c, (0, 0), (5, 5))
    # The queue grows to two seconds: stamps are consecutive, arrivals are delayed.
    assert set(feed(c, *((10 + 5 * k, 2010 + 5 * k) for k in range(20)))) == {Verdict.LATE}
    assert (c.jumps, c.offset, c.age) == (0, 0.0, pytest.approx(2.0))
    assert feed(c, (2200, 2200), (2205, 2205)) == [Verdict.FIRST, Verdict.FRESH]
    # After a reset the delay is taken for a clock offset.
    feed(c, (2210, 4210))
    c.reset()
    assert feed(c, (2215, 4215), (2220, 4220)) == [Verdict.FIRST, Verdict.FRESH]
    assert (c.jumps, c.offset, c.age) == (0, pytest.approx(2.0), pytest.approx(0.0))


def test_forward_clock_jump_and_jump_after_gap_are_detected():
    c = clock()
    feed(c, (0, 0), (5, 5))
    assert feed(c, (1600, 10)) == [Verdict.FIRST]
    assert c.age == 0.0, "counted from the new offset on"
    assert feed(c, (1605, 15)) == [Verdict.FRESH]
    assert c.jumps == 1 and c.offset == pytest.approx(-1.59) and c.age == pytest.approx(0.0)
    # Three seconds of silence, one second by the stamps: longer than a gap, so not a queue.
    assert feed(c, (2605, 3015)) == [Verdict.FIRST]
    assert c.jumps == 2 and c.offset == 0.0 and c.age == pytest.approx(0.41)


def test_clock_offset_is_relearnt_when_computer_clock_is_set():
    c = clock()
    for k in range(3):
        assert c.accept(START + 5 * k * MS, START + 5 * k * MS, 7.0 + 0.005 * k)
    # NTP sets the computer's clock forward by 5 s between two samples.
    verdicts = [
        c.accept(START + k * 5 * MS, START + (5000 + 5 * k) * MS, 7.0 + 0.005 * k) for k in (3, 4)
    ]
    assert verdicts == [Verdict.FIRST, Verdict.FRESH] and c.offset == pytest.approx(5.0)
    # After 5 s of silence on the steady clock, a stamp without that gap is late.
    assert c.accept(START + 25 * MS, START + 10_025 * MS, 12.0) is Verdict.LATE


def test_new_feedback_clock_has_zero_counts_and_offset():
    c = clock()
    assert (c.jumps, c.offset, c.dt, c.age) == (0, 0.0, 0.0, 0.0)
    assert c.counts == dict.fromkeys(Verdict, 0)
    assert feed(c, (0, 50)) == [Verdict.FIRST]
    assert (c.dt, c.age) == (0.0, pytest.approx(0.05))


def test_samples_are_counted_by_verdict():
    c = clock()
    feed(c, (0, 0), (5, 5), (10, 10), (10, 11), (7, 12), (20, 520), (900, 900))
    expected = {"FIRST": 2, "FRESH": 2, "DUPLICATE": 1, "REORDERED": 1, "LATE": 1}
    assert {verdict.name: n for verdict, n in c.counts.items()} == expected


def test_age_and_gap_limits_are_inclusive():
    c = FeedbackClock(max_age=0.25, max_gap=0.5)  # binary fractions: nothing is rounded
    assert feed(c, (0, 250), (500, 750)) == [Verdict.FIRST, Verdict.FRESH]
    assert feed(c, (1001, 1001), (1002, 1253)) == [Verdict.FIRST, Verdict.LATE]


def lease(*commands: tuple[str, float, float], timeout: float = 0.2) -> list[bool]:
    one = Lease(timeout)
    return [one.take(writer, voltage, now) for writer, voltage, now in commands]


def test_lease_lasts_one_time_out_after_last_nonzero_command():
    taken = lease(
        ("a", 1.0, 0.0), ("b", 1.0, 0.125), ("b", 0.0, 0.125), ("b", 1.0, 0.25), timeout=0.25
    )
    assert taken == [True, False, False, True]
    # Zeros and non-finite commands neither take nor renew the lease.
    for value in (0.0, math.nan, math.inf):
        assert lease(("a", value, 0.0), ("b", 1.0, 0.1)) == [True, True]
        assert lease(("a", 1.0, 0.0), ("a", value, 0.15), ("b", 1.0, 0.21)) == [True, True, True]
    assert lease(("a", 1.0, 0.0), ("a", -1.0, 0.15), ("b", 1.0, 0.21)) == [True, True, False]


def test_lease_reports_owner_and_counts_refused_writers():
    one = Lease(0.2)
    assert one.owner(0.0) == "" and one.refused == {}
    one.take("a", 1.0, 1.0)
    assert [one.owner(t) for t in (1.0, 1.19, 1.2)] == ["a", "a", ""]
    for k in range(3):
        one.take("b", 1.0, 1.01 + 0.01 * k)
    one.take("c", 1.0, 1.1)
    assert one.refused == {"b": 3, "c": 1}


def test_lease_ends_after_one_second_with_infinite_time_out():
    one = Lease(math.inf)
    one.take("a", 1.0, 0.0)
    assert one.owner(0.999) == "a" and one.owner(1.0) == ""


def test_outdated_queued_commands_are_refused_unless_zero():
    one = Lease(0.2)
    ms = 1_000_000

    def at(now_ms: int, voltage: float, stamp_ms: int, writer: str = "a") -> bool:
        return one.take(writer, voltage, 1e-3 * now_ms, stamp_ms * ms, now_ms * ms)

    assert at(1000, 3.0, 995)
    # The driver was suspended; the commands in its queue are outdated.
    assert not at(1900, 3.0, 1005)
    assert at(1900, 0.0, 1005)
    assert not at(4800, 3.0, 1910)
    assert at(4801, 3.0, 4800)
    assert one.late == 2
    # The age of a command follows its writer's own clock; without stamps there is no age.
    assert at(6000, 3.0, 50_000, "b") and not at(6600, 3.0, 50_300, "b")
    assert at(7000, 3.0, 0, "c") and at(9000, 3.0, 0, "c")
    one.set_timeout(0.5)
    assert at(9500, 3.0, 9500, "c") and at(10_000, 3.0, 9600, "c") and at(10_600, 3.0, 10_500, "a")


def test_clock_offsets_of_64_recent_writers_are_remembered():
    def judged(others: int, again: int = 0) -> bool:
        """Tell whether a late command is refused after commands of others."""
        one = Lease(0.2)
        assert one.take("late", 3.0, 6.0, 50_000 * MS, 6000 * MS)  # with a clock offset
        for k in range(others):
            one.take(f"writer {k}", 0.0, 6.1, 6100 * MS, 6100 * MS)
        for _ in range(again):
            one.take("late", 0.0, 6.2, 50_200 * MS, 6200 * MS)
            one.take("one more", 0.0, 6.2, 6200 * MS, 6200 * MS)
        return not one.take("late", 3.0, 6.8, 50_300 * MS, 6800 * MS)

    assert judged(63) and not judged(64)
    # A writer heard recently is not the one to be forgotten.
    assert judged(63, again=1)


def test_refused_writers_are_counted_individually_up_to_64():
    one = Lease(0.2)
    one.take("owner", 3.0, 1.0)
    for k in range(1000):
        one.take(f"writer {k}", 3.0, 1.1)
    one.take("writer 3", 3.0, 1.1)
    assert one.refused["writer 3"] == 2 and one.refused["others"] == 1000 - 64
    assert len(one.refused) == 65


LIMITS = FaultLimits(current_limit=3.0, current_time=0.05)


def follow(speed, reference=2.0, saturated=False, kv=math.nan) -> tuple[float, Fault | None]:
    """Step at 200 Hz under 12 V for two seconds; return the time of the fault and the fault."""
    detector = FaultDetector(LIMITS)
    detector.volts_per_speed = kv
    for k in range(400):
        t = 0.005 * (k + 1)
        fault = detector.follow(0.005, reference, speed(t), 12.0, saturated)
        if fault:
            return t, fault
    return math.inf, None


@pytest.mark.parametrize(
    ("speed", "options", "fault"),
    [
        (lambda t: 0.0, {}, Fault.NOT_FOLLOWING),
        (lambda t: 0.3, {}, Fault.NOT_FOLLOWING),
        (lambda t: 4.0, {}, Fault.NOT_FOLLOWING),
        (lambda t: -1.0, {}, Fault.WRONG_WAY),
        (lambda t: 1.0 + t, {"reference": 0.0}, Fault.NOT_FOLLOWING),
        (lambda t: 1.5, {}, None),
        (lambda t: 2.0 + 2.0 * (-1.0) ** round(200 * t), {}, None),  # noise of an encoder
        (lambda t: 2.0 * (1.0 - math.exp(-t / 1.5)), {}, None),  # a heavy robot
        (lambda t: -2.0 + 6.0 * t if t < 0.66 else 2.0, {}, None),  # it reverses
        (lambda t: 4.6, {"reference": 10.0, "saturated": True}, None),
        (lambda t: 4.6, {"reference": 10.0, "saturated": True, "kv": 2.55}, None),
        (lambda t: 1.0, {"reference": 10.0, "saturated": True, "kv": 2.55}, Fault.NOT_FOLLOWING),
        (lambda t: 1.0, {"reference": 10.0, "saturated": True}, Fault.NOT_FOLLOWING),
    ],
)
def test_tracking_fault_is_detected_within_half_a_second(speed, options, fault):
    instant, found = follow(speed, **options)
    assert found is fault
    assert instant <= 0.5 or fault is None
