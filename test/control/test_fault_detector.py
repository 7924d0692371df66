# SPDX-License-Identifier: Apache-2.0
"""Every limit of the fault detection to the sample; steps of 1/64 s, so that sums are exact."""

import math
from collections.abc import Iterable
from dataclasses import asdict, replace
from itertools import chain, repeat

import pytest

from smp_motor_control.wheel.controller import WheelSettings
from smp_motor_control.wheel.faults import Fault, FaultDetector, FaultLimits, Recovery
from smp_motor_control.wheel.protection import Bounds, Protection

DT = 1.0 / 64.0
SLOW = 1.0 / 32.0
LIMITS = FaultLimits(
    current_limit=3.0, current_time=4 * DT, stall_voltage=4.0, stall_velocity=SLOW, stall_time=0.5,
    runaway_time=0.25, tracking_tolerance=0.5, tracking_time=0.75,
)  # fmt: skip
WINDOW = 16  # samples in a third of the tracking time
ABOVE = 1.0 + 2.0**-30


def first_fault(samples, limits=LIMITS, detector=None):
    """Return the first of (V, rad/s, A), counted from 1, with a fault, and the fault."""
    detector = detector or FaultDetector(limits)
    for k, sample in enumerate(samples, 1):
        fault = detector.step(DT, *sample)
        if fault is not None:
            return k, fault
    return 0, None


def test_default_fault_limits_match_the_documentation():
    assert asdict(FaultLimits()) == {
        "current_limit": 0.0, "current_time": 0.1, "stall_voltage": 4.0, "stall_velocity": 0.02,
        "stall_time": 0.5, "runaway_time": 0.2, "tracking_tolerance": 0.5, "tracking_time": 0.45,
    }  # fmt: skip
    settings = WheelSettings()
    assert (settings.setpoint_timeout, settings.feedback_timeout) == (0.5, 0.2)
    assert (settings.fault_retry, settings.implausible_velocity) == (2.0, 1000.0)
    assert Recovery().first_pause == 2.0


def test_over_current_needs_consecutive_samples_above_limit():
    high, limit = (6.0, 1.0, -3.0 * ABOVE), (6.0, 1.0, 3.0)
    assert first_fault(repeat(high, 9)) == (4, Fault.OVER_CURRENT)
    assert first_fault(repeat(limit, 99)) == (0, None)
    assert first_fault([high, high, high, limit] * 9) == (0, None)
    assert first_fault(repeat(high, 99), replace(LIMITS, current_limit=0.0)) == (0, None)
    assert first_fault(repeat((6.0, 1.0, 0.6), 9), replace(LIMITS, current_limit=0.5))[0] == 4


def test_stall_needs_consecutive_samples_at_stall_voltage_below_stall_speed():
    still, turns = (-4.0, 0.0, math.nan), (-4.0, -SLOW, math.nan)
    assert first_fault(repeat(still, 99)) == (32, Fault.NO_MOTION)
    assert first_fault(repeat(turns, 99)) == (0, None)
    assert first_fault(repeat((-4.0, -SLOW / ABOVE, math.nan), 99))[0] == 32
    assert first_fault(repeat((-4.0 / ABOVE, 0.0, math.nan), 99)) == (0, None)
    assert first_fault([*[still] * 31, turns] * 9) == (0, None)
    assert first_fault(repeat(still, 999), replace(LIMITS, stall_time=0.0)) == (0, None)


def test_runaway_needs_consecutive_samples_from_half_the_stall_voltage():
    against = (2.0, -SLOW, 0.0)
    assert first_fault(repeat(against, 99)) == (16, Fault.RUNAWAY)
    assert first_fault(repeat((-2.0, SLOW, 0.0), 99)) == (16, Fault.RUNAWAY)
    for no in [(2.0 / ABOVE, -1.0, 0.0), (2.0, -SLOW / ABOVE, 0.0), (2.0, 1.0, 0.0)]:
        assert first_fault(repeat(no, 99)) == (0, None)
        assert first_fault([*[against] * 15, no] * 9) == (0, None)
    assert first_fault(repeat(against, 999), replace(LIMITS, runaway_time=0.0)) == (0, None)
    calm = replace(LIMITS, stall_velocity=0.0, stall_time=0.0)
    assert first_fault(repeat((6.0, 0.0, 0.0), 99), calm) == (0, None), "at rest it is not against"


