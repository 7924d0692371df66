# SPDX-License-Identifier: Apache-2.0
"""The wheel loop: its speed source, the speeds it rejects, and the state kept under new settings.

Steps of 1/64 s make times exact; the tests compute speeds from counts.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from smp_motor_control.encoder import Encoder
from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.parameters import Gearbox, MotorModel
from smp_motor_control.motor.response import zero_order_hold
from smp_motor_control.observer import ObserverNoise
from smp_motor_control.pid import PidGains
from smp_motor_control.reference.profile import Drive, ProfileLimits
from smp_motor_control.wheel import loop as loops
from smp_motor_control.wheel.controller import WheelController, WheelSettings
from smp_motor_control.wheel.faults import FaultLimits
from smp_motor_control.wheel.loop import LoopSettings, WheelLoop

DT, RATIO = 1.0 / 64.0, 2.0
ENCODER = Encoder(64.0)
A_COUNT = 2.0 * math.pi / 64.0 / RATIO  # [rad] at the wheel
MODEL = MotorModel(dc_gain=25.0, time_constant=0.05)
LEARNING_SAMPLES = 20
"""Number of samples from which the observer learns the usual interval."""


def make(source: str, **changes: object) -> WheelLoop:
    settings = LoopSettings(speed_source=source, model=MODEL, difference_window=2)
    return WheelLoop(replace(settings, **changes), Gearbox(RATIO), ENCODER, 1.0)


def rest(loop: WheelLoop, samples: int, voltage: float = 0.0) -> list[str]:
    """Keep the wheel at rest; return the sources of its speeds."""
    sources = []
    for _ in range(samples):
        loop.speed(DT, 9.0, 0, voltage)
        sources.append(loop.source)
    return sources


def test_speed_source_requires_its_settings():
    assert LoopSettings().difference_window == 4
    for bad in ({"speed_source": "guess"}, {"difference_window": 0}, {"speed_source": "observer"}):
        with pytest.raises(ParameterError, match=next(iter(bad))):
            LoopSettings(**bad)
    LoopSettings(speed_source="observer", model=MODEL, difference_window=1)


def test_new_loop_has_zero_reference_and_uses_measured_speed():
    loop = make("observer")
    assert (loop.source, loop.reference) == ("measured", (0.0, 0.0, 0.0))
    unknown = WheelLoop(loop.settings)
    assert unknown.speed(DT, 1.25, 7, 3.0) == 1.25 and unknown.source == "measured"


def test_measured_speed_source_ignores_counts():
    loop = make("measured")
    assert [loop.speed(DT, 1.25, count, 3.0) for count in (0, 500, 7)] == [1.25] * 3
    assert loop.source == "measured"


def test_counts_are_differenced_over_the_elapsed_time_of_the_window():
    loop = make("difference")
    assert math.isnan(loop.speed(DT, 9.0, 1000, 0.0)) and loop.source == "difference"
    assert loop.speed(DT, 9.0, 1001, 0.0) == pytest.approx(A_COUNT / DT)
    assert loop.speed(3 * DT, 9.0, 1005, 0.0) == pytest.approx(5 * A_COUNT / (4 * DT))
    assert loop.speed(DT, 9.0, 1005, 0.0) == pytest.approx(4 * A_COUNT / (4 * DT))
    loop.reset_speed()
    assert math.isnan(loop.speed(DT, 9.0, 1005, 0.0))
    assert rest(make("difference"), 2 * LEARNING_SAMPLES) == ["difference"] * 2 * LEARNING_SAMPLES


def test_observer_starts_once_median_interval_is_known(monkeypatch):
    calls: list[tuple[object, ...]] = []
    real = loops.SpeedObserver
    monkeypatch.setattr(loops, "SpeedObserver", lambda *given: calls.append(given) or real(*given))
    loop = make("observer")
    for k in range(LEARNING_SAMPLES):  # nine of them shorter: the median is the longer
        loop.speed(DT if k < 9 else 2 * DT, 9.0, 0, 0.0)
        assert loop.source == "difference"
    assert calls == [(MODEL, 2 * DT, ENCODER, ObserverNoise(), 2, 1.0)]
    assert rest(loop, 3) == ["observer"] * 3
    loop.reset_speed()
    assert math.isnan(loop.speed(DT, 9.0, 500, 0.0)) and len(calls) == 1
    assert loop.speed(DT, 9.0, 500, 0.0) == 0.0 and loop.source == "observer"


def test_untrusted_observer_is_replaced_by_differenced_counts():
    loop = make("observer")
    sources = rest(loop, LEARNING_SAMPLES + 64, voltage=12.0)  # blocked: more load than 1 V
    assert sources[-1] == "difference (observer not trusted)"
    assert loop.speed(DT, 9.0, 0, 12.0) == 0.0
    # Another speed source has no observer and uses the given gains unchanged.
    gains = PidGains(p=3.0, i=20.0)
    loop.configure(replace(loop.settings, gains=gains, speed_source="measured", model=None))
    assert rest(loop, 1) == ["measured"] and loop.pid.gains == gains


@pytest.mark.parametrize(
    ("change", "anew"),
    [
        ({"gains": PidGains(p=2.0)}, "observer"),
        ({"transition_time": 1.0}, "observer"),
        ({"noise": ObserverNoise(load=2.0)}, "difference"),
        ({"model": replace(MODEL, dc_gain=30.0)}, "difference"),
        ({"difference_window": 3}, "difference"),
        ({"speed_source": "measured"}, "measured"),
    ],
)
def test_speed_source_restarts_when_its_settings_change(change, anew):
    loop = make("observer")
    rest(loop, LEARNING_SAMPLES + 1)
    loop.configure(replace(loop.settings, **change))
    assert rest(loop, 1) == [anew]
    if anew == "difference":  # and the observer learns the interval again
        assert rest(loop, LEARNING_SAMPLES)[-2:] == ["difference", "observer"]


def test_new_reference_limits_apply_from_next_set_point():
    slow, quick = (LoopSettings(limits=ProfileLimits(acceleration=a)) for a in (1.0, 4.0))
    changed, made = WheelLoop(slow), WheelLoop(quick)
    changed.configure(quick)
    for loop in (changed, made):
        loop.start(0.0)
        for _ in range(16):
            loop.step(9.0, 0.0, DT)
    # A quarter of a second at 4 rad/s^2.
    assert changed.reference == made.reference and made.reference.velocity == pytest.approx(1.0)


def test_reference_delay_shifts_the_reference_in_time():
    seen = []
    for samples in (2, 6):
        limits = ProfileLimits(acceleration=1.0)
        gains = PidGains(p=2.0)
        loop = WheelLoop(LoopSettings(gains=gains, limits=limits, reference_delay=samples * DT))
        loop.start(0.0)
        seen.append([])
        for _ in range(32):
            answer = loop.step(9.0, 0.0, DT)
            seen[-1].append(loop.reference.velocity)
            assert answer.output == 2.0 * loop.reference.velocity
    assert seen[1][4:] == pytest.approx(seen[0][:-4]) and seen[0][-1] > 0.25


@pytest.mark.parametrize(("target", "rest"), [(1.7323209436980074, 52), (1.931078245306091, 54)])
def test_friction_feed_forward_keeps_its_sign_until_transition_ends(target, rest):
    """At the end the reference's rate is a rounding error below zero, which is no reversal."""
    gains = PidGains(
        p=0.0, feedforward_static=0.5, feedforward_acceleration=1e-6, u_clamp_min=-9.0,
        u_clamp_max=9.0,
    )  # fmt: skip
    loop = WheelLoop(LoopSettings(gains=gains, transition_time=0.12, reference_delay=0.01))
    loop.start(0.0)
    volts = [loop.step(target * (k >= rest), 0.0, 0.01).output for k in range(rest + 20)]
    assert volts[:rest] == pytest.approx([0.0] * rest)
    # The acceleration feed-forward of the transition is some 10 uV.
    assert volts[rest + 2 :] == pytest.approx([0.5] * 18, abs=1e-4)


