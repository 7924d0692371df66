# SPDX-License-Identifier: Apache-2.0
"""Detect segments that begin at standstill.

A motor without voltage that does not move for some rows is at rest.  A log whose voltage rises from
zero, or that begins with its step, shows this by the time until the motor moves, which is longer
than its acceleration takes; a motor that reverses is at rest only as long as that.
"""

from __future__ import annotations

import itertools

import numpy as np

from smp_motor_control.arrays import Array, Flags, Integers

MAX_REST_SPEED = 0.02  # share of the largest speed
MAX_REST_ANGLE = 1e-3  # share of the whole travel
MIN_REST_RATIO = 3.0  # ratio of a rest to a reversal
MIN_REST_ROWS = 2
QUIET_ROWS = 8  # rows without voltage and motion
MIN_DRIVING_VOLTAGE_SHARE = 0.05  # of the largest voltage


def detect_rest_at_start(
    time: Array, output: Array, voltage: Array, starts: Integers, is_angle: bool, quantum: float
) -> Flags:
    """Return for each segment whether the motor is at rest at its beginning, shape (g,)."""
    out = np.zeros(len(starts) - 1, dtype=np.bool_)
    on = MIN_DRIVING_VOLTAGE_SHARE * float(np.abs(voltage).max(initial=0.0))
    extent = np.nanmax(output) - np.nanmin(output) if is_angle else np.nanmax(np.abs(output))
    least = max(1.5 * quantum, (MAX_REST_ANGLE if is_angle else MAX_REST_SPEED) * float(extent))
    for g, (a, b) in enumerate(itertools.pairwise(starts)):
        begin = slice(a, a + QUIET_ROWS)
        if b - a > QUIET_ROWS and (np.abs(voltage[begin]) < on).all():
            at_rest = output[a] if is_angle else 0.0
            out[g] = not (np.abs(output[begin] - at_rest) > least).any()
            continue
        # The voltage rises from zero, or the log begins with its step.
        begins = np.abs(voltage[a]) < on or bool((np.abs(voltage[a + 1 : a + 3]) > on).all())
        known = np.flatnonzero(np.isfinite(output[a:b])) + a
        if begins and on > 0 and known.size > 8:
            out[g] = _begins_at_rest(time[known], output[known], is_angle, quantum)
    return out


def _begins_at_rest(t: Array, y: Array, is_angle: bool, quantum: float) -> bool:
    """Return whether one segment begins with a standstill.

    At a constant acceleration, the time from one speed to its treble, or from one angle to nine
    times it, is twice the time before.
    """
    if is_angle:
        away, treble = np.abs(y - y[0]), 9.0
        slight = MAX_REST_ANGLE * float(np.ptp(y))
        # A fine counter shows a standstill that a thousandth of the travel would hide.
        nears = [1.5 * quantum, max(1.5 * quantum, slight)]
    else:
        away, treble = np.abs(y), 3.0
        if int(np.argmax(away > MAX_REST_SPEED * away.max())) < MIN_REST_ROWS:
            return False
        nears = [MAX_REST_SPEED * float(np.quantile(away, 0.98))]
    for near in nears:
        left, gone = int(np.argmax(away > near)), int(np.argmax(away > treble * near))
        waits = float(t[left] - t[0]) > MIN_REST_RATIO * 0.5 * float(t[gone] - t[left])
        if near > 0 and gone >= left >= MIN_REST_ROWS and waits:
            return True
    return False
