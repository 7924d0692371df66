# SPDX-License-Identifier: Apache-2.0
"""Acceptance of gains: refusals with their reasons, and driving with accepted gains."""

import math
import random
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.linalg import expm

from smp_motor_control.encoder import Encoder
from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.parameters import Gearbox, MotorModel
from smp_motor_control.observer import ObserverNoise
from smp_motor_control.pid import STRATEGIES, PidGains, PidOutput
from smp_motor_control.reference.profile import Drive, ProfileLimits
from smp_motor_control.wheel.acceptance import OperatingConditions, check
from smp_motor_control.wheel.loop import SPEED_SOURCES, LoopSettings, WheelLoop

GAIN, TAU, RATIO, SUPPLY = 25.0, 0.05, 65.5, 12.0
MODEL = MotorModel(dc_gain=GAIN, time_constant=TAU)
GAINS = PidGains(
    p=2.0, i=60.0, u_clamp_min=-SUPPLY, u_clamp_max=SUPPLY, antiwindup_strategy="back_calculation",
    feedforward_velocity=RATIO / GAIN, feedforward_acceleration=RATIO / GAIN * TAU,
)  # fmt: skip
WHEEL = OperatingConditions(sample_time=0.005, supply=SUPPLY, gearbox=Gearbox(RATIO))


def settings(**gains: object) -> LoopSettings:
    return LoopSettings(gains=replace(GAINS, **gains), model=MODEL)


@pytest.mark.parametrize(
    ("gains", "words"),
    [
        ({"i": -100.0}, r"i is -100; it must be in \[0, 1e\+08\], and is beyond by 100"),
        ({"p": -1e-3}, "p is -0.001"),
        ({"setpoint_weight_p": 7.0}, r"setpoint_weight_p is 7; it must be in \[0, 1\], .* by 6"),
        ({"setpoint_weight_p": 1.7e308}, "setpoint_weight_p is 1.7e"),
        ({"setpoint_weight_d": -0.1}, "setpoint_weight_d is -0.1"),
        ({"feedforward_velocity": -1.0}, "feedforward_velocity is -1"),
        ({"feedforward_acceleration": -1.0}, "feedforward_acceleration is -1"),
        ({"p": 1e300}, "p is 1e"),
        ({"d": 1e300}, "d is 1e"),
        ({"p": 500.0}, "unstable on the motor's model at intervals of 5 ms; it is stable with"),
        ({"i": 1e5}, "unstable on the motor's model"),
        ({"d": 50.0}, "unstable on the motor's model"),
        ({"u_clamp_min": 13.0, "u_clamp_max": 14.0}, "u_clamp_m"),
    ],
)
def test_invalid_or_unstable_gains_are_refused_with_limit_and_excess(gains, words):
    with pytest.raises(ParameterError, match=words):
        check(settings(**gains), WHEEL)


@pytest.mark.parametrize(
    "gains",
    [{}, {"p": 0.0, "i": 0.0}, {"p": 5.0}, {"feedforward_velocity": 0.0}, {"setpoint_weight_p": 0}],
)
def test_stable_gains_are_accepted(gains):
    check(settings(**gains), WHEEL)
    check(settings(**gains))


P_ONLY = dict(i=0.0, feedforward_velocity=0.0, feedforward_acceleration=0.0)
"""Proportional action only."""


def largest_stable_p(dt: float, late: int = 1) -> float:
    """Return the largest stable p for a first-order motor with a delay of ``late`` samples.

    The test's own recursion, with the mean speed over a sample as measurement.
    """
    decay = math.exp(-dt / TAU)

    def grows(p: float) -> bool:
        speed, mean, held = 0.0, 0.0, [0.0] * late
        for _ in range(4000):
            held.append(p * (1.0 - mean))
            final = GAIN / RATIO * held.pop(0)
            before, speed = speed, final + (speed - final) * decay
            mean = final + (before - final) * TAU / dt * (1.0 - decay)
            if abs(mean) > 1e6:
                return True
        return False

    low, high = 0.1, 5000.0
    while high / low > 1.001:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if grows(middle) else (middle, high)
    return low


