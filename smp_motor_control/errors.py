"""The errors that a caller can do something about.

Every message names the value (and the file where there is one) and says what to do.
"""

import math
import re

LONGEST_MESSAGE = 1000
"""Characters of a message: of a value that is quoted from a spoilt file head and tail are shown."""


_TOKEN = "[A-Za-z_][A-Za-z0-9_]*"
_NAME = re.compile(f"{_TOKEN}(/{_TOKEN})*")


def printable(text: str) -> str:
    """Return a text in one line: whatever else a file or a path holds is replaced."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def is_ros_name(name: str) -> bool:
    """Return whether a name may stand in those of topics and nodes, in exports and in paths."""
    return _NAME.fullmatch(name) is not None


class SmpError(Exception):
    """Base of all errors of this project; its text is one line for the user."""

    exit_code = 2

    def __str__(self) -> str:
        """Return the message in one line, without its middle where nobody would read that."""
        text, half = printable(super().__str__()), LONGEST_MESSAGE // 2
        return text if len(text) <= LONGEST_MESSAGE else f"{text[:half]} … {text[-half:]}"


class ParameterError(SmpError, ValueError):
    """A parameter has a value that no motor, controller or robot can have."""


def check_range(name: str, value: float, low: float, high: float, unit: str = "") -> float:
    """Return a number that lies between two limits, of which the message names both."""
    number = not isinstance(value, (bool, str)) and hasattr(value, "__float__")
    if number and low <= float(value) <= high:
        return float(value)
    given = f"{value!r} {unit}".rstrip()
    raise ParameterError(f"{name} is {given}; it must be a number from {low:g} to {high:g}")


def check_positive(name: str, value: float, unit: str = "", *, or_zero: bool = False) -> None:
    """Refuse what is not finite and positive; zero only where it is none of what may be."""
    if not (0.0 < value < math.inf or (or_zero and value == 0.0)):
        given = f"{value!r} {unit}".rstrip()
        raise ParameterError(f"{name} is {given}; it must be {'zero or ' * or_zero}positive")
