# SPDX-License-Identifier: Apache-2.0
"""Limits of the wheel controller, exact to the sample; steps of 1/64 s make times exact."""

import math
from dataclasses import replace

import pytest
from wheel_world import Sample

from smp_motor_control.encoder import Encoder
from smp_motor_control.motor.parameters import Gearbox, MotorModel
from smp_motor_control.pid import PidGains
from smp_motor_control.wheel.controller import State, WheelController, WheelSettings
from smp_motor_control.wheel.faults import Fault, FaultLimits
from smp_motor_control.wheel.loop import LoopSettings

DT = 1.0 / 64.0
EPOCH = 1_700_000_000 * 10**9
NO_FAULTS = FaultLimits(stall_time=0.0, runaway_time=0.0, tracking_time=0.0)
GAINS = PidGains(p=2.0, u_clamp_min=-12.0, u_clamp_max=12.0)
SETTINGS = WheelSettings(
    loop=LoopSettings(gains=GAINS), faults=NO_FAULTS, setpoint_timeout=0.5, feedback_timeout=0.25,
    fault_retry=1.0, implausible_velocity=100.0,
)  # fmt: skip


class Feed:
    """Passes 64 samples per second to a controller; the test sets the voltage."""

    def __init__(self, settings: WheelSettings = SETTINGS, active: bool = True) -> None:
        self.wheel, self.now = WheelController(settings), 100.0
        if active:
            self.wheel.activate(self.now)
        self.give()

    def give(self, velocity: float = 0.0, dt: float = DT, age: float = 0.0, **more: float):
        self.now += dt
        arrival = EPOCH + round(self.now * 1e9)
        sample = Sample(velocity=velocity, **more)
        stamp = arrival - round(age * 1e9)
        return self.wheel.take_feedback(sample, stamp, arrival, self.now)

    def ask(self, value: float, age: float = 0.0) -> None:
        self.wheel.take_setpoint(value, self.now, age)

    def hold(self, value: float, velocity: float, samples: int) -> Fault | None:
        """Send the set-point before every sample; return the fault at the end."""
        for _ in range(samples):
            self.ask(value)
            self.give(velocity)
        return self.wheel.recovery.fault


def feed_with_setpoint(value: float, settings: WheelSettings = SETTINGS) -> Feed:
    """Return a feed whose wheel has a set-point."""
    feed = Feed(settings)
    feed.ask(value)
    return feed


def test_set_point_older_than_time_out_is_refused():
    for age, counts in ((0.5, True), (0.5 + 2.0**-20, False), (-9.0, True)):
        feed = Feed()
        feed.ask(1.0, age)
        assert feed.give() == (2.0 if counts else 0.0)
        assert feed.wheel.state is (State.DRIVING if counts else State.WAITING)
        assert feed.wheel.refused == ({} if counts else {"set-point older than its time-out": 1})


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_set_point_above_its_limit_is_refused(sign):
    feed = feed_with_setpoint(sign * 1.0001e4)
    assert feed.give() == 0.0
    feed.ask(sign * 1e4)
    assert feed.give() == sign * 12.0


def test_wheel_brakes_after_set_point_time_out():
    feed = feed_with_setpoint(1.0)
    for k in range(1, 33):  # half a second
        assert feed.give(1.5) == -1.0, k
        assert feed.wheel.state is State.DRIVING
    assert feed.give(1.5) == -3.0
    assert feed.wheel.state is State.TIMED_OUT


@pytest.mark.parametrize(("transition", "longest"), [(0.0, 1.0), (0.25, 1.0), (60.0, 0.75)])
def test_braking_ends_in_zero_volts_after_stop_time(transition, longest):
    loop = LoopSettings(gains=GAINS, transition_time=transition, stop_time=longest)
    feed = feed_with_setpoint(1.0, replace(SETTINGS, loop=loop))
    start = feed.now
    while (voltage := feed.give(1.5)) != 0.0 or feed.now <= start + 0.5:
        pass
    assert feed.now - start == 0.5 + longest + DT
    assert feed.wheel.state is State.TIMED_OUT and voltage == 0.0
    assert feed.give(1.5) == 0.0 and feed.wheel.setpoint is None


@pytest.mark.parametrize(("speed", "at_rest"), [(0.049, True), (-0.049, True), (0.05, False)])
def test_wheel_at_rest_is_not_braked_after_time_out(speed, at_rest):
    feed = feed_with_setpoint(0.0)
    while feed.wheel.state is not State.TIMED_OUT:
        voltage = feed.give(speed)
    assert (voltage == 0.0) is at_rest


