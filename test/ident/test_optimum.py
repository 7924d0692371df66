"""The compiled passes against plain numpy and scipy: the same sums, the same least squares."""

from dataclasses import replace

import motors
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.signal import lfilter

from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation import prediction, shape_constraint
from smp_motor_ident.estimation.descent import first_noise
from smp_motor_ident.estimation.fit import Options, Start, solve
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.likelihood.noise import NoiseModel, proper, renewed, whitening
from smp_motor_ident.likelihood.normal_equations import cholesky_solve, damped_step, eliminate
from smp_motor_ident.likelihood.passes import gather
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.measurement import MEAN_SPEED
from smp_motor_ident.model.physical import from_physical
from smp_motor_ident.model.structures import FirstOrder, SecondOrder
from smp_motor_ident.record import Record

STEP = 2e-3


def reference(voltage, a0, a1, a2, drive0, speed0):
    """Return the speed by the matrix exponential and scipy's filter; drive0 = a1 w'(0)."""
    block = np.zeros((3, 3))
    block[0], block[1, 0] = [-a1 / a2, -a0 * a1 / a2, a1 / a2], 1 / a1
    e = expm(block * STEP)
    den = [1.0, -e[0, 0] - e[1, 1], e[0, 0] * e[1, 1] - e[0, 1] * e[1, 0]]
    forced = lfilter([e[1, 2], e[1, 0] * e[0, 2] - e[0, 0] * e[1, 2]], den, voltage[1:])
    free = np.zeros(len(voltage))
    free[:2] = speed0, e[1, 0] * drive0 + e[1, 1] * speed0 + den[1] * speed0
    return np.concatenate([[0.0], forced]) + lfilter([1.0], den, free)


