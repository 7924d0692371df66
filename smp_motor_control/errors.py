"""The errors that a caller can do something about.

Every message names the value (and the file where there is one) and says what to do.
"""

from __future__ import annotations


class SmpError(Exception):
    """Base of all errors of this project; its text is one line for the user."""

    exit_code = 2


class ParameterError(SmpError, ValueError):
    """A parameter has a value that no motor, controller or robot can have."""