def test_braking_profile_is_completed_when_sensor_reports_standstill():
    gains = replace(GAINS, p=1.0, feedforward_velocity=1.0)
    feed = feed_with_setpoint(
        1.0, replace(SETTINGS, loop=LoopSettings(gains=gains, transition_time=0.5))
    )
    for _ in range(32):
        feed.give(0.0)
    # The sensor reports standstill while the reference is still moving to zero.
    assert feed.give(0.0) > 0.5


def test_feedback_silence_beyond_time_out_is_reported():
    feed = feed_with_setpoint(1.0)
    feed.give()
    assert feed.wheel.tick(feed.now + 0.25) is None
    assert feed.wheel.tick(feed.now + 0.25 + DT) == 0.0
    assert feed.wheel.state is State.NO_FEEDBACK
    bad = {"velocity": math.nan}
    for put, state in (({"age": 0.5}, State.LATE_FEEDBACK), (bad, State.BAD_FEEDBACK)):
        feed = feed_with_setpoint(1.0)
        feed.give()
        feed.now += 0.5  # so that the late stamps increase
        for _ in range(20):
            feed.give(**put)
            tick = feed.wheel.tick(feed.now)
        assert (tick, feed.wheel.state) == (0.0, state)
        # When these samples cease as well, the state is no feedback.
        assert feed.wheel.tick(feed.now + 0.25) == 0.0 and feed.wheel.state is state
        assert feed.wheel.tick(feed.now + 0.25 + DT) == 0.0
        assert feed.wheel.state is State.NO_FEEDBACK


def test_loop_restarts_from_measured_speed_after_interruption():
    loop = LoopSettings(gains=replace(GAINS, i=64.0), transition_time=1.0)
    for gap in ("silence", "late", "owner", "bad", "reset"):
        feed = feed_with_setpoint(1.0, replace(SETTINGS, loop=loop))
        feed.hold(1.0, 0.0, 16)
        assert feed.wheel.loop.pid.i_term > 0.5
        if gap == "silence":
            feed.now += 1.0
            assert feed.wheel.tick(feed.now) == 0.0
            assert feed.give(0.75) == 0.0, "the first sample after a gap has no interval"
        elif gap == "late":
            assert feed.give(0.75, dt=0.5 + DT, age=0.5) == 0.0
            feed.give(0.75)
        elif gap == "bad":
            for _ in range(20):
                feed.give(math.nan)
                feed.wheel.tick(feed.now)
        elif gap == "reset":
            feed.wheel.reset(feed.now)
            feed.give(0.75)
        else:
            feed.wheel.owner = "/excite#1"
            assert feed.give(0.75) == 0.0 and feed.wheel.state is State.OWNED_ELSEWHERE
            feed.wheel.owner = ""
        feed.ask(1.0)
        feed.give(0.75)
        assert feed.wheel.loop.reference.velocity == pytest.approx(0.75, abs=0.01), gap
        assert abs(feed.wheel.loop.pid.i_term) < 0.1


def test_speed_above_implausible_velocity_is_rejected_in_both_directions():
    for sign in (1.0, -1.0):
        feed = feed_with_setpoint(0.0)
        assert feed.give(sign * 100.0) == -sign * 12.0
        assert feed.give(sign * 100.01) is None
        assert feed.wheel.refused == {"feedback velocity that is not a number or implausible": 1}


def feed_with_counts() -> Feed:
    """Return a feed at a set-point of zero whose wheel differences counts."""
    loop = LoopSettings(gains=GAINS, speed_source="difference", difference_window=1)
    feed = Feed(replace(SETTINGS, loop=loop))
    feed.wheel.set_hardware(Gearbox(1.0), Encoder(64.0), 12.0)
    feed.ask(0.0)
    return feed


def test_count_jump_is_rejected_and_differencing_restarts():
    feed = feed_with_counts()
    per_count = 2.0 * math.pi  # rad/s of one count a sample
    feed.give(encoder_count=0)
    assert feed.give(encoder_count=1) == pytest.approx(-12.0)
    assert feed.give(encoder_count=1 + int(101 / per_count) + 1) is None
    assert feed.wheel.refused == {"feedback count that jumps": 1}
    assert feed.give(encoder_count=5000) is None, "the first of a new window has no speed"
    assert feed.give(encoder_count=5000) == 0.0
    assert feed.wheel.refused == {"feedback count that jumps": 1}
    for k in range(20):
        feed.give(encoder_count=10_000 * (k % 2))
        feed.wheel.tick(feed.now)
    assert feed.wheel.state is State.BAD_FEEDBACK


