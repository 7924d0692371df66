"""A resonance between motor and encoder, found from simulated recordings of two inertias."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from smp_motor_ident.errors import InsufficientExcitationError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation import flexible_shaft
from smp_motor_ident.record import Hardware, Record

R, L, K, J, B = 2.0, 1e-3, 0.03, 1e-5, 1e-6
LOAD = 2e-5
COUNTS = 2000.0


def two_inertias(stiffness: float, damping: float, noise: float, seed: int) -> tuple[Record, float]:
    """Return counts at the far inertia, and the truth's resonance [rad/s]."""
    A = np.array([
        [-R / L, -K / L, 0.0, 0.0, 0.0],
        [K / J, -(B + damping) / J, damping / J, -stiffness / J, 0.0],
        [0.0, damping / LOAD, -(damping + B) / LOAD, stiffness / LOAD, 0.0],
        [0.0, 1.0, -1.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.0, 0.0],
    ])  # fmt: skip
    rng = np.random.default_rng(seed)
    step, n = 1e-3, 10_000
    time = step * np.arange(n)
    block = np.zeros((6, 6))
    block[:5, :5], block[0, 5] = A, 1.0 / L
    whole = expm(block * step)
    F, G = whole[:5, :5], whole[:5, 5]
    # A telegraph signal excites all frequencies up to half the sampling rate.
    voltage = 6.0 * np.repeat(np.sign(rng.normal(size=n // 4)), 4)
    x, angle = np.zeros(5), np.zeros(n)
    push = np.sqrt(step) * noise * rng.normal(size=n)
    for k in range(1, n):
        x = F @ x + G * voltage[k]
        x[1] += push[k] / J
        angle[k] = x[4]
    count = np.floor(angle * COUNTS / (2.0 * np.pi) + rng.uniform()).astype(np.int64)
    poles = np.linalg.eigvals(A[:4, :4])
    ringing = poles[np.argmax(np.abs(poles.imag))]
    record = Record(
        wheel="w", time=time, voltage=voltage, count=count,
        hardware=Hardware(counts_per_revolution=COUNTS),
    )  # fmt: skip
    return record, float(abs(ringing))


@pytest.mark.parametrize(("stiffness", "damping", "noise"), [(0.3, 1e-4, 0.0), (1.5, 3e-4, 2e-5)])
def test_resonance_is_found_within_one_percent(
    stiffness: float, damping: float, noise: float
) -> None:
    record, truth = two_inertias(stiffness, damping, noise, seed=int(10 * stiffness))
    found = estimate(record, "flexible_shaft")
    resonance = found.combinations["resonance_frequency"]
    assert found.model == "flexible_shaft"
    assert resonance.value == pytest.approx(truth, rel=0.01)  # what the redesign was to show
    assert resonance.std is not None
    assert abs(resonance.value - truth) < 4.0 * resonance.std + 1e-3 * truth
    gain = K / (K * K + R * 2.0 * B)
    assert found.value("dc_gain") == pytest.approx(gain, rel=0.02)


def test_a_rigid_motor_shows_no_resonance() -> None:
    # A shaft of which the resonance is ten times the sampling rate is none.
    record, _ = two_inertias(3000.0, 0.1, 0.0, seed=5)
    with pytest.raises(InsufficientExcitationError, match="resonance"):
        estimate(record, "flexible_shaft")


def test_what_the_data_do_not_show_has_no_certainty() -> None:
    # Two columns alike: their sum is known, neither of them is.
    rng = np.random.default_rng(4)
    column = rng.standard_normal(500)
    other = rng.standard_normal(500)
    covariance = flexible_shaft._inverse(np.column_stack([column, column, other]))
    assert np.all(np.diag(covariance) > 0)
    assert covariance[2, 2] == pytest.approx(1 / 500, rel=0.25)  # 4 sqrt(2 / 500)
    assert covariance[0, 0] > 1e6
    assert flexible_shaft._quantity("dc_gain", 10.0, 1e3, 12.0).status == "unidentifiable"
    assert flexible_shaft._quantity("dc_gain", 10.0, 0.1, 12.0).value == 10.0
