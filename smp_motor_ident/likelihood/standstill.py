"""Which segments begin with a standstill although the voltage is on in their first rows.

A log that begins with its step says nothing of before: the motor stood without voltage, and what
passes until it moves is a delay.  A motor that only turns around stands no longer than its
acceleration lets it.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.likelihood import recursion as rc

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

SLOW = 0.02  # of the fastest speed: what stands
LONGER = 3.0  # than a motor takes to turn around
ON = 0.05  # of the largest voltage


def stands(
    time: Array, output: Array, voltage: Array, starts: Integers, kind: int, quantum: float
) -> Flags:
    """Tell of each segment whether the motor still stands while it is driven, shape (g,)."""
    out = np.zeros(len(starts) - 1, dtype=np.bool_)
    on = ON * float(np.abs(voltage).max(initial=0.0))
    for g, (a, b) in enumerate(itertools.pairwise(starts)):
        driven = b - a > 8 and on > 0 and bool((np.abs(voltage[a + 1 : a + 3]) > on).all())
        known = np.flatnonzero(np.isfinite(output[a:b])) + a
        if driven and known.size > 8:
            out[g] = _stands(time[known], output[known], kind, quantum)
    return out


def _stands(t: Array, y: Array, kind: int, quantum: float) -> bool:
    """Tell whether one segment begins with a standstill."""
    if kind == rc.ANGLE:
        stride = _stride(y, quantum)
        speed = (y[stride:] - y[:-stride]) / (t[stride:] - t[:-stride])
    else:
        stride, speed = 1, y
    fastest = float(np.quantile(np.abs(speed), 0.98))
    change = np.abs(np.diff(speed[::stride]))
    if not change.size:
        return False
    acceleration = float(np.quantile(change, 0.9)) / (stride * float(np.median(np.diff(t))))
    if not (fastest > 0 and acceleration > 0):
        return False
    turning = SLOW * fastest / acceleration
    still = SLOW * fastest
    away = np.abs(y) > still
    if kind == rc.ANGLE:
        still = max(1.5 * quantum, 0.5 * acceleration * turning**2)
        turning = math.sqrt(2 * still / acceleration)
        away = np.abs(y - y[0]) > still
    first = int(np.argmax(away))
    return bool(away[first]) and first >= 3 and float(t[first] - t[0]) > LONGER * turning


def _stride(y: Array, quantum: float) -> int:
    """Return over how many rows an angle moves by ten of its steps, as a rule."""
    moves = np.abs(np.diff(y))
    moves = moves[moves > 0.5 * quantum]
    if not moves.size:
        return 1
    rows = math.ceil(10 * quantum / float(np.median(moves)))
    return int(np.clip(rows, 1, max(y.size // 8, 1)))
