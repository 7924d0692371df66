# SPDX-License-Identifier: Apache-2.0
"""A winding's temperature between two recordings of a commissioning."""

from dataclasses import replace

import numpy as np
import pytest
from motors import simulate

from smp_motor_ident.commission.recordings import report_heated_winding, resistance
from smp_motor_ident.record import Record

R, L, K, J, B, TC = 3.2, 2e-3, 0.03, 1.4e-5, 5.5e-5, 2e-3


def simulate_signal(rise: float, seed: int, friction: float = TC) -> Record:
    """Return 6 s of a motor with increased resistance under three tones."""
    rng = np.random.default_rng(seed)
    time = 5e-3 * np.arange(1200)
    volts = sum(2.0 * np.sin(2 * np.pi * f * time + f) for f in (0.3, 0.7, 2.9))
    out = simulate(time, volts, R * (1 + rise), L, K, J, B, friction, np.zeros(time.size), 50)
    count = np.floor(out[:, 2] * 500 / (2 * np.pi)).astype(np.int64)
    current = out[:, 0] + 0.005 * rng.standard_normal(time.size)
    return Record("m", time, volts, current, count=count)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("friction", [TC, 5 * TC])
def test_winding_resistance_is_estimated_independent_of_friction(seed, friction):
    found = resistance(simulate_signal(0.1, seed, friction))
    assert found.value == pytest.approx(1.1 * R, abs=4 * found.std)
    assert found.std < 0.03 * R


@pytest.mark.parametrize("rise", [0.3, 0.5])
def test_heated_winding_stops_the_commissioning(rise):
    (finding,) = report_heated_winding("left", [simulate_signal(0.0, 1)], simulate_signal(rise, 2))
    assert finding.code == "winding_hot" and finding.severity == "refused"
    assert finding.evidence["warmer"] == pytest.approx(rise / 0.00393, rel=0.1)
    assert "--resume" in finding.advice


@pytest.mark.parametrize("seed", range(20))
def test_normal_winding_warming_does_not_stop_the_commissioning(seed):
    assert not report_heated_winding(
        "left", [simulate_signal(0.0, seed)], simulate_signal(0.1, 100 + seed)
    )


def test_winding_resistance_is_unknown_without_current():
    bare = replace(simulate_signal(0.5, 1), current=None)
    assert resistance(bare) is None
    assert not report_heated_winding("left", [simulate_signal(0.0, 1)], bare)


def test_winding_resistance_skips_segment_boundaries_and_lost_samples():
    record = simulate_signal(0.0, 3)
    current = record.current.copy()
    current[200:220] = np.nan
    count = record.count.copy()
    count[600:] += 12345
    found = resistance(replace(record, current=current, count=count, starts=(0, 600)))
    assert found is not None and found.value == pytest.approx(R, abs=4 * found.std)
