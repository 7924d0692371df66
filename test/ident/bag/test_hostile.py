# SPDX-License-Identifier: Apache-2.0
"""Hostile files are refused in one line within 30 s and 1 GB."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[3]


def _hostile() -> ModuleType:
    spec = importlib.util.spec_from_file_location("hostile", ROOT / "benchmarks" / "hostile.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["hostile"] = module
    spec.loader.exec_module(module)
    return module


HOSTILE = _hostile()


@pytest.mark.slow
@pytest.mark.parametrize("name", list(HOSTILE.CASES))
def test_a_claim_costs_no_more_than_the_size_of_its_file(name: str) -> None:
    told, memory, wrong = HOSTILE.read(name)
    assert not wrong, (told, f"{memory / 1e6:.0f} MB")
