"""What the sensors show of the state, and its derivatives.

Derivation: docs/derivations.md, sections 4 and 6.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident._compile import inlined
from smp_motor_ident.likelihood.internal import ANGLE, CURRENT_OFFSET, MEAN_SPEED, WINDOW, R
from smp_motor_ident.likelihood.lanes import D0, D1, LANES, SLOPE, SQ, ST, SW
from smp_motor_ident.likelihood.window import recall, remember

Array = NDArray[np.float64]

ON_OFFSET, ON_R = SLOPE + CURRENT_OFFSET * LANES, SLOPE + R * LANES
ON_WINDOW = SLOPE + WINDOW * LANES


@inlined
def observe(
    kind: int, k: int, first: int, t: float, par: Array, x: Array, m: Array, ring: Array,
    past: Array, columns: bool,
) -> float:  # fmt: skip
    """Return the mechanical output; put its derivative into D0."""
    if kind == MEAN_SPEED:
        remember(ring, k, t, x, m)
        width = par[WINDOW]
        p = past.shape[0] - 1
        speed = recall(ring, k, first, t - width, p, past)
        y = float((x[2] - past[0]) / width)
        for j in range(p):
            m[D0 + j] = (m[ST + j] - past[1 + j] + (speed - y) * m[ON_WINDOW + j]) / width
        return y
    if columns:
        if kind == ANGLE:
            for j in range(LANES):
                m[D0 + j] = m[ST + j]
        else:
            for j in range(LANES):
                m[D0 + j] = m[SW + j]
    return float(x[2] if kind == ANGLE else x[1])


@inlined
def observe_current(par: Array, x: Array, m: Array) -> float:
    """Return the current; put its derivative into D1."""
    amps = x[0] / par[R]
    for j in range(LANES):
        m[D1 + j] = m[SQ + j] / par[R] + m[ON_OFFSET + j] - amps * m[ON_R + j]
    return float(amps + par[CURRENT_OFFSET])


@inlined
def note(row: Array, speed: float, y0: float, y1: float) -> None:
    """Put into a row what it has room for: the output; speed, output (and current)."""
    if row.shape[0] == 1:
        row[0] = y0
        return
    row[0], row[1] = speed, y0
    if row.shape[0] > 2:
        row[2] = y1