@pytest.mark.parametrize(("delay", "late"), [(0.0, 1), (0.005, 2), (0.006, 3), (0.01, 3)])
def test_stability_limit_matches_sampled_loop_with_delay(delay, late):
    # Within 3 %: closer to the limit, growth is not visible within the trial.
    largest, model = largest_stable_p(0.005, late), replace(MODEL, delay=delay)
    check(replace(settings(p=0.97 * largest, **P_ONLY), model=model), WHEEL)
    with pytest.raises(ParameterError, match="unstable"):
        check(replace(settings(p=1.03 * largest, **P_ONLY), model=model), WHEEL)


def test_refusal_states_stable_gain_ratio_and_sample_interval():
    largest = largest_stable_p(0.005)
    with pytest.raises(ParameterError, match=r"stable with [\d.]+ times these") as refused:
        check(settings(p=4 * largest, **P_ONLY), WHEEL)
    share = float(str(refused.value).split("stable with ")[1].split()[0])
    assert 0.25 - 1 / 32 - 0.01 < share < 0.26
    assert abs(32 * share - round(32 * share)) < 0.17  # five halvings, printed with two digits
    with pytest.raises(ParameterError, match="lower them by far"):
        check(settings(p=100 * largest, **P_ONLY), WHEEL)
    named = {1e-9: "0.1 ms", 0.02: "20 ms", 7.0: r"1e\+03 ms", math.nan: "1 ms"}
    for given, words in named.items():
        with pytest.raises(ParameterError, match=f"intervals of {words}"):
            check(settings(i=5e6), replace(WHEEL, sample_time=given))


def test_gains_must_be_stable_at_one_common_rate_while_rate_is_unknown():
    largest = largest_stable_p_with_inductance(0.001)
    check(settings(p=0.985 * largest, **P_ONLY), replace(WHEEL, sample_time=math.nan))
    with pytest.raises(ParameterError, match="unstable"):
        check(settings(p=1.03 * largest, **P_ONLY), replace(WHEEL, sample_time=math.nan))


def largest_stable_p_with_inductance(dt: float) -> float:
    """Return the largest stable p, with an electrical time constant of a thousandth of tau.

    The angle follows from ``tp w'' + tau w' + w = K u``, integrated once.
    """
    step, tp = exact_step(MODEL, RATIO, dt), 1e-3 * TAU * TAU
    low, high = 0.1, 5000.0
    while high / low > 1.0005:
        middle = math.sqrt(low * high)
        speed = rate = mean = held = 0.0
        for _ in range(8000):
            drive, held = held, middle * (1.0 - mean)
            before = TAU * speed + tp * rate
            speed, rate = (float(x) for x in step @ (speed, rate, drive))
            mean = GAIN / RATIO * drive - (TAU * speed + tp * rate - before) / dt
            if abs(mean) > 1e6:
                break
        low, high = (low, middle) if abs(mean) > 1e6 else (middle, high)
    return low


@pytest.mark.parametrize(
    ("factor", "static", "reached"),
    [(2.1, 0.0, 2.1), (6.0, 0.0, 5.0), (3.0, 1.0, (3.0 * 2.2 - 1.0) / 2.2)],
)
def test_excessive_feed_forward_is_refused_with_speed_it_reaches(factor, static, reached):
    # Feed-forward alone for a fifth of the speed at 12 V less friction; at most those 12 V.
    given = settings(p=0.0, i=0.0, feedforward_velocity=factor * RATIO / GAIN,
                     feedforward_acceleration=0.0)  # fmt: skip
    model = replace(MODEL, static_voltage=static)
    with pytest.raises(ParameterError, match="times the set-point") as refused:
        check(replace(given, model=model), WHEEL)
    said = float(str(refused.value).split("reaches ")[1].split()[0])
    assert said == pytest.approx(reached, rel=0.01)
    if not static:  # also with a low velocity limit
        with pytest.raises(ParameterError, match=f"reaches {reached if factor < 5 else factor:g} "):
            check(replace(given, limits=ProfileLimits(velocity=0.01)), WHEEL)


