# SPDX-License-Identifier: Apache-2.0
"""Report the limits of a recording with few sizes or directions of voltage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.fit.data import Data
from smp_motor_ident.limits import LEVEL_TOLERANCE, MAX_REST_VOLTAGE

MIN_SWINGS = 6
MAX_STEP_SHARE = 0.2  # of the rows, in which a command of steps changes

MIN_COASTING_SPEED_SHARE = 0.2  # of the largest speed


@dataclass(frozen=True)
class Levels:
    """Levels of a command [V]; 0 where there are several."""

    one_size: float  # the only size, both ways or one way, or that of the only swing
    one_step: float  # the only size of its steps
    steady: float  # the only level besides zero, with its sign
    one_way: bool  # whether it drives in one direction only


def detect_levels(data: Data) -> Levels:
    """Return the levels of a recording's command."""
    command = data.rows.command
    one_way = not command.min() < 0 < command.max()
    size = _find_only_size(command)
    steady = 0.0
    if size and one_way and not _has_coasting(data):
        steady = float(command[np.argmax(np.abs(command))])
    return Levels(size or _find_only_swing(data), _find_only_step(command), steady, one_way)


def _has_coasting(data: Data) -> bool:
    """Tell whether the motor runs down without voltage, which shows its friction."""
    speed, off = np.abs(data.speed), data.rows.mean_command == 0.0
    fast = speed > MIN_COASTING_SPEED_SHARE * float(np.nanquantile(speed, 0.98))
    return int((off & fast).sum()) >= 3


def _find_only_size(command: Array) -> float:
    """Return the only size of a command besides zero; a row between two levels is no third."""
    top = float(np.abs(command).max())
    other = (top - np.abs(command) > LEVEL_TOLERANCE * top) & (
        np.abs(command) > MAX_REST_VOLTAGE * top
    )
    change = np.diff(command)
    between = (change[:-1] * change[1:] > 0) & ~other[:-2] & ~other[2:]
    other[1:-1] &= ~between
    return 0.0 if other.any() else top


def _find_only_swing(data: Data) -> float:
    """Return the peak of a command that swings there and back always as far and as long."""
    command, begin = data.rows.command, data.rows.begin
    turns = np.flatnonzero(np.diff(command >= 0)) + 1
    if turns.size < MIN_SWINGS:
        return 0.0
    peaks = np.maximum.reduceat(np.abs(command), turns)[:-1]
    lengths = np.diff(begin[turns])
    peak, length = float(np.median(peaks)), float(np.median(lengths))
    alike = (np.abs(peaks - peak) < LEVEL_TOLERANCE * peak) & (
        np.abs(lengths - length) < LEVEL_TOLERANCE * length + 1.5 * data.rows.step
    )
    return peak if float(alike.mean()) > 1 - LEVEL_TOLERANCE else 0.0


def _find_only_step(command: Array) -> float:
    change = np.abs(np.diff(command))
    steps = change[change > MAX_REST_VOLTAGE * float(np.abs(command).max())]
    if not MIN_SWINGS <= steps.size < MAX_STEP_SHARE * change.size:
        return 0.0
    size = float(np.median(steps))
    alike = np.abs(steps - size) < LEVEL_TOLERANCE * size
    return size if float(alike.mean()) > 1 - LEVEL_TOLERANCE else 0.0
