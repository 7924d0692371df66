"""Keep back-EMF and damping of one sign where voltage and speed alone give the shape.

With te = L/R, ``be = (a1 - a2/te)/te`` is what viscous friction takes of a0 and ``K = a0 - be`` the
rest: ``0 <= be <= MOST_FRICTION a0``, and of the two windings that answer alike not the one that
would be slower than any rotor.  At either edge ``share a0 te^2 - a1 te + a2 = 0`` ties te to
the coefficients of the response; a step that would leave is taken along the edge (active set).

References
----------
Nocedal and Wright, Numerical Optimization, 2nd ed., section 16.5.
"""

import math

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.limits import MOST_FRICTION
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.structures import Structure

HAIR = 1e-9  # of a0 by which rounding may pass an edge
SLOWEST = 10.0  # a winding, times ``R J / K``: those of motors are faster than that itself
NEAR = 1e-6  # of a0 within which coordinates lie on one


def applies(structure: Structure) -> bool:
    """Tell whether te is free and no current says which of the shapes it is."""
    return structure.order == 2 and not structure.current and "ln_te" in structure.free


def passed(z: Coordinates) -> float | None:
    """Return the share of a0 at the edge that coordinates have passed, None within."""
    share, most = _share(z), MOST_FRICTION.value
    if share < -HAIR:
        return 0.0
    return most if share > most + HAIR or _slow(z.ln_te, z) else None


def at_edge(z: Coordinates) -> float | None:
    """Return the share of a0 at the edge on which coordinates lie, None within."""
    share = _share(z)
    return next((e for e in (0.0, MOST_FRICTION.value) if abs(share - e) < NEAR), None)


def _slow(ln_te: float, z: Coordinates) -> bool:
    """Tell whether a winding would be far slower than the rotor, ``te > 10 a2 / te``."""
    return bool(2 * ln_te > z.ln_a2 + math.log(SLOWEST))


def _share(z: Coordinates) -> float:
    """Return what share of a0 viscous friction takes."""
    te = np.float64(z.electrical_time_constant)
    return float((z.a1 - z.a2 / te) / te / z.a0)


def edge(z: Coordinates, share: float) -> tuple[float, dict[str, float]] | None:
    """Return ln te at an edge and its gradient by ln a0, ln a1, ln a2; None where there is none."""
    a0, a1, a2 = z.a0, z.a1, z.a2
    if share == 0.0:
        return z.ln_a2 - z.ln_a1, {"ln_a0": 0.0, "ln_a1": -1.0, "ln_a2": 1.0}
    root = a1 * a1 - 4 * share * a0 * a2
    if root <= 0.0:
        return None
    larger = a1 + math.sqrt(root)  # a difference would lose a short winding to rounding
    both = 2 * a2 / larger, larger / max(2 * share * a0, 5e-324)
    if not min(both) > 0.0:  # a step that runs away leaves no lag that a number can hold
        return None
    te = float(min(both, key=lambda x: (_slow(math.log(x), z), abs(math.log(x) - z.ln_te))))
    slope = a1 * te - 2 * share * a0 * te * te
    if slope == 0.0:
        return None
    by = {"ln_a0": share * a0 * te * te / slope, "ln_a1": -a1 * te / slope, "ln_a2": a2 / slope}
    return math.log(te), by


def within(z: Coordinates) -> Coordinates:
    """Return coordinates brought back to the edge that they have passed."""
    share = passed(z)
    there = None if share is None else edge(z, share)
    return z if there is None else z.with_(ln_te=there[0])


def tied(structure: Structure, z: Coordinates, share: float) -> tuple[Array, Array] | None:
    """Return the steps that stay on an edge: ``step = ties @ free + first``."""
    there = edge(z, share)
    if there is None:
        return None
    free = structure.free
    i = free.index("ln_te")
    ties = np.delete(np.eye(len(free)), i, axis=1)
    for j, coordinate in enumerate(c for c in free if c != "ln_te"):
        ties[i, j] = there[1].get(coordinate, 0.0)
    first = np.zeros(len(free))
    first[i] = there[0] - z.ln_te
    return ties, first
