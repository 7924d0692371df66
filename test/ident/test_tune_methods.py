# SPDX-License-Identifier: Apache-2.0
"""Every tuning method: its published numbers, and its specification on the sampled loop."""

from dataclasses import replace

import numpy as np
import pytest

from smp_motor_ident.cli.relaying import read_oscillation, resample_evenly
from smp_motor_ident.errors import DesignError
from smp_motor_ident.tune.feedback import Feedback, closed_loop, loop_margins
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.methods import METHODS
from smp_motor_ident.tune.methods.margin import scale_to_sensitivity
from smp_motor_ident.tune.methods.rules import apply_rule
from smp_motor_ident.tune.motors import Motors
from smp_motor_ident.tune.plant import sample
from smp_motor_ident.tune.problem import FirstOrderDelay, Problem

# The paper's Table 1 as a0, a1, a2 [V s/rad and its powers].
PAPER = (
    (0.039142, 0.0019981, 3.1755e-5),
    (0.059399, 0.0025612, 2.5313e-5),
    (0.036147, 0.0016439, 2.9671e-5),
    (0.040251, 0.0017646, 2.5002e-5),
)


def problem(coefficients=PAPER[0], sample_time=0.005, **targets) -> Problem:
    motors = Motors(*(np.array([x]) for x in (*coefficients, 0.0, 0.0)))
    loop = Loop(sample_time=sample_time)
    return Problem(sample(motors, loop), loop, targets)


class Reduced(Problem):
    """A problem whose reduction is given, for numbers from the literature."""

    def __init__(self, model: FirstOrderDelay, **targets) -> None:
        base = problem()
        super().__init__(base.plant, base.loop, targets)
        object.__setattr__(self, "reduced", model)


def test_ziegler_nichols_and_tyreus_luyben_match_their_published_rules():
    assert apply_rule("ziegler_nichols", "pi", 2.0, 1.2) == Feedback(0.9, 0.9)
    pid = apply_rule("ziegler_nichols", "pid", 2.0, 1.0)
    assert (pid.p, pid.p / pid.i, pid.d / pid.p) == pytest.approx((1.2, 0.5, 0.125))
    pi = apply_rule("tyreus_luyben", "pi", 3.2, 1.0)
    assert (pi.p, pi.p / pi.i) == pytest.approx((1.0, 2.2))
    pid = apply_rule("tyreus_luyben", "pid", 2.2, 6.3)
    assert (pid.p, pid.p / pid.i, pid.d / pid.p) == pytest.approx((1.0, 2.2 * 6.3, 1.0))


def test_simc_reproduces_skogestads_example():
    # Process E1 of the SIMC paper, 1/((s+1)(0.2s+1)): half rule tau 1.1, theta 0.1, and with
    # tau_c = theta a PI controller of Kc 5.5 and tau_I 0.8.
    feedback = METHODS["simc"].solve(Reduced(FirstOrderDelay(1.0, 1.1, 0.1)))
    assert feedback.p == pytest.approx(5.5)
    assert feedback.p / feedback.i == pytest.approx(0.8)


def test_half_rule_keeps_the_sum_of_time_constants_and_delays():
    one = problem(PAPER[1], sample_time=0.001)
    a0, a1, _ = PAPER[1]
    # Delay of one sample, half a sample of hold and half of the difference: 2 ms.
    assert one.reduced.time_constant + one.reduced.delay == pytest.approx(a1 / a0 + 0.002)


def test_simc_cancels_the_pole_and_meets_the_closed_loop_time_constant():
    feedback = METHODS["simc"].solve(
        Reduced(FirstOrderDelay(2.0, 0.5, 0.1), closed_loop_time_constant=0.4)
    )
    assert feedback.p == pytest.approx(0.5 / (2.0 * 0.5))
    assert feedback.p / feedback.i == pytest.approx(0.5)


def test_ultimate_gain_is_where_proportional_control_turns_unstable():
    one = problem()
    gain, period = one.ultimate
    for share, stable in ((0.99, True), (1.01, False)):
        poles = np.abs(np.linalg.eigvals(closed_loop(one.plant, Feedback(share * gain, 0.0))[0]))
        # The idle integrator stays at 1.
        assert (np.sort(poles)[-2] < 1) == stable or (np.sort(poles)[-1] <= 1 + 1e-9) == stable
    assert period > 4 * one.loop.sample_time


def oscillate(problem, amplitude, hysteresis, seconds):
    """Run the sampled loop with a relay in place of the controller."""
    plant, count = problem.plant, problem.loop.count_angle
    T, window = plant.sample_time, plant.window
    steps = int(seconds / T)
    phi, taps = plant.phi[0], plant.taps[0]
    phi_angle, taps_angle = plant.phi_angle[0], plant.taps_angle[0]
    average = plant.average[0]
    x, past = np.zeros(phi.shape[0]), np.zeros(taps.shape[0])
    angle = np.zeros(window + 1)
    voltage, speed = np.empty(steps), np.empty(steps)
    output = amplitude
    for k in range(steps):
        if window:
            counted = np.floor(angle / count) * count if count else angle
            measured = -np.diff(counted) @ average
        else:
            measured = x[plant.sensor]
        if measured > hysteresis:
            output = -amplitude
        elif measured < -hysteresis:
            output = amplitude
        past[1:], past[0] = past[:-1].copy(), output
        angle[1:], angle[0] = angle[:-1].copy(), angle[0] + phi_angle @ x + taps_angle @ past
        x = phi @ x + past @ taps
        voltage[k], speed[k] = output, measured
    return voltage, speed


