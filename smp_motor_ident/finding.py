"""What is warned of, refused or advised: a code for programs, a message for people."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

Severity = Literal["note", "warning", "unreliable", "refused"]
SEVERITIES: tuple[Severity, ...] = ("note", "warning", "unreliable", "refused")
"""From the mildest to the gravest."""


@dataclass(frozen=True)
class Finding:
    """One thing that was found about data or a result.

    Attributes
    ----------
    code : str
        Name that programs decide by, such as ``dead_zone``.
    severity : {'note', 'warning', 'unreliable', 'refused'}
        ``unreliable``: a stated number may be off by more than its interval.
    message : str
        What was found, in words, with the values.
    evidence : mapping of str to float, str or None
        The numbers behind it, such as a test statistic and its limit.
    advice : str
        What to do about it, such as which recording would settle it.
    """

    code: str
    severity: Severity
    message: str
    evidence: Mapping[str, float | str | None] = field(default_factory=dict)
    advice: str = ""


def gravest(findings: Iterable[Finding]) -> Severity | None:
    """Return the gravest severity among findings, None where there is none."""
    return max((f.severity for f in findings), key=SEVERITIES.index, default=None)
