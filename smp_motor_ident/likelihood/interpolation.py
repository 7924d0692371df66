"""Propagators for jittered stamps: a polynomial over the interval's length instead of each anew.

The entries of a propagator and of its derivatives are exponentials of the length; over a
narrow range a polynomial through eight Chebyshev points gives them to rounding.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident._compile import compiled

Array = NDArray[np.float64]

NODES = 8
POINTS = np.cos(np.pi * (2 * np.arange(NODES) + 1) / (2 * NODES))
INVERSE = np.ascontiguousarray(np.linalg.inv(np.vander(POINTS, increasing=True)))
WIDEST = 0.2  # of the usual interval: half the range of lengths
NARROWEST = 0.02
SMALL = 0.1  # rate times half the range: (SMALL/2)^8 2/8! = 2e-15 is the error of the polynomial


@compiled
def half_range(step: float, te: float, tm: float, k: float, be: float) -> float:
    """Return half the range of lengths that a table may span, 0 where none is worth it."""
    # The norm of the dynamics in its symmetric scaling bounds both rates.
    rate = (k + be) / tm
    if te > 0.0:
        rate = 1 / te + be / tm + np.sqrt(k / (te * tm))
    half = min(WIDEST * step, SMALL / rate)
    return half if half >= NARROWEST * step else 0.0


@compiled
def expand(values: Array, table: Array) -> None:
    """Turn values at the points into coefficients of powers."""
    width = table.shape[0] // NODES
    table[:] = 0.0
    for k in range(NODES):
        for j in range(NODES):
            factor = INVERSE[k, j]
            for n in range(width):
                table[k * width + n] += factor * values[j * width + n]


@compiled
def evaluate(table: Array, u: float, out: Array, at: int) -> None:
    """Evaluate the polynomials.

    Parameters
    ----------
    table : ndarray, shape (NODES * n,)
        Of `expand`.
    u : float
        Where, -1 to 1.
    out : ndarray
        Overwritten from ``at`` on.
    at : int
        First entry.
    """
    width = table.shape[0] // NODES
    c1, c2, c3, c4 = table[width:], table[2 * width :], table[3 * width :], table[4 * width :]
    c5, c6, c7 = table[5 * width :], table[6 * width :], table[7 * width :]
    for n in range(width):
        high = c4[n] + u * (c5[n] + u * (c6[n] + u * c7[n]))
        out[at + n] = table[n] + u * (c1[n] + u * (c2[n] + u * (c3[n] + u * high)))
