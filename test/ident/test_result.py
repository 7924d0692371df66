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


def test_draws_have_the_mean_and_covariance_of_the_estimate():
    estimate = an_estimate()
    n = 200_000
    draws = estimate.samples_of(estimate.names, n, np.random.default_rng(1))
    # Standard error of a mean is std/sqrt(n); of a variance, relative sqrt(2/n) = 0.3 %.
    std = np.sqrt(np.diag(estimate.covariance))
    assert np.all(np.abs(draws.mean(0) - [25.5, 0.05]) < 5 * std / np.sqrt(n) + 1e-3 * std)
    np.testing.assert_allclose(np.cov(draws.T), estimate.covariance, rtol=0.03)


def test_draws_of_positive_quantities_stay_positive_however_uncertain():
    estimate = Estimate(
        "w",
        "m",
        {},
        {"delay": Quantity(0.001, 0.002)},
        names=("delay",),
        covariance=np.array([[4e-6]]),
    )
    assert np.all(estimate.samples_of(["delay"], 10_000, np.random.default_rng(2)) > 0)


def test_a_name_without_covariance_is_drawn_as_its_value():
    draws = an_estimate().samples_of(["static_voltage", "dc_gain"], 5, np.random.default_rng(3))
    assert np.all(draws[:, 0] == 0)
    assert draws.shape == (5, 2)


def test_value_falls_back_to_the_given_default():
    assert an_estimate().value("resistance", 7.0) == 7.0
    assert an_estimate().value("dc_gain") == pytest.approx(25.5, rel=1e-15)  # stored, not computed
