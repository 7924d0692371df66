# SPDX-License-Identifier: Apache-2.0
"""An Estimate survives its file, and its draws follow its covariance."""

from __future__ import annotations

import numpy as np
import pytest

from smp_motor_ident.finding import Finding
from smp_motor_ident.record import Hardware
from smp_motor_ident.result import Candidate, Estimate, FitPercent, Quantity, ResidualTests


def an_estimate() -> Estimate:
    names = ("dc_gain", "time_constant")
    std = np.array([0.1, 0.002])
    correlation = np.array([[1.0, 0.6], [0.6, 1.0]])
    return Estimate(
        wheel="front_left",
        model="first_order",
        parameters={"resistance": Quantity(None, unit="ohm", status="unidentifiable")},
        combinations={
            "dc_gain": Quantity(25.5, 0.1, (25.3, 25.7), "rad/s/V"),
            "time_constant": Quantity(0.05, 0.002, (0.046, 0.054), "s"),
        },
        names=names,
        covariance=correlation * np.outer(std, std),
        fit_percent=FitPercent(97.2, 96.8),
        candidates=(Candidate("first_order", 97.2, -1.0, True, "simplest not rejected"),),
        residuals=ResidualTests(True, None),
        findings=(Finding("a", "warning", "w", {"size": 1.0}, "record current"),),
        samples=600,
        duration=6.0,
        sample_time=0.01,
        sources=("bag",),
        hardware=Hardware(65.5, 500, 16, 12.0, None),
    )


def test_an_unidentifiable_parameter_is_null_and_listed():
    document = an_estimate().to_document()
    assert document["parameters"]["resistance"]["value"] is None
    assert document["unidentifiable"] == ["resistance"]
    assert document["identifiable"] is False


def test_numbers_that_do_not_exist_are_null_never_nan():
    estimate = Estimate("w", "m", {}, {"dc_gain": Quantity(1.0, float("nan"))})
    assert estimate.to_document()["combinations"]["dc_gain"]["std"] is None


def test_value_falls_back_to_the_given_default():
    assert an_estimate().value("resistance", 7.0) == 7.0
    assert an_estimate().value("dc_gain") == pytest.approx(25.5, rel=1e-15)  # stored, not computed
