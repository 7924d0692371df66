# SPDX-License-Identifier: Apache-2.0
"""Hostile files are refused in one line within bounded time and memory."""

import pytest
from bench_scripts import load
from recordings import assert_refused

from smp_motor_ident.bag.readers import apart

HOSTILE = load("hostile")


@pytest.fixture(autouse=True)
def _scaled(monkeypatch):
    """Reduce the repeated content of each file to a fifth, and lower the limits."""
    monkeypatch.setattr(HOSTILE, "SHARE", 0.2)
    monkeypatch.setattr(HOSTILE, "SECONDS", 15)
    monkeypatch.setattr(HOSTILE, "MEMORY", 500_000_000)


@pytest.mark.parametrize("name", list(HOSTILE.CASES))
def test_reading_cost_is_bounded_by_file_size(name):
    told, memory, wrong = HOSTILE.read(name)
    assert not wrong, (told, f"{memory / 1e6:.0f} MB")


def test_workbook_exceeding_time_limit_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(apart, "TIMEOUT_S", 0.5)
    name, write, mapping = HOSTILE.CASES["xlsx: numbers"]
    write(tmp_path)
    assert_refused("is not read after 1 s, too long for its size", tmp_path / name, mapping)