def random_record(seed, n=3000, noise=0.5):
    """Return voltage and noisy speed of a random motor, in motion at the beginning."""
    rng = np.random.default_rng(seed)
    a0 = 10 ** rng.uniform(-2, -1)
    tau = 10 ** rng.uniform(-1.7, -0.5)
    a1, a2 = a0 * tau, a0 * tau**2 * 10 ** rng.uniform(-2, -0.3)
    voltage = np.repeat(rng.uniform(-10, 10, n // 20 + 1), 20)[:n]
    speed = reference(voltage, a0, a1, a2, rng.uniform(-1, 1), rng.uniform(-20, 20))
    speed = speed + noise * rng.standard_normal(n)
    record = Record("motor", STEP * np.arange(n), voltage, velocity=speed)
    return record, np.log([a0, a1, a2])


@pytest.mark.parametrize("seed", range(6))
def test_initial_fit_is_the_least_squares_optimum_that_scipy_finds_from_the_truth(seed):
    record, truth = random_record(seed)
    data = prepare([record], False)
    fit = initial_fit(data, SecondOrder(friction="none"), Options())

    weight = np.sqrt(data.known_initial[0, 0] * fit.noise[0, 0])  # of the winding at first

    def residual(x):
        missed = reference(record.voltage, *np.exp(x[:3]), *x[3:]) - data.output
        return np.append(missed, weight * x[3])

    start = np.concatenate([truth, [0.0, record.velocity[0]]])
    found = least_squares(residual, start, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    ours = np.concatenate([fit.z.array[:3], fit.initial[0, :2]])
    cost = (residual(ours) ** 2).sum()
    # A wide prior on the initial states and the last step cost less than 1e-12, measured.
    assert cost == pytest.approx(2 * found.cost, rel=1e-9)
    deviation = np.sqrt(np.diag(fit.covariance()))
    np.testing.assert_array_less(np.abs(fit.z.array[:3] - found.x[:3]), 1e-4 * deviation)


@pytest.mark.parametrize("seed", range(3))
def test_without_noise_the_initial_fit_returns_the_motor_itself(seed):
    record, truth = random_record(seed, noise=0.0)
    data = replace(prepare([record], False), output=record.velocity)  # not as a sensor reads it
    fit = initial_fit(data, SecondOrder(friction="none"), Options())
    # Rounding of speeds of 1e2 rad/s, summed over the record.
    np.testing.assert_allclose(fit.z.array[:3], truth, atol=1e-8)


@pytest.mark.parametrize("kind", ["speed", "angle"])
@pytest.mark.parametrize("extra", [{}, {"load": True}, {"own_load": True}, {"shape": True}])
@pytest.mark.parametrize("order", [1, 2])
def test_one_copy_of_the_motor_gives_the_sums_of_the_general_recursion(kind, extra, order):
    rng = np.random.default_rng(order)
    record = motors.record("rear_left", current=False, static_voltage=0.0, seconds=2.0)
    lost = record.velocity.copy()
    lost[40:47] = np.nan
    record = replace(record, velocity=lost)
    data = prepare([record, record.slice(90, 400)], False, kind=kind)
    structure = SecondOrder("none", **extra) if order == 2 else FirstOrder("none")
    z = from_physical(3.3, 0.064, 0.03, 1.4e-5, 5.5e-5)
    z = z.with_(ln_a1=z.ln_a1 + 0.1, load=0.2)
    initial = data.initial[:, :4] + rng.uniform(-1, 1, (2, 4))
    noise = np.diag([0.3, 1.0])
    z = structure.complete(z)
    fast = gather(data, structure, z, initial, NoiseModel(noise))
    # A bound on the residuals that none reaches sends the same through the general recursion.
    slow = gather(data, structure, z, initial, NoiseModel(noise, huber=1e9))
    for name in ("normal", "gradient", "cost", "spread", "scores"):
        a, b = getattr(fast, name), getattr(slow, name)
        # Two orders of summation of a thousand products each.
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10 * np.abs(b).max())
    np.testing.assert_array_equal(fast.owner, slow.owner)


def test_elimination_is_the_schur_complement():
    rng = np.random.default_rng(0)
    f, own, segments = 3, 2, 4
    factor = rng.standard_normal((segments, 20, f + own))
    normal = np.einsum("gni,gnj->gij", factor, factor)
    gradient = rng.standard_normal((segments, f + own))
    whole = np.zeros((f + segments * own, f + segments * own))
    right = np.zeros(f + segments * own)
    for g in range(segments):
        at = [*range(f), *range(f + g * own, f + (g + 1) * own)]
        whole[np.ix_(at, at)] += normal[g]
        right[at] += gradient[g]
    common, score = np.zeros((f, f)), np.zeros(f)
    step, gain = np.zeros((segments, own)), np.zeros((segments, own, f))
    no_scores = np.zeros((0, f + own)), np.zeros(0, dtype=np.int64)
    nothing = np.zeros((segments, own))  # neither moved nor known beforehand
    eliminate(normal, gradient, nothing, np.full(own, 1e-2), nothing, nothing, 10**9, common, score,
              step, gain, *no_scores)  # fmt: skip
    # The prior weighs 1e-11 of a segment's information here.
    expected = np.linalg.inv(np.linalg.inv(whole)[:f, :f])
    np.testing.assert_allclose(common, expected, rtol=1e-7)
    np.testing.assert_allclose(np.linalg.solve(common, score), np.linalg.solve(whole, right)[:f])


def test_a_column_of_which_only_rounding_is_left_counts_as_unknown():
    common, score = np.zeros((2, 2)), np.zeros(2)
    column = np.array([1.0, 2.0, 3.0])
    a = np.stack([np.array([1.0, -1.0, 2.0]), column, column])
    normal = (a @ a.T)[None]
    normal[0, 1, 1] -= 1e-15  # the second common column is the segment's own
    gradient = np.ones((1, 3))
    no_scores = np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    nothing = np.zeros((1, 1))
    eliminate(normal, gradient, nothing, np.full(1, 1e-2), nothing, nothing, 10**18, common, score,
              np.zeros((1, 1)), np.zeros((1, 1, 2)), *no_scores)  # fmt: skip
    assert common[1, 1] == 0.0 or common[1, 1] > 1e-12
    step, _ = damped_step(common, score, 1e-9, np.eye(12, 2), np.zeros(12),
                          np.full(12, -np.inf), np.full(12, np.inf))  # fmt: skip
    assert np.all(np.isfinite(step))


def test_a_descent_from_a_lag_that_shows_in_nothing_finds_the_one_that_there_is():
    record, truth = random_record(0)
    data = prepare([record], False)
    fit = initial_fit(data, SecondOrder(friction="none"), Options())
    far = fit.z.with_(ln_a0=fit.z.ln_a0 + 0.2).with_second_lag(1e-12)
    again = solve(data, fit.structure, replace(fit, z=fit.structure.complete(far)), Options())
    assert again.z.second_lag == pytest.approx(fit.z.second_lag, rel=1e-2)
    assert again.deviance == pytest.approx(fit.deviance, abs=0.1)


def test_what_shows_in_nothing_holds_no_step_back():
    normal, wanted = np.diag([4.0, 1e-8]), np.array([0.5, 1000.0])
    step, _ = damped_step(normal, normal @ wanted, 1e-9, np.eye(12, 2), np.zeros(12),
                          np.full(12, -np.inf), np.full(12, np.inf))  # fmt: skip
    assert step[0] == pytest.approx(0.5)
    assert 1.0 < step[1] < 10.0  # of e-folds


def test_a_singular_system_is_solved_without_what_it_does_not_tell():
    a, b = np.ones((2, 2)), np.ones((2, 1))
    cholesky_solve(a, b)
    np.testing.assert_allclose(b.ravel(), [1.0, 0.0])


def test_current_lost_at_every_other_sample_still_gives_the_motor():
    record = motors.record("rear_left", static_voltage=0.0, seconds=2.0)
    amps = record.current.copy()
    amps[::2] = np.nan
    thinned = replace(record, current=amps, velocity=None)
    noise = first_noise(prepare([thinned], True))
    assert np.all(np.isfinite(noise))
    found = estimate(thinned, "electromechanical")
    truth = motors.truth("rear_left", 0.0)
    # 10 mA of noise on 3 A, 600 readings: tenths of a percent.
    assert found.value("resistance") == pytest.approx(truth["resistance"], rel=0.01)


@pytest.mark.parametrize("window", [-0.1, 1e30])
def test_a_start_outside_the_bounds_is_taken_to_them(window):
    record, _ = random_record(1)
    data = prepare([record], False).measured_as(MEAN_SPEED)
    structure = SecondOrder(friction="none", window=True)
    z = Coordinates(*np.log([0.03, 1e-3, 1e-5])).with_(window=window, ln_te=1e4)
    fit = solve(data, structure, Start(z, data.initial, first_noise(data)), iterations=3)
    assert 0 < fit.z.window <= 2 * np.ptp(data.time)
    assert np.all(np.isfinite(fit.z.array))


@pytest.mark.parametrize("broken", [np.nan, np.inf, -1.0, 0.0])
def test_a_covariance_that_is_none_is_replaced_by_one_that_can_be(broken):
    fixed = proper(np.array([[1.0, 3.0], [3.0, broken]]))
    assert np.all(np.linalg.eigvalsh(fixed) > 0)
    w = whitening(fixed)[:, :2]
    np.testing.assert_allclose(w @ fixed @ w.T, np.eye(2), atol=1e-12)  # rounding


def test_a_covariance_whose_squares_overflow_is_whitened():
    huge = 1e160 * np.array([[1.0, 0.5], [0.5, 1.0]])
    w = whitening(huge)[:, :2]
    np.testing.assert_allclose(w @ huge @ w.T, np.eye(2), atol=1e-12)  # rounding


@pytest.mark.parametrize("current", [True, False])
def test_a_covariance_renewed_from_residuals_is_one_whatever_was_believed_before(current):
    believed = np.array([[1.0, 0.9], [0.9, 1.0]])
    spread = np.array([1e-6, 1e-6, 5e-7, 100.0, 100.0, 100.0])
    fresh = renewed(spread, believed, current)
    assert np.all(np.linalg.eigvalsh(fresh) > 0)
    assert np.all(np.isfinite(whitening(fresh)))


def test_information_of_a_motor_that_never_moves_is_finite():
    n = 400
    record = Record("motor", 0.01 * np.arange(n), np.zeros(n), velocity=np.zeros(n))
    data = prepare([record], False)
    structure = SecondOrder(friction="none", load=True)
    fit = initial_fit(
        prepare([random_record(0)[0]], False), SecondOrder(friction="none"), Options()
    )
    gain, step, covariance = prediction.predicted_decrease(
        data, replace(fit, initial=data.initial), structure
    )
    assert np.isfinite(gain)
    assert np.all(np.isfinite(step)) and np.all(np.isfinite(covariance))


@pytest.mark.parametrize("friction", ["none", "symmetric"])
@pytest.mark.parametrize("order", [1, 2])
def test_tabulated_propagators_of_jittered_stamps_are_the_exact_ones(order, friction):
    record = motors.record("rear_left", current=False, seconds=2.0, rate=1000.0)
    rng = np.random.default_rng(0)
    late = np.sort(record.time + 1e-3 * rng.uniform(-0.09, 0.09, len(record)))
    data = prepare([replace(record, time=late - late[0])], False, kind="speed")
    assert data.jittered > 0
    exact = replace(data)
    exact.__dict__["jittered"] = 0.0
    structure = (FirstOrder, SecondOrder)[order - 1](friction)
    z = structure.complete(from_physical(3.3, 0.064, 0.03, 1.4e-5, 5.5e-5, 2e-3))
    a, b = (gather(d, structure, z, data.initial) for d in (data, exact))
    # The polynomial is exact to 1e-13; sums cancel by some orders more.
    np.testing.assert_allclose(a.cost, b.cost, rtol=1e-9)
    np.testing.assert_allclose(a.normal, b.normal, rtol=1e-8, atol=1e-10 * np.abs(b.normal).max())


def test_a_step_that_runs_away_to_no_steady_voltage_has_the_edge_of_a_short_winding():
    z = Coordinates(ln_a0=-800.0, ln_a1=-5.0, ln_a2=-12.0, ln_te=-7.0)
    assert shape_constraint.edge(z, 0.95)[0] == pytest.approx(-7.0)  # a2/a1


@pytest.mark.parametrize("runaway", [{"ln_a1": 800.0}, {"ln_a2": -1600.0, "ln_a1": -790.0}])
def test_a_step_that_runs_away_reaches_no_edge(runaway):
    """A descent that is asked where one full step more would lead asks for lags beyond numbers."""
    with np.errstate(all="ignore"):
        z = Coordinates(ln_a0=-3.0, ln_a1=-5.0, ln_a2=-12.0, ln_te=-7.0).with_(**runaway)
        assert shape_constraint.edge(z, 0.95) is None
        assert shape_constraint.within(z).ln_a0 == -3.0