@pytest.mark.parametrize("coefficients", PAPER)
def test_relay_feedback_finds_the_ultimate_point_without_a_model(coefficients):
    one = problem(coefficients)
    quantum = one.loop.count_angle / one.loop.sample_time
    voltage, speed = oscillate(one, 3.0, quantum, 4.0)
    gain, period = read_oscillation([(voltage, speed)], one.loop.sample_time)
    # The result is a point of the loop's own response; counts of a tenth of the amplitude cause
    # an error below 1 %.
    w = 2 * np.pi / period
    response = one.plant.response(np.array([w]))[0, 0]
    assert gain * abs(response) == pytest.approx(1.0, rel=0.02)
    # A relay oscillates where the phase is short of half a turn by the effect of the hysteresis
    # (Astrom and Hagglund 1984, equation 5), to the resolution of one sample.
    short = np.arcsin(min(quantum * gain * np.pi / (4 * 3.0), 1.0))
    assert abs(np.angle(-response) - short) <= w * one.loop.sample_time
    assert np.abs(voltage).max() == 3.0


def test_relay_feedback_tolerates_lost_samples():
    one = problem(PAPER[3])
    voltage, speed = oscillate(one, 3.0, one.loop.count_angle / 0.005, 4.0)
    time = 0.005 * np.arange(voltage.size)
    acted = np.roll(voltage, 2)  # reported voltage: one sample of delay, one of holding
    kept = np.random.default_rng(4).uniform(size=time.size) > 0.05
    answer = {
        "time": time[kept].tolist(),
        "voltage": np.roll(voltage, 1)[kept].tolist(),  # commanded before the sample
        "applied": acted[kept].tolist(),
        "speed": speed[kept].tolist(),
        "angle": (0.005 * np.cumsum(speed))[kept].tolist(),
    }
    gain, period = read_oscillation(*resample_evenly(answer))
    whole = read_oscillation([(voltage, speed)], 0.005)
    # One sample of twenty is a straight line between its neighbours, a twelfth of a period apart.
    assert (gain, period) == pytest.approx(whole, rel=0.05)
    # Without the applied voltage the commanded one gives nearly the same.
    asked = read_oscillation(*resample_evenly({**answer, "applied": [np.nan] * kept.sum()}))
    assert asked == pytest.approx(whole, rel=0.05)


def test_relay_oscillation_is_evaluated_between_gaps_in_the_samples():
    one = problem(PAPER[3])
    voltage, speed = oscillate(one, 3.0, one.loop.count_angle / 0.005, 4.0)
    period = read_oscillation([(voltage, speed)], 0.005)[1]
    time = 0.005 * np.arange(voltage.size)
    # Five cycles alternate with gaps of 0.4 cycles: no single stretch is long enough.
    kept = time % (5.4 * period) < 5 * period
    answer = {
        "time": time,
        "voltage": np.roll(voltage, 1),
        "applied": np.roll(voltage, 2),
        "speed": speed,
    }
    answer = {name: x[kept] for name, x in {**answer, "angle": 0.005 * np.cumsum(speed)}.items()}
    stretches, step = resample_evenly(answer)
    with pytest.raises(DesignError, match="steady cycles"):
        read_oscillation(stretches[:1], step)
    whole = read_oscillation([(voltage, speed)], 0.005)
    assert read_oscillation(stretches, step) == pytest.approx(whole, rel=0.02)


def test_relay_without_samples_or_oscillation_is_refused():
    with pytest.raises(DesignError, match="only 1 samples"):
        resample_evenly({key: [0.0] for key in ("time", "voltage", "applied", "speed", "angle")})
    with pytest.raises(DesignError, match="steady cycles"):
        read_oscillation([(np.ones(100), np.ones(100))], 0.005)


@pytest.mark.parametrize("coefficients", PAPER)
@pytest.mark.parametrize("sample_time", [0.01, 0.005, 0.001])
def test_margin_method_meets_phase_margin_sensitivity_and_noise_limits(coefficients, sample_time):
    one = problem(coefficients, sample_time)
    one = replace(one, loop=replace(one.loop, noise_voltage=one.loop.noise_limit))
    feedback = METHODS["margin"].solve(one)
    margins = loop_margins(one.plant, feedback)
    assert margins.stable
    # Search grid of 160 frequencies: half a percent.
    assert margins.phase >= 0.995 * 60
    assert margins.sensitivity <= 1.005 * 1.4
    assert one.control_noise(feedback) <= 1.005 * one.loop.noise_limit


