"""The exact propagation against matrix exponentials and finite differences."""

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are

from smp_motor_control.motor.response import zero_order_hold
from smp_motor_ident.likelihood.noise import steady_gain
from smp_motor_ident.likelihood.propagator import WIDTH, first_order, second_order

# ln te, ln tm, K, be: overdamped, critical to rounding, oscillating, very stiff.
CASES = [
    (np.log(0.024), np.log(1.3e-3), 0.011, 0.028),
    (np.log(0.02), np.log(0.02 * 0.25), 0.0625 + 1e-13, 0.1875 - 1e-13),
    (np.log(0.05), np.log(1e-3), 0.05, 1e-4),
    (np.log(1e-5), np.log(1e-3), 0.03, 1e-3),
]


def row(h, p, order=2):
    out = np.zeros(WIDTH)
    if order == 2:
        second_order(out, h, np.exp(p[0]), np.exp(p[1]), p[2], p[3])
    else:
        first_order(out, h, np.exp(p[1]), p[2], p[3])
    return out


@pytest.mark.parametrize("p", CASES)
@pytest.mark.parametrize("h", [1e-4, 5e-3, 0.1])
def test_propagator_is_the_matrix_exponential(p, h):
    te, tm, k, be = np.exp(p[0]), np.exp(p[1]), p[2], p[3]
    m = np.zeros((5, 5))
    m[0], m[1], m[2, 1] = [-1 / te, -k / te, 0, 1 / te, 0], [1 / tm, -be / tm, 0, 0, -1 / tm], 1
    e = expm(m * h)
    expected = np.r_[e[0, :2], e[1, :2], e[2, :2], e[:3, 3], -e[:3, 4]]
    # Rounding of the double integral grows as 1/(h |A|)^2, here at most 1e7.
    np.testing.assert_allclose(row(h, p)[:12], expected, rtol=1e-8, atol=1e-13)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("p", CASES[:3])
def test_propagator_derivatives_are_those_of_finite_differences(p, order):
    h = 5e-3
    p = np.array(p)
    analytic = row(h, p, order)
    for m in range(2 - order, 4):  # first order has no te
        step = np.zeros(4)
        step[m] = 1e-5 if m < 2 else 1e-6
        numeric = (row(h, p + step, order) - row(h, p - step, order))[:12] / (2 * step[m])
        # Central differences lose five digits to rounding and curvature.
        scale = np.abs(numeric).max()
        np.testing.assert_allclose(
            analytic[12 * (m + 1) : 12 * (m + 2)], numeric, rtol=2e-4, atol=2e-6 * scale
        )


def test_steady_gain_solves_the_riccati_equation():
    te, tm, k, be, r, h, ratio, noise = 0.024, 1.3e-3, 0.011, 0.028, 12.9, 5e-3, 1e6, 2.0
    a = np.array([[-1 / te, -k / te, 0], [1 / tm, -be / tm, 0], [0, 1, 0]])
    block = np.zeros((6, 6))
    block[:3, :3], block[1, 4], block[3:, 3:] = -a, ratio, a.T
    e = expm(block * h)
    f = e[3:, 3:].T
    q = f @ e[:3, 3:]
    c, v = np.array([[0, 0, 1], [1 / r, 0, 0]]), np.diag([1, noise])
    p = solve_discrete_are(f.T, c.T, (q + q.T) / 2, v)
    s = c @ p @ c.T + v
    gain, innovation = steady_gain(te, tm, k, be, r, h, ratio, noise)
    # The noise over a step is gathered by quadrature, good to 1e-7 at this step.
    np.testing.assert_allclose(gain, p @ c.T @ np.linalg.inv(s), rtol=1e-6)
    np.testing.assert_allclose(innovation, s, rtol=1e-6)


def test_compiled_propagation_is_the_response_of_the_running_motor():
    rng = np.random.default_rng(4)
    for _ in range(200):
        electrical, mechanical = 10.0 ** rng.uniform(-4, -1.5), 10.0 ** rng.uniform(-2.5, 0)
        a0, share = 10.0 ** rng.uniform(-3, 0), rng.uniform(0, 0.8)
        h = 10.0 ** rng.uniform(-3.5, -1.5)
        te, be, tm = electrical, share * a0, mechanical * a0
        row = np.zeros(WIDTH)
        second_order(row, h, te, tm, a0 - be, be)
        tau, tp = (tm + te * be) / a0, te * tm / a0
        held = zero_order_hold(1.0 / a0, tau, tp, h)
        # q = tm w' + be w + F turns the states (q, w) into (w, w').
        turn = np.array([[0.0, 1.0], [1.0 / tm, -be / tm]])
        transition = np.linalg.inv(turn) @ held.transition[0] @ turn
        size = np.array([1.0, 1.0 / a0])  # of q and w under one volt
        # Rounding alone: 1e-16 over the smallest h/tau, 3e-4 and squared.
        same = dict(rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(row[:4].reshape(2, 2) / size[:, None] * size,
                                   transition / size[:, None] * size, **same)  # fmt: skip
        angle = held.angle_transition[0] @ turn
        np.testing.assert_allclose(row[4:6] * size / h * a0, angle * size / h * a0, **same)
        assert row[7] * a0 == pytest.approx(held.forced[0, 0] * a0, rel=1e-6, abs=1e-9)
        assert row[8] == pytest.approx(held.angle_forced[0], rel=1e-6, abs=1e-9 * h / a0)
