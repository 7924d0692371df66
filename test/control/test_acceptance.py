# SPDX-License-Identifier: Apache-2.0
"""Acceptance of gains: refusals with their reasons, and driving with accepted gains."""

import math
import random
from dataclasses import fields, replace

import numpy as np
import pytest

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
def test_gains_that_make_no_sense_are_refused_with_the_limit_and_by_how_much(gains, words):
    with pytest.raises(ParameterError, match=words):
        check(settings(**gains), WHEEL)


@pytest.mark.parametrize(
    "gains",
    [{}, {"p": 0.0, "i": 0.0}, {"p": 5.0}, {"feedforward_velocity": 0.0}, {"setpoint_weight_p": 0}],
)
def test_gains_that_drive_the_motor_are_accepted(gains):
    check(settings(**gains), WHEEL)
    check(settings(**gains))


QUIET = dict(i=0.0, feedforward_velocity=0.0, feedforward_acceleration=0.0)
"""A proportional action alone."""


def limit(dt: float, late: int = 1) -> float:
    """Return the largest p, alone on a motor of first order whose voltage acts so much later.

    By the test's own recursion: mean speed over a sample, as the hardware shows it.
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
def test_limit_of_stability_is_that_of_the_sampled_loop(delay, late):
    # Within 3 %: so near to the limit nothing grows visibly in the samples of the trial.
    largest, model = limit(0.005, late), replace(MODEL, delay=delay)
    check(replace(settings(p=0.97 * largest, **QUIET), model=model), WHEEL)
    with pytest.raises(ParameterError, match="unstable"):
        check(replace(settings(p=1.03 * largest, **QUIET), model=model), WHEEL)


def test_refusal_names_the_excess_and_the_interval():
    largest = limit(0.005)
    with pytest.raises(ParameterError, match=r"stable with [\d.]+ times these") as refused:
        check(settings(p=4 * largest, **QUIET), WHEEL)
    share = float(str(refused.value).split("stable with ")[1].split()[0])
    assert 0.25 - 1 / 32 - 0.01 < share < 0.26
    assert abs(32 * share - round(32 * share)) < 0.17  # five halvings, printed with two digits
    with pytest.raises(ParameterError, match="lower them by far"):
        check(settings(p=100 * largest, **QUIET), WHEEL)
    named = {1e-9: "0.1 ms", 0.02: "20 ms", 7.0: r"1e\+03 ms", math.nan: "1 ms"}
    for given, words in named.items():
        with pytest.raises(ParameterError, match=f"intervals of {words}"):
            check(settings(i=5e6), replace(WHEEL, sample_time=given))


def test_before_the_rate_is_known_one_of_the_usual_must_do():
    largest = limit_with_winding(0.001)
    check(settings(p=0.985 * largest, **QUIET), replace(WHEEL, sample_time=math.nan))
    with pytest.raises(ParameterError, match="unstable"):
        check(settings(p=1.03 * largest, **QUIET), replace(WHEEL, sample_time=math.nan))


def limit_with_winding(dt: float) -> float:
    """Return the largest p, where a motor of first order has a winding of a thousandth of its lag.

    The angle of a sample is that of ``tp w'' + tau w' + w = K u``, integrated once.
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
def test_feed_forward_of_another_motor_is_refused_with_its_speed(factor, static, reached):
    # Feed-forward alone for a fifth of the speed at 12 V less friction; at most those 12 V.
    given = settings(p=0.0, i=0.0, feedforward_velocity=factor * RATIO / GAIN,
                     feedforward_acceleration=0.0)  # fmt: skip
    model = replace(MODEL, static_voltage=static)
    with pytest.raises(ParameterError, match="times the set-point") as refused:
        check(replace(given, model=model), WHEEL)
    said = float(str(refused.value).split("reaches ")[1].split()[0])
    assert said == pytest.approx(reached, rel=0.01)
    if not static:  # a slow wheel's, too
        with pytest.raises(ParameterError, match=f"reaches {reached if factor < 5 else factor:g} "):
            check(replace(given, limits=ProfileLimits(velocity=0.01)), WHEEL)


def test_set_point_of_the_trial_is_a_fifth_of_the_range_of_clamps_and_12_v():
    double = dict(p=0.0, i=0.0, feedforward_acceleration=0.0)
    weak = settings(feedforward_velocity=2.1 * RATIO / GAIN, u_clamp_min=-3.0, u_clamp_max=5.0,
                    **double)  # fmt: skip
    with pytest.raises(ParameterError, match=r"reaches 2\.1 times"):  # of 0.6 V; 1.26 V of 5 V
        check(weak, WHEEL)
    strong = settings(feedforward_velocity=12.0 * RATIO / GAIN, u_clamp_min=-24.0,
                      u_clamp_max=24.0, **double)  # fmt: skip
    with pytest.raises(ParameterError, match="reaches 10 times"):  # 24 V, and 2.4 V are due
        check(strong, replace(WHEEL, supply=24.0))


