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


# Estimation: what is stated, and how surely.
LOOSE_QUANTITY = Limit(
    0.5,
    "of its value",
    "a quantity known no better than to a factor of two (95 %) decides nothing",
    "test_estimate.py: a single level of voltage gives one combination",
)
NEGLIGIBLE_FRICTION = Limit(
    0.05,
    "V",
    "Coulomb friction certain to that much may be nothing: half a percent of 10 V",
    "test_estimate.py: a linear motor is recovered without friction",
)
HOMOGENEITY = Limit(
    0.01,
    "significance level",
    "one record in a hundred of a motor that does not change may be called one that does",
    "test_segments.py: a motor that does not change is rarely said to",
)
SEGMENTS = Limit(
    8,
    "parts of a record",
    "enough for a scatter (a factor of 1.2 by Student's t), few enough for each to know the motor",
    "test_segments.py: a motor that warms up",
)
SEGMENT_INFORMATION = Limit(
    0.02,
    "of the average part's",
    "a part that knows a coordinate seven times worse than the others tells of its noise only",
    "test_segments.py: parts without excitation do not count",
)
REST = Limit(
    0.05,
    "of the largest voltage",
    "a motor that does not move at a twentieth of the voltage shows what it shows at none",
    "test_estimate.py: rest before the excitation changes nothing",
)
SAME_LEVEL = Limit(
    0.02,
    "of a voltage",
    "levels closer than a voltmeter and a battery under load hold them are one level",
    "test_estimate.py: a single level of voltage gives one combination",
)