def test_trial_set_point_needs_a_fifth_of_smaller_clamp_limited_to_12_v():
    double = dict(p=0.0, i=0.0, feedforward_acceleration=0.0)
    weak = settings(feedforward_velocity=2.1 * RATIO / GAIN, u_clamp_min=-3.0, u_clamp_max=5.0,
                    **double)  # fmt: skip
    with pytest.raises(ParameterError, match=r"reaches 2\.1 times"):  # of 0.6 V; 1.26 V of 5 V
        check(weak, WHEEL)
    strong = settings(feedforward_velocity=12.0 * RATIO / GAIN, u_clamp_min=-24.0,
                      u_clamp_max=24.0, **double)  # fmt: skip
    with pytest.raises(ParameterError, match="reaches 10 times"):  # 24 V, and 2.4 V are due
        check(strong, replace(WHEEL, supply=24.0))


def test_trial_includes_delay_of_difference_window():
    # A lag of half of 20 samples, in addition to the loop's 1.5, reduces the limit of p.
    largest = largest_stable_p(0.005)
    counted = replace(WHEEL, encoder=Encoder(counts_per_revolution=4000.0))
    late = replace(settings(p=0.6 * largest, **P_ONLY), speed_source="difference")
    check(replace(late, difference_window=1), counted)
    with pytest.raises(ParameterError, match="times the set-point"):
        check(replace(late, difference_window=20), counted)


def test_trial_of_slow_motor_is_long_enough_to_show_instability():
    # Integral action on tau = 3 s with 0.1 s of delay oscillates with a period of seconds. At the
    # largest i the phase of 1/(s (1 + tau s)) e^(-D s), with hold and averaging, is -180 deg.
    tau, dt, delay = 3.0, 0.005, 0.1
    total = delay + 2 * dt
    low, high = 0.1, 10.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        beyond = math.atan(middle * tau) + middle * total > math.pi / 2
        low, high = (low, middle) if beyond else (middle, high)
    gain = low * math.hypot(1.0, low * tau) * RATIO / GAIN
    model = replace(MODEL, time_constant=tau, delay=delay)
    alone = dict(P_ONLY, p=0.0)
    check(replace(settings(**{**alone, "i": 0.85 * gain}), model=model), WHEEL)
    with pytest.raises(ParameterError, match="unstable"):
        check(replace(settings(**{**alone, "i": 1.1 * gain}), model=model), WHEEL)


def test_motor_model_is_derived_from_feed_forward_when_missing():
    largest = largest_stable_p(0.005)
    given = settings(p=0.7 * largest, i=0.0, setpoint_weight_p=0.0)
    check(replace(given, model=None), WHEEL)
    with pytest.raises(ParameterError, match="unstable"):
        check(replace(settings(p=1.1 * largest, i=0.0), model=None), WHEEL)
    small = settings(i=1e5, feedforward_velocity=0.5, feedforward_acceleration=0.025)
    with pytest.raises(ParameterError, match="unstable"):
        check(replace(small, model=None), WHEEL)


def test_numerical_failure_is_reported_as_parameter_error(monkeypatch):
    def fails(*_: object) -> None:
        raise np.linalg.LinAlgError("singular")

    monkeypatch.setattr("smp_motor_control.wheel.acceptance.WheelLoop", fails)
    with pytest.raises(ParameterError, match="cannot be computed with these parameters: singular"):
        check(LoopSettings(gains=GAINS))


def test_non_finite_output_is_refused_without_motor_model(monkeypatch):
    nothing = PidOutput(*[math.nan] * 6, False)
    monkeypatch.setattr(WheelLoop, "step", lambda *_: nothing)
    with pytest.raises(ParameterError, match="reaches nan times"):
        check(LoopSettings(gains=PidGains()))


def test_gains_without_a_motor_model_are_not_tested_for_stability():
    check(LoopSettings(gains=PidGains(p=1e5)))


def test_feed_forward_of_almost_twice_the_needed_voltage_is_accepted():
    check(settings(p=0.0, i=0.0, feedforward_velocity=1.95 * RATIO / GAIN,
                   feedforward_acceleration=0.0), WHEEL)  # fmt: skip


def test_stability_check_needs_model_and_gear_ratio_or_feed_forward():
    swinging, nobody = settings(i=1e5), replace(WHEEL, gearbox=None)
    known = [
        (swinging, WHEEL),
        (swinging, nobody),  # the gearing by feed-forward and model
        (replace(swinging, model=None), nobody),
        (replace(settings(i=1e5, feedforward_velocity=0.0)), WHEEL),
    ]
    for given, wheel in known:
        with pytest.raises(ParameterError, match="unstable"):
            check(given, wheel)
    with pytest.raises(ParameterError, match="unstable"):
        check(settings(i=1e5, feedforward_velocity=0.5), nobody)
    check(settings(i=1e5, feedforward_velocity=0.0), nobody)
    for absent in ("feedforward_velocity", "feedforward_acceleration"):
        check(replace(settings(i=1e5, **{absent: 0.0}), model=None), WHEEL)