def test_speed_that_is_differenced_over_many_samples_is_tried_with_its_delay():
    # A lag of half of 20 samples, in addition to the loop's 1.5, reduces the limit of p.
    largest = limit(0.005)
    counted = replace(WHEEL, encoder=Encoder(counts_per_revolution=4000.0))
    late = replace(settings(p=0.6 * largest, **QUIET), speed_source="difference")
    check(replace(late, difference_window=1), counted)
    with pytest.raises(ParameterError, match="times the set-point"):
        check(replace(late, difference_window=20), counted)


def test_slow_motor_is_looked_at_for_as_long_as_it_takes():
    # An integral alone on tau = 3 s, 0.1 s late, swings with a period of seconds: the largest i
    # is where the phase of 1/(s (1 + tau s)) e^(-D s) is -180 deg; delay, hold and mean included.
    tau, dt, delay = 3.0, 0.005, 0.1
    total = delay + 2 * dt
    low, high = 0.1, 10.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        beyond = math.atan(middle * tau) + middle * total > math.pi / 2
        low, high = (low, middle) if beyond else (middle, high)
    gain = low * math.hypot(1.0, low * tau) * RATIO / GAIN
    model = replace(MODEL, time_constant=tau, delay=delay)
    alone = dict(QUIET, p=0.0)
    check(replace(settings(**{**alone, "i": 0.85 * gain}), model=model), WHEEL)
    with pytest.raises(ParameterError, match="unstable"):
        check(replace(settings(**{**alone, "i": 1.1 * gain}), model=model), WHEEL)


def test_feed_forward_that_tells_the_motor_is_its_model():
    largest = limit(0.005)
    given = settings(p=0.7 * largest, i=0.0, setpoint_weight_p=0.0)
    check(replace(given, model=None), WHEEL)
    with pytest.raises(ParameterError, match="unstable"):
        check(replace(settings(p=1.1 * largest, i=0.0), model=None), WHEEL)
    small = settings(i=1e5, feedforward_velocity=0.5, feedforward_acceleration=0.025)
    with pytest.raises(ParameterError, match="unstable"):
        check(replace(small, model=None), WHEEL)


def test_arithmetic_that_fails_is_refused_in_words(monkeypatch):
    def fails(*_: object) -> None:
        raise np.linalg.LinAlgError("singular")

    monkeypatch.setattr("smp_motor_control.wheel.acceptance.WheelLoop", fails)
    with pytest.raises(ParameterError, match="cannot be computed with these parameters: singular"):
        check(LoopSettings(gains=GAINS))


def test_non_finite_output_is_refused_for_any_motor(monkeypatch):
    nothing = PidOutput(*[math.nan] * 6, False)
    monkeypatch.setattr(WheelLoop, "step", lambda *_: nothing)
    with pytest.raises(ParameterError, match="reaches nan times"):
        check(LoopSettings(gains=PidGains()))


def test_gains_without_a_motor_model_are_not_tested_for_stability():
    check(LoopSettings(gains=PidGains(p=1e5)))


def test_feed_forward_of_almost_twice_the_needed_voltage_is_accepted():
    check(settings(p=0.0, i=0.0, feedforward_velocity=1.95 * RATIO / GAIN,
                   feedforward_acceleration=0.0), WHEEL)  # fmt: skip


def test_motor_is_known_by_its_model_and_gearing_or_by_the_feed_forward():
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
def test_gains_beyond_any_supply_are_refused_and_those_at_the_border_are_not(name, least, most):
    bounded = PidGains(u_clamp_min=-SUPPLY, u_clamp_max=SUPPLY)
    for value in (least, most):
        check(LoopSettings(gains=replace(bounded, **{name: value})))
    outside = [(most * 1.25, most * 0.25), (least - 0.5, 0.5)]
    for value, beyond in outside[: 1 if name == "feedforward_static" else 2]:
        with pytest.raises(ParameterError, match=rf"{name} is .* beyond by ") as refused:
            check(LoopSettings(gains=replace(bounded, **{name: value})))
        assert float(str(refused.value).rsplit(" ", 1)[1]) == pytest.approx(beyond, rel=1e-5)


def test_gains_that_suit_a_faster_loop_alone_wait_for_its_rate():
    fast = settings(p=40.0, i=0.0)
    check(fast)
    check(fast, replace(WHEEL, sample_time=0.001))
    with pytest.raises(ParameterError, match="intervals of 20 ms"):
        check(fast, replace(WHEEL, sample_time=0.02))


