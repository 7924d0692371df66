# SPDX-License-Identifier: Apache-2.0
"""The sampled motor, its margins and its simulation, against simulators that share no code."""

import math

import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from smp_motor_control.pid import Pid, PidGains
from smp_motor_control.reference.minimum_jerk import MinimumJerk, Reference
from smp_motor_ident.tune.feedback import (
    Feedback,
    batch_margins,
    closed_loop,
    loop_margins,
    make_grid,
    spectral_radius,
)
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.motors import Motors
from smp_motor_ident.tune.plant import sample
from smp_motor_ident.tune.simulation import Controller, Inputs, simulate

# Motor 1 of the paper's Table 1, and a first-order motor.
MOTOR_1 = (0.039142, 0.0019981, 3.1755e-5)
FIRST_ORDER = (0.04, 0.002, 0.0)


def motors(a0: float, a1: float, a2: float, delay: float = 0.0) -> Motors:
    return Motors(*(np.array([x]) for x in (a0, a1, a2, delay, 0.0)))


def integrate(coefficients, delay, sample_time, inputs):
    """Return speed and angle at the sampling instants, by a general-purpose ODE solver."""
    a0, a1, a2 = coefficients

    def rates(t, x, volts):
        if a2 == 0:
            return [(volts - a0 * x[0]) / a1, 0.0, x[0]]
        return [x[1], (volts - a1 * x[1] - a0 * x[0]) / a2, x[0]]

    x, history = np.zeros(3), [np.zeros(3)]
    whole = int(delay // sample_time)
    late = delay - whole * sample_time
    for k in range(len(inputs)):
        older = inputs[k - whole - 1] if k - whole - 1 >= 0 else 0.0
        newer = inputs[k - whole] if k - whole >= 0 else 0.0
        for volts, length in ((older, late), (newer, sample_time - late)):
            if length > 0:
                run = solve_ivp(rates, (0, length), x, args=(volts,), rtol=1e-10, atol=1e-12)
                x = run.y[:, -1]
        history.append(x.copy())
    return np.array(history)[:, 0], np.array(history)[:, 2]


@pytest.mark.parametrize("coefficients", [MOTOR_1, FIRST_ORDER], ids=["second", "first"])
@pytest.mark.parametrize("delay", [0.0, 0.003, 0.01, 0.0275])
@pytest.mark.parametrize("window", [0, 1, 3])
def test_sampled_motor_with_any_delay_and_window_is_exact(coefficients, delay, window):
    T = 0.01
    rng = np.random.default_rng(1)
    inputs = rng.uniform(-12, 12, 25)
    speed, angle = integrate(coefficients, delay, T, inputs)
    plant = sample(
        motors(*coefficients), Loop(sample_time=T, delay=delay, difference_window=window)
    )
    # A pure feed-forward controller applies the inputs.
    run = simulate(plant, Controller(Feedback(0.0, 0.0)), Inputs(np.zeros(25), forward=inputs))
    # 1e-7 of the largest speed: the ODE solver's own tolerance, accumulated.
    np.testing.assert_allclose(run.speed[0], speed[:-1], atol=1e-7 * np.abs(speed).max())
    measured = speed.copy()
    if window:
        padded = np.concatenate([np.zeros(window), angle])
        measured = (padded[window:] - padded[:-window]) / (window * T)
    # The transfer function at a point outside the unit circle, where the sums converge.
    z = 2.5 * np.exp(0.7j)
    powers = z ** -np.arange(26.0)
    ratio = np.sum(measured * powers) / np.sum(inputs * powers[:-1])
    found = plant.transfer(np.array([z]))[0, 0]
    # 2.5^-25 = 1e-10 of the sum is cut off by the record's end, delays make a few powers less.
    assert abs(found - ratio) < 1e-6 * abs(ratio)


@pytest.mark.parametrize("window", [0, 1, 4])
def test_closed_loop_matrix_and_simulation_agree_on_the_decay(window):
    plant = sample(motors(*MOTOR_1), Loop(sample_time=0.005, delay=0.008, difference_window=window))
    feedback = Feedback(0.03, 0.9, 0.0008, 0.004)
    eigenvalues = np.linalg.eigvals(closed_loop(plant, feedback)[0])
    run = simulate(plant, Controller(feedback), Inputs(np.ones(400)))
    left = np.abs(run.speed[0] - 1)
    # Only the slowest mode remains after 100 samples; 3 % for the rest of the others.
    slope = (left[360:].max() / left[100:140].max()) ** (1 / 260)
    assert slope == pytest.approx(np.abs(eigenvalues).max(), rel=0.03)


def test_the_simulated_controller_equals_the_running_one():
    """The batch simulation against Pid itself, saturation and anti-windup included."""
    T, limit = 0.005, 4.5
    plant = sample(motors(*MOTOR_1), Loop(sample_time=T, delay=T))
    feedback = Feedback(0.05, 1.2, 0.0009, 0.003)
    controller = Controller(feedback, 0.6, 0.9, limit, 0.05)
    time = T * np.arange(300)
    change = MinimumJerk(Reference(0.0, 0.0, 0.0), 100.0, 0.1)
    reference, rate, _ = np.array([change.at(t) for t in time.tolist()]).T
    forward = 0.03 * reference + 0.001 * rate
    run = simulate(plant, controller, Inputs(reference, forward=forward))
    pid = Pid(
        PidGains(
            p=0.05, i=1.2, d=0.0009, u_clamp_min=-limit, u_clamp_max=limit,
            antiwindup_strategy="back_calculation", tracking_time_constant=0.05,
            setpoint_weight_p=0.6, setpoint_weight_d=0.9, derivative_filter_time_constant=0.003,
            feedforward_velocity=0.03, feedforward_acceleration=0.001,
        )
    )  # fmt: skip
    phi, taps = plant.phi[0], plant.taps[0]
    x, past, swept = np.zeros(2), np.zeros(taps.shape[0]), 0.0
    for k in range(time.size):
        out = pid.step(reference[k], swept / T, T, rate[k])
        assert out.output == pytest.approx(run.voltage[0, k], abs=1e-9)
        past = np.concatenate([[out.output], past[:-1]])
        swept = plant.phi_angle[0] @ x + plant.taps_angle[0] @ past
        x = phi @ x + past @ taps
    assert np.abs(run.voltage).max() == limit


def random_loop(rng):
    """Return a random loop: resonant, delayed by many samples, or as slow as its sampling."""
    T = 10 ** rng.uniform(-3, -1.7)
    gain, tau = 10 ** rng.uniform(-1, 1), T * 10 ** rng.uniform(0, 2)
    damping = rng.choice([rng.uniform(0.03, 0.2), rng.uniform(0.5, 3), np.inf])
    late = T * rng.choice([0.0, rng.uniform(0, 3), rng.uniform(3, 50)])
    plant = sample(
        motors(1 / gain, tau / gain, (tau / 2 / damping) ** 2 / gain),
        Loop(sample_time=T, delay=late, difference_window=int(rng.integers(0, 4))),
    )
    p = 10 ** rng.uniform(-1, 0.8) / gain
    kind = rng.integers(4)  # P, I, PI, PID
    i, d = p / tau * 10 ** rng.uniform(-1, 0.5), p * min(tau, 0.05) * rng.uniform(0, 1)
    return plant, Feedback(p * (kind != 1), i * (kind > 0), d * (kind > 2), T)


def test_margins_agree_with_python_control():
    rng = np.random.default_rng(0)
    several = beyond = nyquist = 0
    for _ in range(80):
        plant, feedback = random_loop(rng)
        omega = make_grid(plant, 2000)
        loop = plant.response(omega)[0] * feedback.response(omega, plant.sample_time)
        gain, phase, least, _, crossings, _ = control.stability_margins(
            control.FRD(loop, omega, smooth=True), returnall=True
        )
        # At Nyquist the response is real; whether python-control sees that rounding decides.
        ends = -1 / loop[-1].real
        gain = np.append(gain, ends if 1 < ends < 1e9 else np.inf)
        gain = gain[(gain > 1) & (gain < 1e9)]
        distance = min([*least, np.abs(1 + loop).min()])
        m = loop_margins(plant, feedback)
        # Relative error of python-control's spline through 2000 points, next to a resonance.
        near = dict(rel=1e-3, nan_ok=True)
        assert abs(m.phase) == pytest.approx(np.abs(phase).min(initial=np.inf), abs=0.05)
        assert m.gain == pytest.approx(gain.min(initial=np.inf), **near)
        assert m.sensitivity == pytest.approx(1 / distance, **near)
        assert m.crossover == pytest.approx(crossings.max() if crossings.size else np.nan, **near)
        lag = np.deg2rad(np.where(phase < 0, phase + 360, phase)) / crossings
        assert m.delay == pytest.approx(lag.min(initial=np.inf), **near)
        several += crossings.size > 1
        beyond += np.unwrap(np.angle(loop))[omega <= m.crossover].min(initial=0.0) < -1.1 * np.pi
        nyquist += gain.size > 0 and m.gain == pytest.approx(ends)
    assert min(several, beyond, nyquist) >= 3


def test_margins_on_a_coarse_frequency_grid_agree_with_exact_ones():
    rng, errors = np.random.default_rng(1), []
    while len(errors) < 100:
        plant, feedback = random_loop(rng)
        nominal, omega = loop_margins(plant, feedback), make_grid(plant, 400)
        if nominal.stable and nominal.sensitivity < 3:
            loop = plant.response(omega) * feedback.response(omega, plant.sample_time)
            batch, names = batch_margins(loop, omega), ("phase", "gain", "delay", "sensitivity")
            pairs = [(getattr(nominal, n), float(getattr(batch, n)[0])) for n in names]
            errors.append(max(0.0 if a == b else abs(b / a - 1) for a, b in pairs))
    # The grid of 400 points over three decades resolves a margin to about half a percent.
    assert np.quantile(errors, 0.95) < 5e-3
    assert max(errors) < 0.02  # where the curve nearly touches the unit circle


@pytest.mark.parametrize("sample_time", [0.01, 0.001])
def test_gain_and_delay_margin_are_where_the_loop_turns_unstable(sample_time):
    loop = Loop(sample_time=sample_time)
    plant = sample(motors(*MOTOR_1), loop)
    feedback = Feedback(0.02, 0.5, 0.0002, sample_time)
    margins = loop_margins(plant, feedback)
    for share, stable in ((0.99, True), (1.01, False)):
        scaled = feedback.scaled(1 + share * (margins.gain - 1))
        assert (spectral_radius(plant, scaled)[0] < 1) == stable
        later = Loop(sample_time=sample_time, delay=sample_time + share * margins.delay)
        assert (spectral_radius(sample(motors(*MOTOR_1), later), feedback)[0] < 1) == stable


@pytest.mark.parametrize("delay", [0.07, 0.09, 0.11, 0.13])
def test_delay_margin_is_correct_where_the_phase_lag_exceeds_180_deg(delay):
    # A resonance of damping 0.05 at 20 rad/s that an integral and a long delay cross again, with
    # phases between -180 and -540 deg: the loop is stable, and tolerates another 100 to 170 ms.
    resonant, feedback = motors(1.0, 2 * 0.05 / 20, 1 / 20**2), Feedback(0.0, 4.0)
    margins = loop_margins(sample(resonant, Loop(sample_time=0.005, delay=delay)), feedback)
    for share, stable in ((0.0, True), (0.99, True), (1.01, False)):
        later = Loop(sample_time=0.005, delay=delay + share * margins.delay)
        assert (spectral_radius(sample(resonant, later), feedback)[0] < 1) == stable


def test_a_batch_of_motors_equals_single_motors():
    rng = np.random.default_rng(2)
    a0, a1, a2 = (x * rng.uniform(0.5, 2, 20) for x in MOTOR_1)
    delay = rng.uniform(0, 0.02, 20)
    loop = Loop(sample_time=0.005, delay=0.004)
    feedback = Feedback(0.02, 0.4, 0.0003, 0.005)
    batch = spectral_radius(sample(Motors(a0, a1, a2, delay, np.zeros(20)), loop), feedback)
    single = [
        spectral_radius(sample(motors(*row), loop), feedback)[0]
        for row in zip(a0, a1, a2, delay, strict=True)
    ]
    # Rounding of the eigenvalue solver, larger for the longer state of the batch.
    np.testing.assert_allclose(batch, single, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "value"),
    [("sample_time", 0.0), ("delay", -1.0), ("supply_voltage", math.nan), ("gear_ratio", math.inf)],
)
def test_impossible_loop_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=name):
        Loop(**{name: value})