@pytest.mark.parametrize(
    ("name", "least", "most"),
    [
        ("p", 0.0, 1e5), ("i", 0.0, 1e8), ("d", -1e5, 1e5), ("feedforward_static", 0.0, 1e5),
        ("feedforward_velocity", 0.0, 1e5), ("feedforward_acceleration", 0.0, 1e5),
        ("setpoint_weight_p", 0.0, 1.0), ("setpoint_weight_d", 0.0, 1.0),
    ],
)  # fmt: skip
def test_gain_bounds_are_inclusive_and_refusal_states_excess(name, least, most):
    bounded = PidGains(u_clamp_min=-SUPPLY, u_clamp_max=SUPPLY)
    for value in (least, most):
        check(LoopSettings(gains=replace(bounded, **{name: value})))
    outside = [(most * 1.25, most * 0.25), (least - 0.5, 0.5)]
    for value, beyond in outside[: 1 if name == "feedforward_static" else 2]:
        with pytest.raises(ParameterError, match=rf"{name} is .* beyond by ") as refused:
            check(LoopSettings(gains=replace(bounded, **{name: value})))
        assert float(str(refused.value).rsplit(" ", 1)[1]) == pytest.approx(beyond, rel=1e-5)


def test_gains_for_fast_loop_are_accepted_until_slow_rate_is_known():
    fast = settings(p=40.0, i=0.0)
    check(fast)
    check(fast, replace(WHEEL, sample_time=0.001))
    with pytest.raises(ParameterError, match="intervals of 20 ms"):
        check(fast, replace(WHEEL, sample_time=0.02))


def draw_extreme(draw: random.Random, usual: float) -> float:
    """Return a random number around a usual one, or an extreme floating-point number."""
    if draw.random() < 0.12:
        return draw.choice([0.0, 5e-324, 1e-300, 1.7e308, -1.7e308, 1e9, math.nan, math.inf])
    value = usual * 10.0 ** draw.gauss(0.0, 1.0)
    return -value if draw.random() < 0.03 else value


def random_settings(draw: random.Random) -> LoopSettings:
    usual = {
        "p": 2.0, "i": 60.0, "d": 0.02, "u_clamp_max": 12.0, "i_clamp_max": 12.0,
        "tracking_time_constant": 0.03, "error_deadband": 1e-3, "setpoint_weight_p": 0.5,
        "setpoint_weight_d": 0.2, "derivative_filter_time_constant": 0.005,
        "feedforward_static": 0.4, "feedforward_velocity": 2.6, "feedforward_acceleration": 0.1,
    }  # fmt: skip
    chosen = {k: draw_extreme(draw, v) for k, v in usual.items() if draw.random() < 0.5}
    for name in ("u_clamp", "i_clamp"):
        if f"{name}_max" in chosen:
            chosen[f"{name}_min"] = -chosen[f"{name}_max"]
    gains = PidGains(**chosen, antiwindup_strategy=draw.choice(STRATEGIES))
    some = [f.name for f in fields(ObserverNoise)]
    noise = ObserverNoise(**{n: draw_extreme(draw, 0.3) for n in some if draw.random() < 0.3})
    model = MODEL
    if draw.random() < 0.3:
        model = MotorModel(
            dc_gain=draw_extreme(draw, GAIN),
            time_constant=draw_extreme(draw, TAU),
            time_constant_product=draw_extreme(draw, 8e-4),
            static_voltage=draw_extreme(draw, 0.4),
            delay=draw_extreme(draw, 0.005),
        )
    drive = None
    if draw.random() < 0.2:
        drive = Drive(top_speed=draw_extreme(draw, 3.0), time_constant=draw_extreme(draw, TAU),
                      time_constant_product=draw_extreme(draw, 8e-4))  # fmt: skip
    limits = ProfileLimits()
    if draw.random() < 0.3:
        limits = ProfileLimits(
            acceleration=draw_extreme(draw, 15.0), jerk=draw_extreme(draw, 300.0)
        )
    return LoopSettings(
        gains=gains, limits=limits, model=model, noise=noise, drive=drive,
        transition_time=draw.choice([0.0, 0.2, abs(draw_extreme(draw, 0.2))]),
        reference_delay=draw.choice([0.0, 0.0075]),
        speed_source=draw.choice(SPEED_SOURCES),
        difference_window=draw.choice([1, 2, 4, 1000]),
    )  # fmt: skip


