# SPDX-License-Identifier: Apache-2.0
"""Gains tolerate the unmodelled dynamics that a recording does not exclude."""

from dataclasses import replace

import control
import drives
import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from smp_motor_ident.errors import DesignError
from smp_motor_ident.result import Estimate, ModelError, ResidualTests
from smp_motor_ident.tune import METHODS, Loop, design
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.motors import make_motors
from smp_motor_ident.tune.plant import sample
from smp_motor_ident.tune.problem import Problem
from smp_motor_ident.tune.specification import band
from smp_motor_ident.tune.unmodelled import (
    UnmodelledDynamics,
    compute_resonance_effect,
    unmodelled_dynamics,
)
from smp_motor_ident.tune.writing import gains_document

LOOP = Loop(sample_time=0.005, delay=0.005, gear_ratio=1.0, counts_per_revolution=None)
FREQUENCY = (0.5, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 600.0)


def estimate(shown, bound) -> Estimate:
    one = drives.estimate(std=0.002, time_constant_product=1e-4, static_voltage=0.2)
    return replace(one, residuals=ResidualTests(model_error=ModelError(FREQUENCY, shown, bound)))


def known_up_to(frequency: float) -> Estimate:
    bound = tuple(0.05 if f <= frequency else 50.0 for f in FREQUENCY)
    return estimate(tuple(0.01 if b < 1 else 5.0 for b in bound), bound)


def sensitivity(one, omega):
    """Return the complementary sensitivity, computed by python-control."""
    T = one.loop.sample_time
    gain, tau, tp = (one.motor[n] for n in ("dc_gain", "time_constant", "time_constant_product"))
    z = control.tf([1, 0], [1], T)
    plant = control.sample_system(control.tf([gain], [tp, tau, 1]), T, "zoh") / z
    keep = one.gains.derivative_filter_time_constant
    keep /= keep + T
    pid = (
        one.gains.p
        + one.gains.i * T / (z - 1)
        + one.gains.d * (1 - keep) * (z - 1) / T / (z - keep)
    )
    loop = control.frequency_response(plant * pid, omega).frdata[0, 0]
    return np.abs(loop / (1 + loop))


def test_loop_bandwidth_stays_within_the_excited_band():
    loop = replace(LOOP, difference_window=0)
    free, held = (design(known_up_to(f), loop) for f in (600.0, 5.0))
    omega = np.geomspace(10.0, 600.0, 100)
    assert sensitivity(free, omega).max() > 0.6
    # Above 10 rad/s nothing is known, and a relative error of 2 is assumed.
    assert sensitivity(held, omega).max() < 0.51
    assert held.robustness.unmodelled == pytest.approx(1.0, abs=0.03)
    assert "unmodelled_dynamics" in [f.code for f in held.findings]
    assert "unmodelled_dynamics" not in [f.code for f in free.findings]
    assert "10 rad/s" in held.reason


@pytest.mark.parametrize("method", sorted(METHODS))
def test_loop_bandwidth_of_every_method_stays_within_the_excited_band(method):
    held = design(known_up_to(20.0), replace(LOOP, difference_window=0), method)
    assert sensitivity(held, np.geomspace(50.0, 600.0, 100)).max() < 0.51


def test_significant_model_error_limits_the_loop_gain_at_its_frequency():
    # A resonance of ten times the response: stable for every phase.
    bound = tuple(3.0 if f == 50.0 else 0.05 for f in FREQUENCY)
    shown = tuple(2.5 if b > 1 else 0.01 for b in bound)
    one = design(estimate(shown, bound), replace(LOOP, difference_window=0))
    assert sensitivity(one, np.array([50.0]))[0] < 0.101


def test_insignificant_model_error_is_capped_at_the_default_weight():
    bound = tuple(30.0 if f > 20 else 0.05 for f in FREQUENCY)
    weight = unmodelled_dynamics(estimate((0.01,) * len(FREQUENCY), bound)).weight
    assert weight(np.array([100.0])) == pytest.approx(2.0)
    assert weight(np.array([5.0])) == pytest.approx(0.05)
    assert weight(np.array([5000.0])) == pytest.approx(2.0)


def test_unexcited_low_frequencies_do_not_limit_the_integral_gain():
    """A sine does not excite below its frequency, where integral action needs the gain."""
    loop = replace(LOOP, difference_window=0)
    bound = tuple(50.0 if f < 10.0 else 0.05 for f in FREQUENCY)
    one = design(estimate(tuple(5.0 if b > 1 else 0.01 for b in bound), bound), loop)
    known = design(known_up_to(600.0), loop)
    assert one.gains.i == pytest.approx(known.gains.i, rel=1e-6)
    # A significant error counts: the response itself may vanish there.
    shown = tuple(20.0 if b > 1 else 0.01 for b in bound)
    bound = tuple(21.0 if b > 1 else b for b in bound)
    with pytest.raises(DesignError):
        design(estimate(shown, bound), loop)