def test_reference_delay_change_starts_from_present_reference():
    for before, after in ((0.0, 8 * DT), (8 * DT, 0.0), (8 * DT, 4 * DT)):
        limits = ProfileLimits(acceleration=1.0)
        loop = WheelLoop(LoopSettings(limits=limits, reference_delay=before))
        loop.start(0.0)
        for _ in range(32):
            loop.step(9.0, 0.0, DT)
        then = loop.reference.velocity
        loop.configure(replace(loop.settings, reference_delay=after))
        loop.step(9.0, 0.0, DT)
        # At most the acceleration during the samples of the changed delay
        assert abs(loop.reference.velocity - then) <= 6 * DT


def simulate_clipped_wheel(
    clip: float, samples: int = 1500
) -> tuple[list[float], list[float], list[str]]:
    """Return speeds, voltages and sources of a step to 0.7 rad/s under clipped voltage [V].

    The gains are the largest for the observer at 5 kHz, which does not know the clip.
    """
    ratio, dt = 65.0, 2e-4
    model = MotorModel(dc_gain=2.4, time_constant=0.032, time_constant_product=8.7e-5)
    gains = PidGains(
        p=457.0, i=1e5, d=1.9, derivative_filter_time_constant=1.4e-4, u_clamp_min=-48.0,
        u_clamp_max=48.0, feedforward_velocity=ratio / 2.4, feedforward_acceleration=0.87,
        antiwindup_strategy="back_calculation", tracking_time_constant=4e-3,
    )  # fmt: skip
    settings = LoopSettings(
        gains=gains, transition_time=0.05, reference_delay=dt, reference_delay_uncertainty=9e-4,
        speed_source="observer", difference_window=4, model=model,
    )  # fmt: skip
    loop = WheelLoop(settings, Gearbox(ratio), Encoder(2000.0), 72.0)
    angle, command, state = 0.0, 0.0, np.zeros(2)
    held = zero_order_hold(2.4, 0.032, 8.7e-5, np.array([dt]))
    speeds, voltages, sources = [], [0.0, 0.0], []
    for k in range(samples):
        measured = loop.speed(dt, 0.0, math.floor(angle * 2000.0 / math.tau), voltages[-2])
        if measured == measured:
            command = loop.step(0.7 if k >= 2 * LEARNING_SAMPLES else 0.0, measured, dt).output
        voltages.append(command)
        drive = min(max(voltages[-2], -clip), clip)
        angle += float(held.angle_transition[0] @ state + held.angle_forced[0] * drive)
        state = held.transition[0] @ state + held.forced[0] * drive
        speeds.append(state[0] / ratio)
        sources.append(loop.source)
    return speeds, voltages, sources


