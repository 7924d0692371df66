# SPDX-License-Identifier: Apache-2.0
"""Hostile files are refused in one line within 30 s and 1 GB."""

import pytest
from bench_scripts import load

HOSTILE = load("hostile")


@pytest.mark.slow
@pytest.mark.parametrize("name", list(HOSTILE.CASES))
def test_a_claim_costs_no_more_than_the_size_of_its_file(name):
    told, memory, wrong = HOSTILE.read(name)
    assert not wrong, (told, f"{memory / 1e6:.0f} MB")
