# SPDX-License-Identifier: Apache-2.0
"""Short version of benchmarks/together.py: four different wheels settle together."""

from pathlib import Path

import pytest
from bench_scripts import load

from smp_motor_control.motor.file import load_motors

ROOT = Path(__file__).resolve().parents[2]
ENTRIES = load_motors(ROOT / "config" / "motors_paper.yaml")


TOGETHER = load("together")


@pytest.fixture(scope="module")
def found():
    return TOGETHER.identify_recorded(ENTRIES, 200.0, seed=11, duration=10.0)


@pytest.mark.parametrize(("rate", "most"), [(100.0, 0.010), (200.0, 0.005), (1000.0, 0.005)])
def test_four_motors_under_uneven_load_settle_together_without_overshoot(found, rate, most):
    runs = TOGETHER.compare(ENTRIES, found, rate, seed=11)
    plain, arrival = (TOGETHER.assess(runs[way]) for way in ("plain", "together"))
    # The bounds: one control period, 5 ms at 1 kHz; overshoot below 1 %.
    assert arrival.spread <= most
    assert max(arrival.overshoot.values()) < 1.0
    # The common reference causes it: under a plain step the same loops are far apart.
    assert plain.spread > 3.0 * arrival.spread