@pytest.mark.parametrize("coefficients", PAPER)
@pytest.mark.parametrize("sample_time", [0.01, 0.005, 0.002, 0.001])
def test_margin_method_rejects_loads_no_worse_than_simc(coefficients, sample_time):
    one = problem(coefficients, sample_time)
    feedback = METHODS["margin"].solve(one)
    peak = loop_margins(one.plant, feedback).sensitivity
    simc = scale_to_sensitivity(one, METHODS["simc"].solve(one), peak)
    # The scale goes in steps of 1 %.
    assert feedback.i >= 1.01 * simc.i


def test_margin_method_limits_speed_noise_from_coarse_counts():
    # A light motor with 24 counts a turn: without the limit they would move it three times as far.
    one = problem((1 / 34.0, 0.01 / 34.0, 0.019 * 0.01**2 / 34.0), 0.01)
    loop = replace(one.loop, counts_per_revolution=24.0, noise_voltage=2.0)
    one = Problem(one.plant, loop)
    feedback = METHODS["margin"].solve(one)
    omega, T = one.omega, 0.01
    control = feedback.response(omega, T)
    through = np.abs(control * one.true_response / (1 + control * one.response)) ** 2
    speed_noise_factor = np.sqrt(np.trapezoid(through * one.noise, omega) / omega[-1])
    # Four times that is 2 % of half the top speed.
    assert speed_noise_factor <= 2.5e-3 * 12 * 34.0 * 1.01


def speed_noise_factor(one, feedback) -> float:
    """Return the speed noise relative to its default limit."""
    through = feedback.response(one.omega, one.loop.sample_time)
    through = through * one.true_response / (1 + through * one.response)
    top = one.loop.supply_voltage / one.plant.motors.a0[0]
    return float(one.noise_rms(through) / (2.5e-3 * top))


def test_speed_noise_limit_is_relaxed_to_keep_load_rejection():
    """With 7 % of speed noise its limit alone would leave 32 mV of the 480 mV allowed."""
    one = problem((1 / 114.0, 0.2 / 114.0, 0.0), 0.018)
    loop = replace(one.loop, counts_per_revolution=None, difference_window=0, speed_noise=90.0)
    strict = Problem(sample(one.plant.motors, loop), replace(loop, noise_voltage=loop.noise_limit))
    still, found = (METHODS["margin"].solve(p) for p in (strict, replace(strict, loop=loop)))
    assert speed_noise_factor(strict, still) <= 1.0
    # Speed noise of a slow loop grows with the root of its bandwidth: 1.2^8 squared is 18.
    assert found.i > 10 * still.i
    assert strict.control_noise(found) <= loop.noise_limit
    margins = loop_margins(strict.plant, found)
    assert margins.phase >= 59.9 and margins.sensitivity <= 1.4
    assert speed_noise_factor(strict, found) <= 1.2**8


def test_speed_noise_stays_at_its_default_limit_if_gains_match_simc():
    one = problem((1 / 34.0, 0.01 / 34.0, 0.019 * 0.01**2 / 34.0), 0.01)
    one = Problem(one.plant, replace(one.loop, counts_per_revolution=24.0))
    assert speed_noise_factor(one, METHODS["margin"].solve(one)) <= 1.0


def test_margin_method_rejects_a_load_better_than_a_grid_of_pi_gains():
    """No PI controller of a dense grid that keeps the same limits has more integral gain."""
    one = problem(structure="pi")
    best = METHODS["margin"].solve(one)
    for p in best.p * np.linspace(0.3, 1.7, 15):
        feedback = Feedback(float(p), 1.03 * best.i)
        m = loop_margins(one.plant, feedback)
        loop = one.response * feedback.response(one.omega, 0.005)
        hump = np.abs(loop / (1 + loop)).max()
        assert m.phase < 60 or m.sensitivity > 1.4 or hump > 1.25 or not m.stable


def test_feasible_bandwidth_is_met():
    one = problem(bandwidth=15.0)
    margins = loop_margins(one.plant, METHODS["margin"].solve(one))
    assert margins.crossover == pytest.approx(15.0, rel=1e-3)


@pytest.mark.parametrize("wished", [150.0, 5000.0])
def test_infeasible_bandwidth_is_refused_with_the_nearest_feasible_one(wished):
    with pytest.raises(DesignError, match="the nearest that holds is") as refusal:
        METHODS["margin"].solve(problem(bandwidth=wished))
    words = str(refusal.value).split()
    nearest = float(words[words.index("is") + 1])
    again = problem(bandwidth=0.999 * nearest)
    assert loop_margins(again.plant, METHODS["margin"].solve(again)).phase >= 59.5


def test_focus_trades_load_rejection_for_a_flat_response():
    gains = {
        focus: METHODS["margin"].solve(problem(focus=focus))
        for focus in ("load", "balanced", "tracking")
    }
    assert gains["load"].i >= gains["balanced"].i >= gains["tracking"].i


@pytest.mark.parametrize("name", list(METHODS))
def test_every_method_names_its_source(name):
    method = METHODS[name]
    assert any(character.isdigit() for character in method.source)
    assert method.title