def exact_step(model: MotorModel, ratio: float, dt: float) -> np.ndarray:
    """Return the transition of speed and acceleration over one sample of held voltage.

    A first-order motor has an electrical time constant of a thousandth of its own.
    """
    tau, tp = model.time_constant, model.time_constant_product
    tp = max(tp, 1e-3 * tau * tau)
    drift = np.array([[0, 1, 0], [-1 / tp, -tau / tp, model.dc_gain / ratio / tp], [0, 0, 0]])
    return expm(dt * drift)[:2]


def simulate_overshoot(given: LoopSettings, ratio: float) -> float:
    """Return the peak speed of the motor under accepted settings, relative to the set-point."""
    model, dt = given.model, 0.005
    loop = WheelLoop(given.clamp_to_supply(SUPPLY))
    loop.start(0.0)
    with np.errstate(all="ignore"):
        step = exact_step(model, ratio, dt)
    target = 0.2 * model.dc_gain / ratio * SUPPLY
    speed = rate = held = farthest = 0.0
    for _ in range(300):
        drive, held = held, loop.step(target, speed, dt).output
        assert -SUPPLY <= held <= SUPPLY
        push = max(abs(drive) - model.static_voltage, 0.0)
        speed, rate = (float(x) for x in step @ (speed, rate, math.copysign(push, drive)))
        farthest = max(farthest, abs(speed))
    return farthest / target


def accepted_sets(draw: random.Random, count: int):
    """Yield accepted random settings with their relative peak speed."""
    for _ in range(count):
        try:
            given = random_settings(draw)
            check(given, WHEEL)
        except ParameterError:
            continue
        yield given, simulate_overshoot(given, RATIO)


@pytest.mark.parametrize("seed", range(6))
def test_random_settings_are_refused_or_stay_below_2_5_times_set_point(seed):
    accepted = list(accepted_sets(random.Random(seed), 50))
    for given, share in accepted:
        # The full voltage gives five set-points. The bound is a quarter above the accepted one:
        # this motor has no encoder, no jitter, and half a sample less of delay.
        assert share < 2.5, given
    assert accepted


def test_long_overshoot_of_slow_integral_is_not_taken_for_instability():
    """At a crossover of 5 rad/s, four motor time constants pass before the overshoot ends."""
    motor = MotorModel(dc_gain=0.2766, time_constant=0.0702, static_voltage=0.76)
    gains = PidGains(
        p=0.535, i=19.8, u_clamp_min=-24.0, u_clamp_max=24.0, feedforward_static=0.76,
        antiwindup_strategy="back_calculation", tracking_time_constant=0.027,
        feedforward_velocity=3.616, feedforward_acceleration=0.254,
    )  # fmt: skip
    slow = LoopSettings(gains=gains, model=motor, reference_delay=0.0015)
    circumstances = OperatingConditions(sample_time=1e-3, supply=24.0, gearbox=Gearbox(1.0))
    check(slow, circumstances)
    with pytest.raises(ParameterError, match="unstable"):
        check(replace(slow, gains=replace(gains, i=2e4)), circumstances)


def test_trial_includes_speed_filter_implied_by_reference_delay():
    motor = MotorModel(dc_gain=0.906, time_constant=0.059, static_voltage=0.16)
    gains = PidGains(
        p=3.545, i=33.2, d=0.188, u_clamp_min=-12.0, u_clamp_max=12.0,
        feedforward_velocity=1.104, feedforward_acceleration=0.0653,
    )  # fmt: skip
    circumstances = OperatingConditions(sample_time=0.01, supply=12.0, gearbox=Gearbox(1.0))
    check(LoopSettings(gains=gains, model=motor, reference_delay=0.205), circumstances)
    with pytest.raises(ParameterError, match="unstable"):
        check(LoopSettings(gains=gains, model=motor, reference_delay=0.01), circumstances)
