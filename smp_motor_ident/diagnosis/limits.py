"""Every threshold of a decision about data and estimates, with its unit and its reason.

``docs/limits.md`` is this table, printed.  A limit's reason is a significance level, a cost or
a physical limit; that some record came out right is none.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Limit:
    """One threshold: its value and unit, why it is what it is, and the test that shows it."""

    value: float
    unit: str
    reason: str
    test: str


# Reading recordings (smp_motor_ident.bag).
UNPACKED_LEAST = Limit(
    256e6,
    "byte",
    "cost: what any machine that runs ROS can spare; a smaller file may always unpack to it",
    "test/ident/bag/test_bounds.py",
)
UNPACKED_RATIO = Limit(
    50.0,
    "1",
    "cost: 1 GB at most for a file of 10 MB, half of it unpacked bytes; telemetry packs 3 to 20",
    "test/ident/bag/test_bounds.py",
)
STRAY_ROWS = Limit(
    0.05,
    "1",
    "cost: an estimate without one row in twenty keeps its value; with more it is no table",
    "test/ident/bag/test_csv.py",
)