def test_speed_falling_by_over_a_fifth_is_braking_and_not_runaway():
    def braked(share: float) -> Iterable[tuple[float, float, float]]:
        return ((6.0, -(share ** (k // 8)), 0.0) for k in range(64))

    assert first_fault(braked(0.75)) == (0, None)
    # A fall to just above 0.8 is not enough; a larger fall restarts the time.
    assert first_fault(braked(0.8 * ABOVE))[0] == 16
    once = chain(repeat((6.0, -1.0, 0.0), 10), repeat((6.0, -0.7, 0.0), 99))
    assert first_fault(once) == (10 + 16, Fault.RUNAWAY)


@pytest.mark.parametrize(
    ("current", "resistance", "fault"),
    [
        (6.8, 1.0, Fault.DEAD_ENCODER),  # 0.85 of 8 V, not above
        (-6.8 * ABOVE, 1.0, Fault.STALL),
        (math.nan, 1.0, Fault.NO_MOTION),
        (6.9, math.nan, Fault.NO_MOTION),
    ],
)
def test_current_distinguishes_stall_from_dead_encoder(current, resistance, fault):
    detector = FaultDetector(replace(LIMITS, current_limit=0.0), resistance)
    assert first_fault(repeat((-8.0, 0.0, current), 99), detector=detector) == (32, fault)


@pytest.mark.parametrize("sample", [(6.0, 1.0, 9.0), (6.0, 0.0, 0.0), (6.0, -1.0, 0.0)])
def test_reset_clears_fault_counters(sample):
    detector = FaultDetector(LIMITS)
    first, fault = first_fault(repeat(sample, 99), detector=FaultDetector(LIMITS))
    assert first_fault(repeat(sample, first - 1), detector=detector) == (0, None)
    detector.reset()
    assert first_fault(repeat(sample, 99), detector=detector) == (first, fault)


def track(*parts, limits=LIMITS, kv=math.nan, static=0.0):
    """Return the first window with a fault, counted from 1, and the fault.

    Parts are (reference, speed, voltage, saturated); callables depend on the sample.
    """
    detector = FaultDetector(limits)
    detector.volts_per_speed, detector.static_voltage = kv, static
    for k, part in enumerate(parts, 1):
        for j in range(WINDOW):
            reference, speed, voltage, saturated = (x(j) if callable(x) else x for x in part)
            fault = detector.follow(DT, reference, speed, voltage, saturated)
            if fault is not None:
                assert j == WINDOW - 1, "at the end of a window"
                return k, fault
    return 0, None


def test_tracking_error_above_tolerance_is_a_fault_in_second_window():
    slow, near = (2.0, 0.65, 6.0, False), (2.0, 0.75, 6.0, False)  # 1.3 is allowed
    assert track(slow, slow) == (2, Fault.NOT_FOLLOWING)
    assert track(near, near, near) == (0, None)
    assert track(slow, near, slow, near) == (0, None)
    assert track((-2.0, 0.2, 6.0, False), (-2.0, 0.2, 6.0, False)) == (2, Fault.WRONG_WAY)
    assert track((0.0, 1.0, 6.0, False), (0.0, 1.0, 6.0, False)) == (2, Fault.NOT_FOLLOWING)
    tolerant = replace(LIMITS, tracking_tolerance=0.6)
    assert track(slow, slow, limits=tolerant) == (0, None)
    assert track(slow, slow, limits=replace(LIMITS, tracking_time=0.0)) == (0, None)


def test_tracking_error_shrinking_by_over_a_twentieth_is_not_a_fault():
    assert track((2.0, 0.2, 6.0, False), (2.0, 0.28, 6.0, False))[0] == 2  # 1.8 to 1.72
    assert track((2.0, 0.2, 6.0, False), (2.0, 0.30, 6.0, False))[0] == 0  # 1.8 to 1.70


def test_reversal_slower_than_reference_is_not_a_fault():
    """The error grows while the reference changes sign, but the wheel decelerates."""
    asked = (-0.3, -0.9, 6.0, False), (2.0, -0.6, 6.0, False), (2.0, -0.2, 6.0, False)
    assert track(*asked) == (0, None)
    stuck = (-0.3, -0.9, 6.0, False), (2.0, -0.9, 6.0, False), (2.0, -0.9, 6.0, False)
    assert track(*stuck) == (2, Fault.WRONG_WAY)


def test_tracking_error_is_the_mean_over_the_window():
    swings = (2.0, lambda j: 1.9 + (-1) ** j, 6.0, False)
    assert track(*[swings] * 9) == (0, None)
    swings = (2.0, lambda j: 0.6 + 9 * (-1) ** j, 6.0, False)
    assert track(*[swings] * 2) == (2, Fault.NOT_FOLLOWING)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_expected_speed_is_limited_by_voltage_in_saturation(sign):
    def at(speed: float) -> tuple:
        return (sign * 10.0, sign * speed, sign * 12.0, True)

    # By the model (12 - 0.5)/2 = 5.75; the tolerated error is 2.875 + 0.3.
    assert track(at(2.5), at(2.5), kv=2.0, static=0.5) == (2, Fault.NOT_FOLLOWING)
    assert track(at(2.65), at(2.65), kv=2.0, static=0.5) == (0, None)
    # A voltage below that of friction moves nothing.
    weak = (sign * 10.0, 0.0, sign * 0.4, True)
    assert track(weak, weak, kv=2.0, static=0.5) == (0, None)
    # Unknown volts per speed: an error of 0.7 of the set-point plus 0.3 is tolerated.
    assert track(at(2.6), at(2.6)) == (2, Fault.NOT_FOLLOWING)
    assert track(at(2.8), at(2.8)) == (0, None)
    # With one unsaturated sample the full set-point is expected.
    almost = (sign * 10.0, sign * 2.8, sign * 12.0, lambda j: j != 3)
    assert track(almost, almost) == (2, Fault.NOT_FOLLOWING)


@pytest.mark.parametrize(
    ("learning", "learns"),
    [
        ((2.0, 1.9, 6.0), True),  # 12 V give 3.8
        ((-2.0, -1.9, -6.0), True),
        ((0.4, 0.4, 0.4 * 12.0 / 3.8), True),
        ((2.0, 1.75, 1.75 * 12.0 / 3.8), False),  # off by more than a tenth
        ((0.28, 0.28, 0.28 * 12.0 / 3.8), False),  # too slow
    ],
)
def test_volts_per_speed_are_learnt_while_tracking_error_is_small(learning, learns):
    # At 2.0: enough of 3.8, too little of 10.
    at = (10.0, 2.0, 12.0, True)
    assert track((*learning, False), at, at)[0] == (0 if learns else 3)
    # The tolerated error of the learnt speed is 1.9 + 0.3.
    if learns:
        slow = (10.0, 1.55, 12.0, True)
        assert track((*learning, False), slow, slow)[0] == 3


def test_standstill_is_a_tracking_fault_only_without_stall_detection():
    for limits, named in ((LIMITS, None), (replace(LIMITS, stall_time=0.0), Fault.NOT_FOLLOWING)):
        detector, fault = FaultDetector(limits), None
        for _ in range(31):
            assert detector.step(DT, 6.0, 0.0, math.nan) is None
            fault = fault or detector.follow(DT, 2.0, 0.0, 6.0, False)
        fault = fault or detector.follow(DT, 2.0, 0.0, 6.0, False)
        assert fault is named


def test_retry_pause_doubles_until_fault_is_latched():
    recovery, now = Recovery(first_pause=1.0), 100.0
    for pause in (1.0, 2.0, 4.0):
        recovery.set(Fault.RUNAWAY, now)
        assert not recovery.latched and recovery.cautious
        assert not recovery.may_release(1.0, now + pause)
        assert recovery.fault is Fault.RUNAWAY
        assert recovery.may_release(1.0, now + pause + DT)
        assert recovery.fault is None and not recovery.latched
        now += 50.0
    recovery.set(Fault.STALL, now)
    assert recovery.latched and recovery.failures == 4
    assert not recovery.may_release(0.0, now + 1e9, turns=True)
    recovery.reset()
    assert (recovery.fault, recovery.cautious, recovery.failures) == (None, False, 0)


def test_zero_set_point_or_returning_counts_release_a_fault_early():
    for fault in Fault:
        cases = [(0.0, 0.5, False), (0.0, 0.5 + DT, False), (0.1, 9.0, False), (0.1, 0.0, True)]
        for setpoint, waited, turns in cases:
            recovery = Recovery(first_pause=0.0)
            recovery.set(fault, 100.0)
            rested = setpoint == 0.0 and waited > 0.5
            silent = fault.value.startswith("no counts")
            released = recovery.may_release(setpoint, 100.0 + waited, turns)
            assert released is (rested or (turns and silent))


def test_retry_voltage_limit_ends_after_0_6_s_and_failures_clear_after_2_s():
    recovery, most = Recovery(), 1.05 * 4.0
    recovery.set(Fault.RUNAWAY, 0.0)
    turn = lambda volts, speed: recovery.limit_voltage(volts, speed, 0.125, LIMITS)  # noqa: E731
    assert turn(12.0, SLOW) == most and turn(-12.0, -SLOW) == -most and turn(3.0, 1.0) == 3.0
    # 0.6 s are five samples of 0.125 s; a sample at standstill restarts them.
    assert [turn(12.0, 1.0) for _ in range(3)] == [most] * 3
    assert turn(12.0, 0.0) == most
    assert [turn(12.0, 1.0) for _ in range(5)] == [most] * 4 + [12.0]
    assert turn(12.0, -1.0) == 12.0, "braking is no sign of a fault once it is trusted"
    assert [turn(12.0, 1.0) for _ in range(10)] == [12.0] * 10 and recovery.failures == 1
    assert turn(-12.0, -1.0) == -12.0
    assert (recovery.failures, recovery.cautious) == (0, False)
    recovery.set(Fault.RUNAWAY, 0.0)
    assert turn(12.0, 1.0) == most, "good time before the fault does not count"
    again = Recovery()
    again.set(Fault.RUNAWAY, 0.0)
    for _ in range(4):
        again.limit_voltage(12.0, 1.0, 0.125, LIMITS)
    again.set(Fault.RUNAWAY, 0.0)
    assert again.limit_voltage(12.0, 1.0, 0.125, LIMITS) == most


@pytest.mark.parametrize(("what", "words"), [("speed", "turns at 20"), ("current", "is 20 A")])
def test_protection_trips_after_50_ms_and_not_on_single_samples(what, words):
    def sample(k: int, value: float) -> tuple[float, float, float]:
        current, speed = (0.1, value) if what == "speed" else (value, 1.0)
        return 1e9 + 0.01 * k, current, speed

    watched = Protection(Bounds(speed=10.0, current=10.0))
    once = [watched.add(*sample(k, 20.0 if k % 4 == 0 else 1.0)) for k in range(100)]
    assert not any(once)
    # Of either sign; six samples of 10 ms span 50 ms.
    said = [watched.add(*sample(100 + k, -20.0)) for k in range(7)]
    assert not any(said[:5]) and words in said[-1]


def test_protection_never_trips_without_limits_or_current_sensor():
    for bounds in (Bounds(), Bounds(current=1.0)):
        watched = Protection(bounds)
        assert not any(watched.add(1e9 + 0.01 * k, math.nan, 1e3) for k in range(4000))
