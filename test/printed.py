# SPDX-License-Identifier: Apache-2.0
"""Comparison of results printed on pages with a fresh run."""

import re
from collections.abc import Iterable

NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def numbers(line: str) -> list[float]:
    """Return the numbers of a line."""
    return [float(one) for one in NUMBER.findall(line)]


def shape(line: str) -> str:
    """Return a line without its numbers, its rules and the width of its columns."""
    return " ".join(NUMBER.sub("#", line.replace("─", "")).split())


def last_digit(number: str) -> float:
    """Return the value of a unit in the last printed digit."""
    mantissa, _, exponent = number.partition("e")
    return float(10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2])))


def agree(shown: str, fresh: str) -> bool:
    """Tell whether two lines are the same, numbers to one unit in their last digit.

    Other processors round the sums of a fit differently, which may change a printed digit.
    """
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(fresh), strict=False)
    return shape(shown) == shape(fresh) and all(
        abs(float(a) - float(b)) <= 1.01 * max(last_digit(a), last_digit(b)) for a, b in pairs
    )


def not_printed(shown: Iterable[str], fresh: Iterable[str]) -> list[str]:
    """Return the shown lines that a fresh run does not print in this order."""
    rest, missing = list(fresh), []
    for line in shown:
        at = next((k for k, one in enumerate(rest) if agree(line, one)), None)
        if at is None:
            missing.append(line)
        else:
            del rest[: at + 1]
    return missing
