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
