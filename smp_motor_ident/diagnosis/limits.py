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


# Tuning: what may be designed on, and how far gains may go.

FRICTION_KNOWN = Limit(
    0.02,
    "share of the supply",
    "an error of the friction's feed-forward by this changes the speed by as much of its largest "
    "value as the band in which a change counts as settled",
    "test_tune_truth.py",
)
FRICTION_RANGE = Limit(
    0.5,
    "share of the supply",
    "with half of the supply unknown the speed that the motor reaches is not known to a factor 2",
    "test_tune_truth.py",
)
UNRELIABLE_SPREAD = Limit(
    0.1,
    "relative standard deviation",
    "least that numbers of an unreliable estimate are drawn with; more where the fit on held-out "
    "data leaves more of the motion unexplained",
    "test_tune_truth.py",
)
SPEED_NOISE = Limit(
    2.5e-3,
    "share of the top speed, rms",
    "four times this is 2 % of half the top speed: with more, counts shake the wheel out of the "
    "band in which the specification calls a change settled",
    "test_tune_methods.py",
)
