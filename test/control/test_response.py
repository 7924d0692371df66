# SPDX-License-Identifier: Apache-2.0
"""The exact response compared with the matrix exponential, from complex to fast real poles."""

import numpy as np
import pytest
from scipy.linalg import expm

from smp_motor_control.motor.response import zero_order_hold

GAIN, TAU = 20.0, 0.05
# tp / tau^2: oscillating, a double root, real roots, and L/R of 50 us and 50 ns.
SHARES = (30.0, 1.0, 0.25, 0.2, 1e-3, 1e-6)


def by_exponential(tau: float, tp: float, t: float) -> np.ndarray:
    """Return the transition of speed, acceleration, angle and voltage by a scaled exponential."""
    A = np.zeros((4, 4))
    A[0, 1], A[2, 0] = 1.0, 1.0
    A[1] = [-1.0 / tp, -tau / tp, 0.0, GAIN / tp]
    # Pieces short enough that the exponential loses no digits, then multiplied.
    pieces = 2 ** max(int(np.ceil(np.log2(max(t * tau / tp, 1.0)))), 0)
    return np.linalg.matrix_power(expm(A * t / pieces), pieces)


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("interval", [1e-4, 1e-3, 0.02])
def test_zero_order_hold_response_matches_matrix_exponential(share, interval):
    tp = share * TAU**2
    held = zero_order_hold(GAIN, TAU, tp, interval)
    truth = by_exponential(TAU, tp, interval)
    size = np.array([1.0, 1.0 / TAU])  # of speed and acceleration
    # Rounding: 1e-16 of each entry, times up to 2^20 products of the pieces of the truth.
    tolerance = 1e-9
    scaled = (held.transition[0] - truth[:2, :2]) / size[:, None] * size
    assert np.abs(scaled).max() < tolerance
    assert np.abs((held.forced[0] - truth[:2, 3]) / size).max() < tolerance * GAIN
    assert held.angle_transition[0] * size == pytest.approx(truth[2, :2] * size, abs=1e-11)
    assert held.angle_forced[0] == pytest.approx(truth[2, 3], abs=1e-10)


def test_fast_electrical_pole_reduces_to_first_order_response():
    # With L/R of 1 ns and 50 ms the two differ by their ratio, 2e-8.
    second = zero_order_hold(GAIN, TAU, 1e-9 * TAU, 0.05)
    first = zero_order_hold(GAIN, TAU, 0.0, 0.05)
    assert second.forced == pytest.approx(first.forced, rel=1e-7)
    assert second.angle_forced == pytest.approx(first.angle_forced, rel=1e-7)
    for values in second:
        assert np.all(np.isfinite(values))
