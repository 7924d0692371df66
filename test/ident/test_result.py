# SPDX-License-Identifier: Apache-2.0
"""An Estimate survives its file, and its draws follow its covariance."""

import pytest
from results import PHYSICAL, estimate

from smp_motor_ident.result import Estimate, Quantity


def test_an_unidentifiable_parameter_is_null_and_listed():
    document = estimate(current=False).to_document()
    assert document["parameters"]["resistance"]["value"] is None
    assert document["unidentifiable"] == list(PHYSICAL)
    assert document["identifiable"] is False


def test_numbers_that_do_not_exist_are_null_never_nan():
    unknown = Estimate("w", "m", {}, {"dc_gain": Quantity(1.0, float("nan"))})
    assert unknown.to_document()["combinations"]["dc_gain"]["std"] is None


def test_value_falls_back_to_the_given_default():
    assert estimate(current=False).value("resistance", 7.0) == 7.0
    assert estimate().value("dc_gain") == pytest.approx(25.5, rel=1e-15)  # stored, not computed