@pytest.mark.parametrize("clip", [48.0, 21.0, 19.2])  # 18.96 V are 0.7 rad/s
def test_wheel_reaches_its_speed_without_oscillation_under_unknown_voltage_clip(clip):
    speeds, voltages, sources = simulate_clipped_wheel(clip)
    assert ("difference (observer not trusted)" in sources) == (clip < 48.0)
    assert speeds[-500:] == pytest.approx([0.7] * 500, rel=0.02)
    assert np.ptp(voltages[-500:]) < 0.2 * 48.0  # no bang-bang oscillation between both limits
    assert max(speeds) < 1.1 * 0.7


STEP = 0.01
GAINS = PidGains(p=2.0, feedforward_acceleration=2.0, u_clamp_min=-12.0, u_clamp_max=12.0)
DRIVE = Drive(top_speed=10.0, time_constant=0.2)  # 0.1 rad/s per sample at 12 V, from rest


def drive_with_readings(speeds, drive=DRIVE) -> tuple[WheelController, list[bool]]:
    """Feed a wheel with speed readings; return it and whether each reading was rejected."""
    quiet = FaultLimits(stall_time=0.0, runaway_time=0.0, tracking_time=0.0)
    wheel = WheelController(
        WheelSettings(loop=LoopSettings(gains=GAINS, drive=drive), faults=quiet)
    )
    wheel.set_hardware(Gearbox(1.0), Encoder(64.0), 12.0)
    wheel.activate(0.0)
    out = []
    quiet_before = [0.0] * 200
    for k, speed in enumerate([*quiet_before, *speeds], 1):
        now = k * STEP
        wheel.take_setpoint(0.0, now)
        sample = SimpleNamespace(voltage=0.0, current=np.nan, velocity=speed, encoder_count=0)
        answer = wheel.take_feedback(sample, round(1e9 * now), round(1e9 * now), now)
        wheel.tick(now)
        out.append(answer is None)
    return wheel, out[len(quiet_before) :]


def test_single_speed_jump_is_rejected_and_repeated_one_accepted():
    """A motor cannot change its speed by half of its top speed in a sample; a collision can."""
    for readings, out in (([4.9, 0.0], [False, False]), ([5.2, 0.2], [True, False]),
                          ([-9.0, -8.9, -8.9], [True, False, False])):  # fmt: skip
        wheel, left_out = drive_with_readings(readings)
        assert left_out == out
        assert wheel.refused["feedback speed that jumps"] == sum(out)


def test_outliers_in_one_percent_of_readings_are_all_rejected():
    readings = np.where(np.arange(3000) % 100 == 0, 8.0, 0.0)
    assert np.array_equal(drive_with_readings(readings)[1], readings > 0.0)


def test_moderate_speed_jumps_are_accepted_with_unknown_drive():
    assert not any(drive_with_readings([0.0, 5.2, 0.2, -9.0, 9.0], drive=None)[1])


@pytest.mark.parametrize("steps", [6.0, 11.0])
def test_coarsely_quantised_readings_are_accepted(steps):
    """Readings of zero or one count, as when counts are differenced over one sample."""
    rng = np.random.default_rng(1)
    wheel, left_out = drive_with_readings(steps * (rng.random(2000) < 0.3))
    assert np.mean(left_out) < 0.01
    assert not any(left_out[100:])


@pytest.mark.parametrize(("source", "window"), [("measured", 1), ("difference", 2)])
@pytest.mark.parametrize(("counts", "jumps"), [(1, 0), (3, 1)])
def test_single_counts_of_coarse_encoder_are_not_rejected(source, window, counts, jumps):
    """One of eight counts is 79 rad/s over one sample and 39 over two; top speed is 10."""
    quantum = 2 * np.pi / 8
    loop = LoopSettings(gains=GAINS, drive=DRIVE, speed_source=source, difference_window=window)
    wheel, count = WheelLoop(loop, Gearbox(1.0), Encoder(8.0)), 1
    for k in range(400):
        more = counts if k >= 200 and k % 50 == 0 else 0
        count += more
        wheel.speed(STEP, quantum * more / STEP, count, 0.0)
        if k == 200:
            assert wheel.jumps == jumps
    assert bool(wheel.jumps) == bool(jumps)