def extreme(draw: random.Random, usual: float) -> float:
    """Return a number around a usual one, or one at the boundary of all numbers."""
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
    chosen = {k: extreme(draw, v) for k, v in usual.items() if draw.random() < 0.5}
    for name in ("u_clamp", "i_clamp"):
        if f"{name}_max" in chosen:
            chosen[f"{name}_min"] = -chosen[f"{name}_max"]
    gains = PidGains(**chosen, antiwindup_strategy=draw.choice(STRATEGIES))
    some = [f.name for f in fields(ObserverNoise)]
    noise = ObserverNoise(**{n: extreme(draw, 0.3) for n in some if draw.random() < 0.3})
    model = MODEL
    if draw.random() < 0.3:
        model = MotorModel(
            dc_gain=extreme(draw, GAIN),
            time_constant=extreme(draw, TAU),
            time_constant_product=extreme(draw, 8e-4),
            static_voltage=extreme(draw, 0.4),
            delay=extreme(draw, 0.005),
        )
    drive = None
    if draw.random() < 0.2:
        drive = Drive(top_speed=extreme(draw, 3.0), time_constant=extreme(draw, TAU),
                      time_constant_product=extreme(draw, 8e-4))  # fmt: skip
    limits = ProfileLimits()
    if draw.random() < 0.3:
        limits = ProfileLimits(acceleration=extreme(draw, 15.0), jerk=extreme(draw, 300.0))
    return LoopSettings(
        gains=gains, limits=limits, model=model, noise=noise, drive=drive,
        transition_time=draw.choice([0.0, 0.2, abs(extreme(draw, 0.2))]),
        reference_delay=draw.choice([0.0, 0.0075]),
        speed_source=draw.choice(SPEED_SOURCES),
        difference_window=draw.choice([1, 2, 4, 1000]),
    )  # fmt: skip


def exact_step(model: MotorModel, ratio: float, dt: float) -> np.ndarray:
    """Return the transition of (speed, its rate) over a sample of held voltage, by a series.

    ``tp w'' + tau w' + w = K u`` as a matrix exponential: scaled, 12 terms, squared again; a motor
    of first order has an electrical time constant of a thousandth of its own.
    """
    tau, tp = model.time_constant, model.time_constant_product
    tp = max(tp, 1e-3 * tau * tau)
    drift = dt * np.array([[0, 1, 0], [-1 / tp, -tau / tp, model.dc_gain / ratio / tp], [0, 0, 0]])
    halvings = max(0, math.ceil(math.log2(max(np.abs(drift).sum(1).max(), 1.0)))) + 3
    term = result = np.eye(3)
    for k in range(1, 13):
        term = term @ drift / 2.0**halvings / k
        result = result + term
    for _ in range(halvings):
        result = result @ result
    return result[:2]


def drives(given: LoopSettings, ratio: float) -> float:
    """Return the largest speed of the identified motor with accepted settings, in set-points."""
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
    """Yield the accepted ones of random settings, and the overshoot of each."""
    for _ in range(count):
        try:
            given = random_settings(draw)
            check(given, WHEEL)
        except ParameterError:
            continue
        yield given, drives(given, RATIO)


@pytest.mark.parametrize("seed", range(6))
def test_random_settings_are_refused_in_words_or_drive_no_faster_than_twice_the_set_point(seed):
    accepted = list(accepted_sets(random.Random(seed), 50))
    for given, share in accepted:
        # The full voltage gives five set-points; a quarter more than is accepted, as this motor
        # has no encoder, no jitter, and half a sample less of delay.
        assert share < 2.5, given
    assert accepted


def test_a_slow_integral_overshoots_for_long_and_is_stable():
    """A crossover of 5 rad/s, so that the motor's own four time constants end in the overshoot."""
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


def test_gains_for_a_filtered_speed_are_tried_behind_its_filter():
    motor = MotorModel(dc_gain=0.906, time_constant=0.059, static_voltage=0.16)
    gains = PidGains(
        p=3.545, i=33.2, d=0.188, u_clamp_min=-12.0, u_clamp_max=12.0,
        feedforward_velocity=1.104, feedforward_acceleration=0.0653,
    )  # fmt: skip
    circumstances = OperatingConditions(sample_time=0.01, supply=12.0, gearbox=Gearbox(1.0))
    check(LoopSettings(gains=gains, model=motor, reference_delay=0.205), circumstances)
    with pytest.raises(ParameterError, match="unstable"):
        check(LoopSettings(gains=gains, model=motor, reference_delay=0.01), circumstances)