def test_design_without_a_known_frequency_response_is_refused_with_the_reason():
    nothing = estimate((0.5,) * len(FREQUENCY), (5.0,) * len(FREQUENCY))
    with pytest.raises(DesignError, match=r"shows the motor's response up to 0\.5 rad/s"):
        design(nothing, LOOP)


def test_an_observer_tolerates_more_model_error_outside_its_feedback():
    # The observer's prediction from the voltage depends on the model only.
    loop = replace(LOOP, counts_per_revolution=500.0, speed_source="observer")
    motors = make_motors(known_up_to(20.0))
    plant = sample(motors, loop)
    omega = np.array([20.0, 300.0])
    z = np.exp(1j * omega * loop.sample_time)
    observer = plant.observer
    size = observer.by_angle.size
    predicted = [
        np.linalg.solve(x * np.eye(size) - observer.advance, observer.by_voltage)[1]
        * sum(share * x**-k for k, share in enumerate(observer.taps))
        for x in z
    ]
    through = plant.through_motor(omega)[0]
    assert through == pytest.approx(plant.response(omega)[0] - np.array(predicted))
    assert np.abs(through)[1] < 0.5 * np.abs(plant.response(omega)[0])[1]


def test_unmodelled_gain_is_the_peak_weighted_complementary_sensitivity():
    one, loop = known_up_to(20.0), replace(LOOP, difference_window=0)
    plant = sample(make_motors(one), loop)
    problem = Problem(plant, loop, {}, unmodelled_dynamics(one))
    feedback = Feedback(0.05, 0.5)
    C = feedback.response(problem.omega, loop.sample_time)
    L = plant.response(problem.omega)[0] * C
    weight = np.interp(np.log(problem.omega), np.log(FREQUENCY), [0.05] * 5 + [2.0] * 4, right=2.0)
    expected = np.max(np.abs(L / (1 + L)) * weight)
    assert problem.unmodelled_gain(feedback) == pytest.approx(expected)


def test_the_gains_file_states_the_tolerated_model_error():
    held = design(known_up_to(5.0), LOOP)
    entry = gains_document({"motor": held}, {}, "")["wheels"]["motor"]
    assert entry["robustness"]["unmodelled"] == held.robustness.unmodelled
    (found,) = (f for f in entry["findings"] if f["code"] == "unmodelled_dynamics")
    assert found["evidence"]["known_frequency"] == 10.0
    assert "pseudo-random" in found["advice"]


def simulate_resonance(reference, omega, T, damping):
    """Return the response of a resonance at the end of each sample of a held reference."""
    resonance = [omega**2], [1.0, 2 * damping * omega, omega**2]
    b, a, _ = cont2discrete(resonance, T)
    return lfilter(b.ravel()[1:], a, reference)


def minimum_jerk(T, duration, samples):
    s = np.clip(np.arange(samples) * T / duration, 0, 1)
    return 10 * s**3 - 15 * s**4 + 6 * s**5


def find_settling_time(y, T):
    return T * (np.flatnonzero(np.abs(y - 1) > 0.02)[-1] + 1)


def test_resonance_effect_matches_simulated_resonances():
    """Open loop, with resonances from 20 rad/s of practically unbounded model error."""
    T = 0.002
    reference = minimum_jerk(T, 0.2, 2500)
    unknown = UnmodelledDynamics(np.array([20.0, 1000.0]), np.array([1e3, 1e3]))
    plant = sample(
        make_motors(known_up_to(20.0)), replace(LOOP, sample_time=T, difference_window=0)
    )
    more, longer = compute_resonance_effect(unknown, plant, Feedback(0.0, 0.0), reference)
    behind = [
        simulate_resonance(reference, w, T, 0.05) for w in (20.0, 23.0, 27.0, 32.0, 40.0, 60.0)
    ]
    all_of_them = [*behind, *(2 * reference - y for y in behind)]
    # 2 %: loss between the tested frequencies and dampings.
    assert more == pytest.approx(max(y.max() for y in all_of_them) - 1, rel=0.02)
    slowest = max(find_settling_time(y, T) for y in all_of_them) - find_settling_time(reference, T)
    assert longer == pytest.approx(slowest, abs=np.pi / 20)  # half a swing


def simulate_tracking_loop(D, feedback, volts, T):
    """Return the speeds of G, open loop, and of G (1 + D), tracking it one step late."""
    s = control.tf([1, 0], [1])
    G = 25.0 / (1e-4 * s**2 + 0.05 * s + 1)
    expected, real = (control.ss(control.sample_system(g, T, "zoh")) for g in (G, G * (1 + D)))
    x0, x, integral, before = np.zeros(expected.nstates), np.zeros(real.nstates), 0.0, (0.0, 0.0)
    out = []
    for u in volts:
        y0, y = (expected.C @ x0).item(), (real.C @ x).item()
        out.append((y0, y))
        x0, x = (
            expected.A @ x0 + expected.B[:, 0] * before[0],
            (real.A @ x + real.B[:, 0] * (before[0] + before[1])),
        )
        before = u, feedback.p * (y0 - y) + integral
        integral += T * feedback.i * (y0 - y)
    return np.array(out).T


