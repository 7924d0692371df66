# SPDX-License-Identifier: Apache-2.0
"""Findings: warnings, refusals and advice, with a code for programs and a message for people."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

Severity = Literal["note", "warning", "unreliable", "refused"]
SEVERITIES: tuple[Severity, ...] = ("note", "warning", "unreliable", "refused")
"""From the mildest to the gravest."""


@dataclass(frozen=True)
class Finding:
    """One observation about data or a result.

    Attributes
    ----------
    code : str
        Name for programs, such as ``dead_zone``.
    severity : {'note', 'warning', 'unreliable', 'refused'}
        ``unreliable``: a stated number may be off by more than its interval.
    message : str
        The observation in words, with values and units.
    evidence : mapping of str to float, str or None
        Numbers of the observation, such as a test statistic and its limit.
    advice : str
        What to do, such as a recording that would decide.
    quantities : tuple of str
        Affected quantities, by the names of `result.UNITS`; empty for all.
    """

    code: str
    severity: Severity
    message: str
    evidence: Mapping[str, float | str | None] = field(default_factory=dict)
    advice: str = ""
    quantities: tuple[str, ...] = ()


def gravest(findings: Iterable[Finding]) -> Severity | None:
    """Return the gravest severity among findings, None without findings."""
    return max((f.severity for f in findings), key=SEVERITIES.index, default=None)


def format_figure(value: float, digits: int = 3) -> str:
    """Return a number with so many digits; a power of ten below 1e-4 and from a million on."""
    if math.isinf(value):
        return "∞"
    if 10.0 ** (digits - 1) <= abs(value) < 1e6:
        return f"{value:.0f}"
    number, _, power = f"{value:.{digits}g}".partition("e")
    return f"{number}{format_power(int(power))}" if power else number


def format_power(power: int) -> str:
    """Return a power of ten as a factor in print: ``·10⁻⁶``."""
    return "·10" + str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
