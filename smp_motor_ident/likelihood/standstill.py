"""Which segments begin with a standstill although the voltage is on in their first rows.

A log that begins with its step says nothing of before: the motor stood without voltage, and what
passes until it moves is a delay.  A motor that only turns around stands no longer than its
acceleration lets it.
"""

from __future__ import annotations

import itertools

import numpy as np

from smp_motor_control.arrays import Array, Flags, Integers
from smp_motor_ident.model.measurement import ANGLE, Measurement

SLOW = 0.02  # of the fastest speed: what stands
SLIGHT = 1e-3  # of all that it turned: the same of an angle
LONGER = 3.0  # than a motor takes to turn around
ROWS = 2  # at least
ON = 0.05  # of the largest voltage


def stands(
    time: Array, output: Array, voltage: Array, starts: Integers, kind: Measurement, quantum: float
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


def _stands(t: Array, y: Array, kind: Measurement, quantum: float) -> bool:
    """Tell whether one segment begins with a standstill.

    What starts or turns around at a constant acceleration takes twice as long from one speed to
    its treble, or from one angle to nine times it, as it took to get there.
    """
    if kind == ANGLE:
        away, treble = np.abs(y - y[0]), 9.0
        slight = SLIGHT * float(np.ptp(y))
        # A fine counter shows a standstill of which a thousandth of the way would show nothing.
        nears = [1.5 * quantum, max(1.5 * quantum, slight)]
    else:
        away, treble = np.abs(y), 3.0
        if int(np.argmax(away > SLOW * away.max())) < ROWS:  # beyond what is slow at most
            return False
        nears = [SLOW * float(np.quantile(away, 0.98))]
    for near in nears:
        left, gone = int(np.argmax(away > near)), int(np.argmax(away > treble * near))
        waits = float(t[left] - t[0]) > LONGER * 0.5 * float(t[gone] - t[left])
        if near > 0 and gone >= left >= ROWS and waits:
            return True
    return False
