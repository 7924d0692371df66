# SPDX-License-Identifier: Apache-2.0
"""Errors with a one-line message that names the value, the file and the remedy."""

import math
import re

MAX_MESSAGE_LENGTH = 1000
"""Longer messages, such as those that quote a damaged file, are shortened in the middle."""


_TOKEN = "[A-Za-z_][A-Za-z0-9_]*"
_NAME = re.compile(f"{_TOKEN}(/{_TOKEN})*")


def printable(text: str) -> str:
    """Return a text with its non-printable characters replaced."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def is_ros_name(name: str) -> bool:
    """Return whether a name is valid in topics, node names, exports and paths."""
    return _NAME.fullmatch(name) is not None


class SmpError(Exception):
    """Base of all errors of this project."""

    exit_code = 2

    def __str__(self) -> str:
        """Return the message in one line, shortened to :data:`MAX_MESSAGE_LENGTH`."""
        text, half = printable(super().__str__()), MAX_MESSAGE_LENGTH // 2
        return text if len(text) <= MAX_MESSAGE_LENGTH else f"{text[:half]} … {text[-half:]}"


class ParameterError(SmpError, ValueError):
    """A parameter has an impossible value."""


def check_range(name: str, value: float, low: float, high: float, unit: str = "") -> float:
    """Return a number; raise when it is not between two limits."""
    number = not isinstance(value, (bool, str)) and hasattr(value, "__float__")
    if number and low <= float(value) <= high:
        return float(value)
    given = f"{value!r} {unit}".rstrip()
    raise ParameterError(f"{name} is {given}; it must be a number from {low:g} to {high:g}")


def check_positive(name: str, value: float, unit: str = "", *, or_zero: bool = False) -> None:
    """Raise unless a number is finite and positive (or zero, if allowed)."""
    if not (0.0 < value < math.inf or (or_zero and value == 0.0)):
        given = f"{value!r} {unit}".rstrip()
        raise ParameterError(f"{name} is {given}; it must be {'zero or ' * or_zero}positive")
