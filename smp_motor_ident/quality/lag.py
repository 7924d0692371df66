# SPDX-License-Identifier: Apache-2.0
"""A signal through a lag of the first order, sample by sample."""

from __future__ import annotations

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident._compile import compiled

DECAYED = 1e-100  # its square is still a normal number


def lagged(values: Array, samples: float) -> Array:
    """Return a signal through a lag of so many samples, from rest; unchanged for a lag of 0.

    Tails are set to zero before they become subnormal numbers, which slow
    ``scipy.signal.lfilter`` tenfold.
    """
    if samples == 0.0:
        return values
    out = np.empty(values.size)
    _lag(np.asarray(values, dtype=np.float64), float(np.exp(-1 / samples)), out)
    return out


@compiled
def _lag(values: Array, keeps: float, out: Array) -> None:
    state = 0.0
    for n in range(values.size):
        state = keeps * state + (1 - keeps) * values[n]
        if abs(state) < DECAYED:
            state = 0.0
        out[n] = state