def test_clock_jump_restarts_differencing_of_counts():
    feed = feed_with_counts()
    feed.give(encoder_count=0)
    assert feed.give(encoder_count=0) == 0.0
    feed.give(encoder_count=1, age=60.0)
    assert feed.give(encoder_count=1, age=60.0) is None, "the first of a new window has no speed"
    assert feed.give(encoder_count=1, age=60.0) == 0.0


def test_faulted_wheel_answers_every_sample_with_zero_volts():
    feed = feed_with_setpoint(1.0)
    assert feed.give() == 2.0
    feed.wheel.recovery.set(Fault.RUNAWAY, feed.now)
    for _ in range(32):
        feed.ask(1.0)
        assert feed.give() == 0.0 and feed.wheel.output == 0.0
        assert feed.wheel.state is State.FAULT


def test_non_finite_reported_voltage_is_replaced_by_last_command():
    feed = Feed()
    seen: list[float] = []
    feed.wheel.loop.speed = lambda dt, velocity, count, voltage: seen.append(voltage) or velocity
    feed.ask(1.0)
    feed.give(0.0, voltage=7.0)
    for voltage in (math.nan, math.inf, -3.0):
        feed.give(0.5, voltage=voltage)
    assert seen == [7.0, 2.0, 1.0, -3.0]


def test_gap_between_samples_counts_at_most_0_1_s_towards_a_fault():
    limits = replace(NO_FAULTS, stall_time=0.5, stall_voltage=4.0)
    feed, found = Feed(replace(SETTINGS, faults=limits)), []
    for _ in range(12):
        feed.ask(6.0)
        feed.give(0.0, dt=0.1875)
        found.append(feed.wheel.recovery.fault)
    # The first answer counts nothing; then each sample counts 0.1 s towards 0.5 s.
    assert found.index(Fault.NO_MOTION) == 5


def test_stall_voltage_setting_is_applied():
    gains = replace(GAINS, p=1.0, u_clamp_min=-3.0, u_clamp_max=3.0)
    for stall_voltage, named in ((2.0, Fault.NO_MOTION), (4.0, None)):
        limits = replace(NO_FAULTS, stall_time=0.25, stall_voltage=stall_voltage)
        feed = Feed(replace(SETTINGS, loop=LoopSettings(gains=gains), faults=limits))
        assert feed.hold(5.0, 0.0, 32) is named
    changed = Feed(SETTINGS)
    changed.wheel.configure(replace(SETTINGS, faults=replace(limits, stall_voltage=2.0)))
    assert changed.hold(5.0, 0.0, 32) is Fault.NO_MOTION


def test_inactive_wheel_gives_no_answer_and_reset_clears_set_point():
    feed = Feed(active=False)
    feed.ask(1.0)
    assert feed.give() is None and feed.wheel.tick(feed.now + 9.0) is None
    assert feed.wheel.state is State.INACTIVE and feed.wheel.output == 0.0
    feed.wheel.activate(feed.now)
    assert feed.wheel.state is State.WAITING and feed.wheel.tick(feed.now + 0.25) is None
    feed.ask(1.0)
    feed.give()
    feed.give()
    assert feed.wheel.output == 2.0 and feed.wheel.steps == 1
    feed.wheel.reset(feed.now)
    assert feed.wheel.output == 0.0 and feed.wheel.answer is None and feed.wheel.setpoint is None
    feed.give()
    assert feed.give() == 0.0
    feed.ask(1.0)
    feed.give()
    feed.wheel.deactivate()
    assert (feed.wheel.output, feed.wheel.answer, feed.wheel.active) == (0.0, None, False)


def test_terms_of_output_are_reported():
    feed = feed_with_setpoint(1.0)
    assert feed.give(0.25) == 1.5
    wheel = feed.wheel
    assert (wheel.target, wheel.measurement, wheel.output, wheel.steps) == (1.0, 0.25, 1.5, 1)
    assert wheel.answer is not None and wheel.answer.p_term == 1.5
    feed.give(0.25, dt=0.0)  # a duplicate has no answer
    assert wheel.answer is None


