# SPDX-License-Identifier: Apache-2.0
"""A validation run, judged by the residuals of the fit."""

import numpy as np

from smp_motor_ident.commission.recordings import SimulatedRun, judge

TIME = np.arange(0.0, 10.0, 0.005)
SPEED = 100.0 * np.sin(2.0 * TIME)


def run(seed: int, error: float, gain: float = 1.0) -> SimulatedRun:
    """Return a run whose simulation has autocorrelated errors and a gain error."""
    draw = np.random.default_rng(seed)
    slow = np.convolve(draw.normal(size=TIME.size + 99), np.ones(100) / 10.0, "valid")
    return SimulatedRun(TIME, gain * SPEED + error * slow, SPEED)


def test_unchanged_motor_is_rarely_refused_in_validation():
    found = [judge("left", [run(2 * k, 5.0)], [run(2 * k + 1, 5.0)]) for k in range(200)]
    # One in a hundred by chance: more than seven of 200 have a probability of a thousandth.
    assert sum(f.severity == "refused" for f in found) <= 7
    assert "in the validation run" in found[0].message
    # Errors of 5 rad/s with a speed of 71 rad/s rms.
    assert abs(found[0].evidence["fit_percent"] - 93.0) < 1.5


def test_changed_motor_is_refused_in_validation():
    found = judge("left", [run(1, 1.0)], [run(2, 1.0, gain=1.15)])
    assert found.severity == "refused" and found.code == "validation_run" and found.advice


def test_significant_but_negligible_error_is_only_a_note():
    assert judge("left", [run(1, 0.01)], [run(2, 0.01, gain=1.02)]).severity == "note"


def test_missing_samples_do_not_affect_the_validation():
    hole = run(2, 1.0)
    hole.measured[500:700] = np.nan
    assert judge("left", [run(1, 1.0)], [hole]).severity == "note"
