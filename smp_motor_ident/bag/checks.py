# SPDX-License-Identifier: Apache-2.0
"""Detect impossible jumps and currents without a sign."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from smp_motor_control.arrays import Array, Flags
from smp_motor_ident.bag.axis import Series
from smp_motor_ident.errors import BagError
from smp_motor_ident.limits import (
    MAX_JUMP_SPAN,
    MAX_JUMP_STEP,
    MIN_COUNTS_BETWEEN_PUBLISHERS,
    MIN_RETURNING_SHARE,
    UNSIGNED_CURRENT_RATIO,
)

_MIN_SAMPLES = 50
_MAX_QUANTILE_SAMPLES = 5000  # values used for quantiles and means


def find_impossible_values(value: Array, *, steps_allowed: bool) -> Flags:
    """Return which values jump away and back by more than the signal's own range allows.

    A value is impossible if it lies many spans of the signal away from its neighbours, or, for a
    signal with inertia, if it jumps to and fro by many usual steps.
    """
    none = np.zeros(value.size, bool)
    sound = np.flatnonzero(np.isfinite(value))
    if sound.size < _MIN_SAMPLES:
        return none
    x = value[sound]
    with np.errstate(over="ignore", invalid="ignore"):
        some = x[:: max(x.size // _MAX_QUANTILE_SAMPLES, 1)]
        low, high = np.quantile(some, [0.01, 0.99])
        span = max(high - low, 1e-3 * max(abs(low), abs(high)))
        step = np.abs(np.diff(x))
        usual = float(np.quantile(step[:: max(x.size // _MAX_QUANTILE_SAMPLES, 1)], 0.99))
        if np.ptp(x) <= MAX_JUMP_SPAN * span and step.max() <= MAX_JUMP_STEP * usual:
            return none
        around = sliding_window_view(np.pad(x, 2, mode="edge"), 5)
        away = np.abs(x - np.median(around, axis=1))
        bad = (away > MAX_JUMP_SPAN * span) & (span > 0)
        if not steps_allowed:
            both = np.zeros(x.size, bool)
            both[1:-1] = np.minimum(step[:-1], step[1:]) > MAX_JUMP_STEP * usual
            both[1:-1] &= np.diff(x)[:-1] * np.diff(x)[1:] < 0
            bad |= both & (away > 0.5 * span) & (usual > 0)
    none[sound[bad]] = True
    return none


def has_two_publishers(count: Array) -> bool:
    """Return whether samples alternate between two counters."""
    there = np.abs(np.diff(count))[:-1]
    back = np.abs(count[2:] - count[:-2])
    returns = (there > MIN_COUNTS_BETWEEN_PUBLISHERS) & (back < 0.1 * there)
    # Fewer samples may do so by chance.
    return bool(count.size > 4 * _MIN_SAMPLES and np.mean(returns) > MIN_RETURNING_SHARE)


def is_unsigned(voltage: Series, current: Series) -> bool:
    """Return whether a current is positive in both directions: the supply's, or one without sign.

    The armature's current follows the sign of the voltage: its means at positive and at negative
    voltage cancel except for an offset.
    """
    sound = np.isfinite(current.value)
    every = max(current.time.size // _MAX_QUANTILE_SAMPLES, 1)
    time, amperes = current.time[sound][::every], current.value[sound][::every]
    if time.size < _MIN_SAMPLES or voltage.time.size < 2:
        return False
    index = np.clip(np.searchsorted(voltage.time, time, "right") - 1, 0, voltage.time.size - 1)
    volts = voltage.value[index]
    volts = np.where(np.isfinite(volts), volts, 0.0)
    driven = np.abs(volts) > 0.1 * np.abs(volts).max()
    forward, backward = driven & (volts > 0), driven & (volts < 0)
    if min(forward.mean(), backward.mean()) < 0.05:
        return False
    ahead, back = float(amperes[forward].mean()), float(amperes[backward].mean())
    if abs(ahead + back) < UNSIGNED_CURRENT_RATIO * abs(ahead - back):
        return False
    low, high = np.quantile(amperes, [0.05, 0.95])
    return bool(low > -0.2 * high)  # some current may return to the supply


def apply_direction(size: Series, direction: Series, where: str) -> Series:
    """Return a signal with the sign of a direction column: negative where it is 0 or below."""
    levels = np.unique(direction.value[np.isfinite(direction.value)])
    if not 1 <= levels.size <= 3 or (levels.min() >= 0 and (levels > 0).sum() > 1):
        codes = ", ".join(f"{level:g}" for level in levels[:4]) + ", …" * (levels.size > 4)
        raise BagError(
            f"{where}: direction has the values {codes}, and which is backwards is unknown. Scale "
            "them to signs, such as direction=COLUMN*-1+1.5 for 1 forwards and 2 backwards"
        )
    sign = np.sign(direction.value)
    if levels.min() >= 0:  # 0 and 1
        sign = np.where(direction.value > 0, 1.0, -1.0)
    elif levels.max() <= 0:  # 0 and -1, as a scale of -1 makes them
        sign = np.where(direction.value < 0, -1.0, 1.0)
    index = np.searchsorted(direction.time, size.time, "right") - 1
    return Series(size.time, size.value * sign[np.maximum(index, 0)], size.number, size.bits)
