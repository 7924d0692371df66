# SPDX-License-Identifier: Apache-2.0
"""Filter a signal by a first-order lag, and correlate signals."""

from __future__ import annotations

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident._compile import compiled

MIN_DECAYED_VALUE = 1e-100  # its square is still a normal number


def apply_lag(values: Array, samples: float) -> Array:
    """Filter a signal by a first-order lag of ``samples``, from rest; a lag of 0 changes nothing.

    Tails are set to zero before they become subnormal numbers, which slow
    ``scipy.signal.lfilter`` tenfold.
    """
    if samples == 0.0:
        return values
    out = np.empty(values.size)
    _filter_lag(np.asarray(values, dtype=np.float64), float(np.exp(-1 / samples)), out)
    return out


def correlate(x: Array, y: Array) -> float:
    """Return the correlation of two signals, 0 where one is constant."""
    x, y = x - x.mean(), y - y.mean()
    power = float((x @ x) * (y @ y))
    return float(x @ y) / power**0.5 if power > 0 else 0.0


@compiled
def _filter_lag(values: Array, keeps: float, out: Array) -> None:
    state = 0.0
    for n in range(values.size):
        state = keeps * state + (1 - keeps) * values[n]
        if abs(state) < MIN_DECAYED_VALUE:
            state = 0.0
        out[n] = state
