"""Let the tests of identification share their simulated motors, whose instruments are exact."""

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from smp_motor_ident.diagnosis import systematic

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session", autouse=True)
def exact_instruments() -> Iterator[None]:
    """Leave in the intervals what the records show alone: that is what most tests are about.

    What is taken of instruments whose accuracy nobody states is asked for in test_systematic.py.
    """
    with pytest.MonkeyPatch.context() as patch:
        for name in ("CURRENT_ACCURACY", "ONE_SIZE_ACCURACY", "TIMING_ACCURACY"):
            patch.setattr(systematic, name, replace(getattr(systematic, name), value=0.0))
        yield
