"""A single transient says how well it is explained, not only how noisy the rest of a record is."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from independent import simulate
from scipy.linalg import fractional_matrix_power

from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation.fit import Options, solve
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.estimation.transients import widened_by_pieces
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model.structures import FirstOrder, SecondOrder
from smp_motor_ident.record import Hardware, Record

GAIN, LAG, RATE, STEP = 20.0, 0.05, 1000.0, 8.0  # rad/s/V, s, Hz, V


def stepped(seed, uneven, often=False):
    """Return a step from rest of a motor that an unbalanced load helps and hinders."""
    rng = np.random.default_rng(seed)
    n, parts = 1500, 20
    h, w, angle = 1 / RATE / parts, 0.0, rng.uniform(0, 2 * np.pi)
    k = np.arange(n)
    volts = np.where(k > 100, STEP, 0.0)
    if often:
        volts = STEP * np.where(k // 100 % 2, 1.0, -1.0)
    speed = np.empty(n)
    for i in range(n):
        for _ in range(parts if i else 0):
            w += h * (GAIN * (volts[i] + uneven * np.cos(2 * angle) * (volts[i] != 0)) - w) / LAG
            angle += h * w
        speed[i] = w + 0.3 * rng.standard_normal()
    return Record("motor", k / RATE, volts, velocity=speed)


def fitted(record):
    """Return the fit of a free run: no torque noise stands for what the model lacks."""
    data = prepare([record], False)
    return data, free_run(data, initial_fit(data, FirstOrder(friction="none"), Options()))


def free_run(data, fit):
    return solve(data, fit.structure, replace(fit, noise_ratio=0.0))


def lag_of(fit):
    row = fit.structure.of_free(np.eye(12)[1] - np.eye(12)[0])
    return float(np.sqrt(row @ fit.conditional() @ row))


@pytest.mark.parametrize("seed", [1, 2, 4])
def test_a_step_alone_scatters_as_it_says(seed):
    """Against errors of 24 pieces that weigh alike, each by the root of its own leverage more."""
    data, fit = fitted(stepped(seed, 1.0))
    # Slopes of ``K u (1 - e^{-s})``, s = t / lag, by ln K and ln lag, and by the speed at first.
    since = np.maximum(data.time - 0.1, 0.0) / fit.z.time_constant
    rise = STEP * fit.z.dc_gain
    first = np.exp(-data.time / fit.z.time_constant)
    x = np.column_stack([rise * (1 - np.exp(-since)), -rise * since * np.exp(-since), first])
    known = np.linalg.inv(x.T @ x)
    left = data.output - x[:, 0] * (1 + 0 * since)
    left -= x @ (known @ x.T @ left)
    rest = x[:, :2] - np.outer(first, first @ x[:, :2]) / (first @ first)
    weight = np.cumsum(np.einsum("ni,ij,nj->n", rest, np.linalg.inv(rest.T @ rest), rest))
    cuts = [*np.searchsorted(weight, np.linspace(0, 2, 25)[:-1]), data.size]
    moves = []
    for a, b in pairwise(cuts):
        own = np.eye(b - a) - x[a:b] @ known @ x[a:b].T
        errors = fractional_matrix_power(own + 1e-9 * np.eye(b - a), -0.5) @ left[a:b]
        moves.append((known @ x[a:b].T @ errors)[1])
    alone = np.sqrt(23 / 24 * np.square(moves).sum())
    wider = lag_of(widened_by_pieces(data, fit))
    assert wider > 1.2 * lag_of(fit)
    # Neighbouring pieces err alike, which their squares alone do not show.
    assert 0.9 * alone < wider < 2.0 * alone


def test_friction_that_no_piece_tells_is_left_to_its_profile():
    """Of one level it trades with the gain: errors of pieces say nothing of that ridge."""
    data = prepare([stepped(1, 1.0)], False)
    fit = free_run(data, initial_fit(data, FirstOrder(friction="symmetric"), Options()))
    wide = widened_by_pieces(data, fit)
    at = fit.structure.free.index("vc_plus")
    assert wide.conditional()[at, at] == fit.conditional()[at, at]
    assert lag_of(wide) > 1.2 * lag_of(fit)


@pytest.mark.parametrize("uneven, often", [(0.0, False), (0.0, True), (0.3, True)])
def test_what_is_noise_or_comes_again_and_again_is_left_as_it_is(uneven, often):
    data, fit = fitted(stepped(5, uneven, often))
    assert lag_of(widened_by_pieces(data, fit)) < 1.05 * lag_of(fit)


@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_an_angle_known_finely_loses_nothing_where_a_direction_is_unknown(friction):
    """A winding of 20 us and the current at first, of which no row tells, move no other number.

    Beside them the gain is known to a millionth: a root of the covariance that is exact to a
    share of its largest element would hide it.
    """
    rng = np.random.default_rng(3)
    t = np.arange(2800) / 200.0
    volts = 4 * np.repeat([0.0, 3.0, 6.0, 4.0, 9.0, 2.0, 7.0], 400)
    R, K, J = 1.0, 0.2, 0.004
    motion = simulate(t, volts, R, 2e-5, K, J, 1e-3, friction, np.zeros(t.size), 500)
    angle = motion[:, 2] + 1e-5 * rng.standard_normal(t.size)
    data = prepare([Record("motor", t, volts, position=angle)], False)
    kind = "symmetric" if friction else "none"
    fit = free_run(data, initial_fit(data, SecondOrder(friction=kind, shape=True), Options()))
    before, after = (np.sqrt(np.diag(f.conditional())) for f in (fit, widened_by_pieces(data, fit)))
    assert before[0] < 1e-5  # of the gain, as sure as it is
    told = before < 0.05  # not L/R, which hangs on a row or two, or on none
    assert told[:3].all()
    assert np.all(after[told] < 2.5 * before[told])  # 24 pieces of chance
    # What no data tell is known as beforehand.
    assert friction or after[3] < 2.0 * before[3]


def test_a_direction_that_one_piece_alone_tells_says_nothing_of_its_errors():
    """Of a rest in which a load turns the motor by two counts, only that rest tells how fast."""
    R, L, K, J, B, TC, load = 8.5, 0.161, 0.0275, 1.487e-5, 1.429e-5, 7.36e-4, 8.83e-4
    t = np.arange(2200) / 500.0
    volts = np.where(t >= 0.36, 3.17, 0.0)
    motion = simulate(t, volts, R, L, K, J, B, TC, np.full(t.size, load), 20)
    count = np.floor(motion[:, 2] * 28 / (2 * np.pi) + 0.3).astype(np.int64)
    record = Record("motor", t, volts, count=count, hardware=Hardware(1.0, 28.0))
    found = estimate(record)
    lag = found.combinations["time_constant"]
    assert abs(lag.value - (R * J + L * B) / (R * B + K * K)) < 3 * lag.std < 0.5 * lag.value
    assert "disturbed" not in {f.code for f in found.findings}
