# SPDX-License-Identifier: Apache-2.0
"""A threshold of a decision, with its unit, its reason and the test that shows it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Limit:
    """One threshold: its value and unit, the reason for it, and the test that shows it."""

    value: float
    unit: str
    reason: str
    test: str