def test_clamps_are_narrowed_to_the_supply():
    for low, high in ((6.0, 8.0), (-8.0, -6.0)):
        gains = replace(GAINS, u_clamp_min=low, u_clamp_max=high)
        with pytest.raises(ValueError, match="clamp"):
            LoopSettings(gains=gains).clamp_to_supply(5.0)
    for supply, most in ((5.0, 5.0), (50.0, 12.0)):
        narrowed = LoopSettings(gains=GAINS).clamp_to_supply(supply).gains
        assert (narrowed.u_clamp_min, narrowed.u_clamp_max) == (-most, most)


def test_only_changed_loop_settings_are_checked():
    bad = replace(SETTINGS, loop=LoopSettings(gains=replace(GAINS, i=-1.0)))
    with pytest.raises(ValueError, match="i is -1"):
        WheelController(SETTINGS).check(bad)
    given = WheelController(bad)  # bad settings, but given at the start
    given.check(replace(bad, fault_retry=9.0))
    with pytest.raises(ValueError, match="i is -2"):
        given.check(replace(bad, loop=LoopSettings(gains=replace(GAINS, i=-2.0))))


def test_expected_speed_in_saturation_follows_from_feed_forward():
    # (12 - 0.5)/2 = 5.75 rad/s; the tolerated error is 2.875 + 0.3.
    gains = replace(GAINS, p=9.0, feedforward_velocity=2.0, feedforward_static=0.5)
    follow = replace(NO_FAULTS, tracking_time=0.75)
    known = replace(SETTINGS, loop=LoopSettings(gains=gains), faults=follow)
    for settings in (known, replace(SETTINGS, faults=follow)):
        for speed, fault in ((2.5, Fault.NOT_FOLLOWING), (2.65, None)):
            feed = Feed(settings)
            feed.wheel.configure(known)
            assert feed.hold(10.0, speed, 64) is fault


def test_new_parameters_clear_only_a_computation_fault():
    for fault in Fault:
        feed = Feed()
        feed.wheel.recovery.set(fault, feed.now)
        feed.wheel.configure(SETTINGS)
        assert feed.wheel.recovery.fault is (None if fault is Fault.COMPUTATION else fault)
    assert WheelController(replace(SETTINGS, fault_retry=7.0)).recovery.first_pause == 7.0


def test_hardware_incompatible_with_clamps_is_refused_without_effect():
    gains = replace(GAINS, u_clamp_min=6.0, u_clamp_max=8.0)
    wheel = WheelController(replace(SETTINGS, loop=LoopSettings(gains=gains)))
    with pytest.raises(ValueError, match="clamp"):
        wheel.set_hardware(Gearbox(1.0), Encoder(), 5.0)
    assert wheel.supply == math.inf
    assert WheelController(SETTINGS).advice == "" and WheelController(SETTINGS).output == 0.0


def test_advice_appears_with_known_rate_and_ends_with_new_gains():
    # At 1/64 s, with a sample of delay and of averaging, this p is unstable.
    model = MotorModel(dc_gain=1.0, time_constant=0.05)
    rough = replace(SETTINGS, loop=LoopSettings(gains=replace(GAINS, p=50.0), model=model))
    feed = Feed(rough)
    feed.wheel.set_hardware(Gearbox(1.0), Encoder(), 12.0)
    for k in range(1, 40):
        feed.give()
        feed.wheel.tick(feed.now)
        assert bool(feed.wheel.advice) is (k >= 20)
    assert "intervals of 15.6 ms" in feed.wheel.advice
    feed.wheel.configure(SETTINGS)
    assert feed.wheel.advice == ""


def test_computation_error_is_counted_and_is_a_fault_only_while_active():
    for active in (True, False):
        feed = Feed(active=active)
        feed.wheel.loop.speed = lambda *_: 1 // 0
        feed.ask(1.0)
        assert feed.give() == (0.0 if active else None)
        assert feed.wheel.refused == {"computation: ZeroDivisionError": 1}
        assert (feed.wheel.recovery.fault is Fault.COMPUTATION) is active
    feed = feed_with_setpoint(1.0)
    out = feed.wheel.loop.step(1.0, 0.0, DT)._replace(output=math.nan)
    feed.wheel.loop.step = lambda *_: out
    assert feed.give() == 0.0 and feed.wheel.refused == {"output that is not a number": 1}
