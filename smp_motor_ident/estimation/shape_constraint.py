"""Keep back-EMF and damping of one sign where voltage and speed alone give the shape.

With te = L/R, ``be = (a1 - a2/te)/te`` is what viscous friction takes of a0 and ``K = a0 - be`` the
rest: ``0 <= be <= MOST_FRICTION a0``, and of the two windings that answer alike not the one that
would be slower than any rotor.  At either edge ``share a0 te^2 - a1 te + a2 = 0`` ties te to
the coefficients of the response; a step that would leave is taken along the edge (active set).

References
----------
Nocedal and Wright, Numerical Optimization, 2nd ed., section 16.5.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.diagnosis.limits import MOST_FRICTION
from smp_motor_ident.model.structures import A0, A1, A2, TE, Structure

Array = NDArray[np.float64]

HAIR = 1e-9  # of a0 by which rounding may pass an edge
SLOWEST = 10.0  # a winding, times ``R J / K``: those of motors are faster than that itself
NEAR = 1e-6  # of a0 within which coordinates lie on one


def applies(structure: Structure) -> bool:
    """Tell whether te is free and no current says which of the shapes it is."""
    return structure.order == 2 and not structure.current and TE in structure.free()


def passed(z: Array) -> float | None:
    """Return the share of a0 at the edge that coordinates have passed, None within."""
    share, most = _share(z), MOST_FRICTION.value
    if share < -HAIR:
        return 0.0
    return most if share > most + HAIR or _slow(z[TE], z) else None


def at_edge(z: Array) -> float | None:
    """Return the share of a0 at the edge on which coordinates lie, None within."""
    share = _share(z)
    return next((e for e in (0.0, MOST_FRICTION.value) if abs(share - e) < NEAR), None)


def _slow(ln_te: float, z: Array) -> bool:
    """Tell whether a winding would be far slower than the rotor, ``te > 10 a2 / te``."""
    return bool(2 * ln_te > z[A2] + math.log(SLOWEST))


def _share(z: Array) -> float:
    """Return what share of a0 viscous friction takes."""
    a0, a1, a2, te = np.exp(z[[A0, A1, A2, TE]])
    return float((a1 - a2 / te) / te / a0)


def edge(z: Array, share: float) -> tuple[float, Array] | None:
    """Return ln te at an edge and its gradient by ln a0, ln a1, ln a2; None where there is none."""
    a0, a1, a2 = np.exp(z[: A2 + 1])
    if share == 0.0:
        return float(z[A2] - z[A1]), np.array([0.0, -1.0, 1.0])
    root = a1 * a1 - 4 * share * a0 * a2
    if root <= 0.0:
        return None
    larger = a1 + math.sqrt(root)  # a difference would lose a short winding to rounding
    both = 2 * a2 / larger, larger / (2 * share * a0)
    te = float(min(both, key=lambda x: (_slow(math.log(x), z), abs(math.log(x) - z[TE]))))
    slope = a1 * te - 2 * share * a0 * te * te
    if slope == 0.0:
        return None
    return math.log(te), np.array([share * a0 * te * te, -a1 * te, a2]) / slope


def within(z: Array) -> Array:
    """Return coordinates brought back to the edge that they have passed."""
    share = passed(z)
    there = None if share is None else edge(z, share)
    if there is None:
        return z
    back = z.copy()
    back[TE] = there[0]
    return back


def tied(structure: Structure, z: Array, share: float) -> tuple[Array, Array] | None:
    """Return the steps that stay on an edge: ``step = ties @ free + first``."""
    there = edge(z, share)
    if there is None:
        return None
    free = structure.free()
    i = free.index(TE)
    ties = np.delete(np.eye(len(free)), i, axis=1)
    for j, coordinate in enumerate(c for c in free if c != TE):
        if coordinate in (A0, A1, A2):
            ties[i, j] = there[1][coordinate]
    first = np.zeros(len(free))
    first[i] = there[0] - z[TE]
    return ties, first