def test_resonances_within_the_error_bound_stay_within_the_stated_effect():
    loop, feedback = replace(LOOP, difference_window=0), Feedback(0.02, 0.3)
    T, s = loop.sample_time, control.tf([1, 0], [1])
    one = known_up_to(20.0)
    volts = minimum_jerk(T, 0.08, 400) / 25.0
    usual = simulate_tracking_loop(0 * s, feedback, volts, T)[0]
    plant = sample(make_motors(one), loop)
    more, longer = compute_resonance_effect(unmodelled_dynamics(one), plant, feedback, usual)
    omega = np.geomspace(0.5, np.pi / T, 2000)
    weight = np.interp(np.log(omega), np.log(FREQUENCY), [0.05] * 5 + [2.0] * 4, right=2.0)
    added, ends = [], []
    for at, damping in ((40.0, 0.05), (60.0, 0.05), (60.0, 0.2), (100.0, 0.05), (100.0, 0.2)):
        shape = s**2 / (s**2 + 2 * damping * at * s + at**2)
        m = np.min(weight / np.abs(control.frequency_response(shape, omega).frdata[0, 0]))
        for sign in (-1, 1):
            y = simulate_tracking_loop(sign * min(m, 1.0) * shape, feedback, volts, T)[1]
            added.append(y.max() - usual.max())
            ends.append(find_settling_time(y, T) - find_settling_time(usual, T))
    assert max(added) <= 1.02 * more
    assert max(added) > 0.7 * more
    assert max(ends) <= longer + np.pi / 40
    # Half of the value for an undamped resonance of the whole motor, where W is 2.
    turned = np.exp(-50j * T * np.arange(399))
    assert more < 0.5 * np.abs(turned @ np.diff(25.0 * volts))


def test_known_response_has_no_resonance_effect():
    plant, feedback = sample(make_motors(known_up_to(600.0)), LOOP), Feedback(0.02, 0.3)
    answer = minimum_jerk(0.005, 0.1, 100)
    assert compute_resonance_effect(None, plant, feedback, answer) == (0.0, 0.0)
    known = UnmodelledDynamics(np.array([1.0, 700.0]), np.array([0.01, 0.01]))
    assert compute_resonance_effect(known, plant, feedback, answer)[0] < 0.01


def test_bands_cover_an_undetected_resonance():
    loop = replace(LOOP, difference_window=0)
    least = design(known_up_to(600.0), loop).reference.transition_time
    free, held = (
        design(known_up_to(f), loop, transition_time=least).specification for f in (600.0, 20.0)
    )
    assert held.overshoot.high > free.overshoot.high + 2
    assert held.settling.high > free.settling.high


def test_unknown_dynamics_lengthen_the_transition_time():
    loop = replace(LOOP, difference_window=0)
    known, unknown = (design(known_up_to(f), loop) for f in (600.0, 20.0))
    most = unknown.specification
    assert most.overshoot.high < 2.5 and most.settling.high < 0.5
    quick = known.reference.transition_time
    assert quick < unknown.reference.transition_time
    quicker = design(known_up_to(20.0), loop, transition_time=quick).specification
    assert quicker.overshoot.high > 2 * most.overshoot.high
    assert 1.1 * quicker.settling.high >= most.settling.high


def test_band_excludes_less_than_1_percent_on_either_side():
    figures = np.random.default_rng(1).permutation(np.arange(1.0, 301.0))
    found = band(150.0, figures)
    for beyond in (figures > found.high, figures < found.low):
        assert 0 < np.mean(beyond) < 0.01
    assert band(500.0, figures).high == 500.0
    # A motor that never settles counts as the latest; three of 300 exceed 1 %.
    later = figures.copy()
    later[figures > 298] = np.nan
    assert band(150.0, later).high == 298.0
    assert band(150.0, later, 7.0).high == 305.0
    later[figures > 297] = np.nan
    assert np.isnan(band(150.0, later).high)
    assert np.isnan(band(np.nan, figures).high)


def test_unstated_settling_time_is_reported():
    noisy = replace(LOOP, speed_noise=30.0)
    one = design(known_up_to(600.0), noisy, "ziegler_nichols")
    assert np.isnan(one.specification.settling.high)
    assert "settling_unknown" in [f.code for f in one.findings]
    calm = design(known_up_to(600.0), LOOP)
    assert np.isfinite(calm.specification.settling.high)
    assert "settling_unknown" not in [f.code for f in calm.findings]
