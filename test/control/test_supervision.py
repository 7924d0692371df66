"""Which feedback counts, which motor misbehaves, and when it may be tried again."""

from __future__ import annotations

import math

import pytest

from smp_motor_control.errors import ParameterError
from smp_motor_control.wheel.supervision import (
    Fault,
    FaultDetector,
    FaultLimits,
    FeedbackClock,
    Latch,
    Verdict,
)

MS = 1_000_000
START = 1_700_000_000 * 1_000_000_000


def clock() -> FeedbackClock:
    return FeedbackClock(max_age=0.2, max_gap=0.2)


def feed(c: FeedbackClock, *instants: tuple[float, float]) -> list[Verdict]:
    """Stamps and arrivals in milliseconds."""
    return [c.accept(START + round(s * MS), START + round(a * MS)) for s, a in instants]


def test_steady_feedback_is_fresh_and_dt_comes_from_the_stamps():
    c = clock()
    verdicts = feed(c, *((5 * k, 5 * k + (3 if k % 2 else 0)) for k in range(10)))
    assert verdicts == [Verdict.FIRST] + [Verdict.FRESH] * 9
    assert c.dt == pytest.approx(0.005, abs=1e-12)
    assert c.age == pytest.approx(0.003, abs=1e-9)


def test_duplicates_and_reordered_samples_are_told_apart_and_left_out():
    c = clock()
    verdicts = feed(c, (0, 0), (5, 5), (5, 6), (15, 15), (10, 16), (20, 20))
    assert verdicts[2] is Verdict.DUPLICATE and verdicts[4] is Verdict.REORDERED
    assert verdicts[5] is Verdict.FRESH and c.dt == pytest.approx(0.005)


def test_lost_samples_lengthen_dt_until_the_gap_is_too_long():
    c = clock()
    assert feed(c, (0, 0), (5, 5), (150, 150))[2] is Verdict.FRESH
    assert c.dt == pytest.approx(0.145)
    assert feed(c, (400, 400)) == [Verdict.FIRST]


@pytest.mark.parametrize("from_the_start", [True, False])
def test_feedback_delayed_by_half_a_second_is_late_as_long_as_it_is(from_the_start):
    c = clock()
    if not from_the_start:
        feed(c, *((5 * k, 5 * k) for k in range(10)))
    assert set(feed(c, *((45 + 5 * k, 545 + 5 * k) for k in range(1, 50)))) == {Verdict.LATE}
    assert c.age == pytest.approx(0.5)
    assert feed(c, (600, 600), (605, 605))[-1] is Verdict.FRESH


@pytest.mark.parametrize("jump", [-10_000, 10_000, -1_500, 86_400_000])
def test_clock_that_jumps_costs_one_sample_and_there_and_back_is_learnt(jump):
    c = clock()
    feed(c, (0, 0), (5, 5))
    there = feed(c, *((jump + 10 + 5 * k, 10 + 5 * k) for k in range(5)))
    back = feed(c, *((35 + 5 * k, 35 + 5 * k) for k in range(5)))
    assert there == back == [Verdict.FIRST] + [Verdict.FRESH] * 4
    assert c.jumps == 2 and c.offset == 0.0


def test_hardware_whose_clock_was_never_set_is_used_with_its_offset():
    c = clock()
    verdicts = [c.accept(k * 5 * MS + 1, START + k * 5 * MS) for k in range(5)]
    assert verdicts[1:] == [Verdict.FRESH] * 4
    assert c.offset == pytest.approx(1.7e9)
    late = c.accept(25 * MS, START + 525 * MS)
    assert late is Verdict.LATE


def test_zero_stamps_stand_for_the_arrival():
    c = clock()
    assert [c.accept(0, START + k * 5 * MS) for k in range(3)][-1] is Verdict.FRESH
    assert c.dt == pytest.approx(0.005)


LIMITS = FaultLimits(current_limit=3.0, current_time=0.05)


def run(detector: FaultDetector, duration: float, voltage, velocity, current) -> float | None:
    """Step at 200 Hz; return when a fault shows and keep it in the detector."""
    for k in range(round(duration / 0.005)):
        t = 0.005 * k
        values = [x(t) if callable(x) else x for x in (voltage, velocity, current)]
        detector.found = detector.step(0.005, *values)
        if detector.found:
            return t + 0.005
    return None


def test_stall_and_dead_encoder_are_told_apart_by_the_current():
    # 6 V over 3 ohm: 2 A at standstill, less when it really turns.
    for current, fault in ((1.95, Fault.STALL), (1.4, Fault.DEAD_ENCODER)):
        detector = FaultDetector(LIMITS, resistance=3.0)
        assert run(detector, 2.0, 6.0, 0.0, current) == pytest.approx(0.5, abs=0.006)
        assert detector.found is fault
    detector = FaultDetector(LIMITS)
    run(detector, 2.0, 6.0, 0.0, math.nan)
    assert detector.found is Fault.NO_MOTION


def test_wheel_at_rest_below_the_stall_voltage_is_no_fault():
    assert run(FaultDetector(LIMITS), 10.0, 3.9, 0.0, 0.5) is None


def test_wheel_that_starts_slowly_is_no_fault():
    assert run(FaultDetector(LIMITS), 5.0, 12.0, lambda t: 0.0 if t < 0.4 else t, 1.0) is None


def test_turning_against_the_voltage_is_a_runaway():
    detector = FaultDetector(LIMITS)
    assert run(detector, 2.0, 6.0, lambda t: -0.5 - t, 0.5) == pytest.approx(0.2, abs=0.006)
    assert detector.found is Fault.RUNAWAY


def test_braking_against_the_motion_is_not():
    # The slowest motor of the paper loses its speed with a time constant of 0.14 s.
    assert run(FaultDetector(LIMITS), 0.6, -6.0, lambda t: 3 * math.exp(-t / 0.14), 0.5) is None


def test_current_above_its_limit_counts_only_after_its_time():
    assert run(FaultDetector(LIMITS), 1.0, 6.0, 1.0, lambda t: 5.0 if t < 0.04 else 1.0) is None
    detector = FaultDetector(LIMITS)
    assert run(detector, 1.0, 6.0, 1.0, -5.0) == pytest.approx(0.05, abs=0.006)
    assert detector.found is Fault.OVER_CURRENT


def test_fault_is_released_by_a_zero_set_point_or_after_a_pause_that_doubles():
    latch = Latch(first_pause=2.0)
    latch.set(Fault.STALL, 100.0)
    assert not latch.may_release(0.0, 100.1)
    assert latch.may_release(0.0, 100.6)
    now, pauses = 200.0, []
    for _ in range(6):
        latch.set(Fault.STALL, now)
        begin = now
        while not latch.may_release(1.0, now):
            now += 0.01
        pauses.append(now - begin)
    assert pauses == pytest.approx([2.0, 4.0, 8.0, 16.0, 30.0, 30.0], abs=0.02)


def test_wheel_that_gave_no_counts_is_released_by_counts():
    for fault, released in ((Fault.DEAD_ENCODER, True), (Fault.RUNAWAY, False)):
        latch = Latch(first_pause=0.0)
        latch.set(fault, 0.0)
        assert latch.may_release(1.0, 0.1, turns=True) is released


def test_without_a_pause_only_a_zero_set_point_releases():
    latch = Latch(first_pause=0.0)
    latch.set(Fault.RUNAWAY, 0.0)
    assert not latch.may_release(1.0, 1e6)
    assert latch.may_release(0.0, 1e6)


def test_limits_out_of_range_are_refused():
    with pytest.raises(ParameterError, match="stall_time"):
        FaultLimits(stall_time=-1.0)
