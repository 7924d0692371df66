# SPDX-License-Identifier: Apache-2.0
"""Errors of the identification side; exit codes as in the command-line contract."""

from __future__ import annotations

from smp_motor_control.errors import ParameterError as ParameterError
from smp_motor_control.errors import SmpError as SmpError


class BagError(SmpError):
    """A recording cannot be read or lacks requested data."""


class SignalError(SmpError):
    """A signal of a record contradicts itself, another signal, or physics."""

    exit_code = 1


class CurrentError(SignalError):
    """The current contradicts voltage and motion, which do not contradict each other."""


class InsufficientExcitationError(SmpError):
    """The data do not support the answer; the message says what to record next."""

    exit_code = 1


class DesignError(SmpError):
    """No gains meet the targets; the message states the limit and the nearest design."""

    exit_code = 1
