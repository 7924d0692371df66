"""The physical parameters of a motor and its coordinates: one from the other."""

from __future__ import annotations

import numpy as np

from smp_motor_ident.model.coordinates import Coordinates, direction
from smp_motor_ident.model.second_order import internal
from smp_motor_ident.model.structure import Gradients


def physical(z: Coordinates) -> dict[str, float]:
    """Return the physical parameters of a second-order structure."""
    return {n: value for n, (value, _) in physical_gradients(z).items()}


def physical_gradients(z: Coordinates) -> Gradients:
    """Return the physical parameters of a second-order structure and their gradients.

    ``L = R te``, ``K = a0 - be``, ``J = tm K/R``, ``b = be K/R``, ``Tc = Vc K/R``.
    """
    par, slope = internal(z)
    te, tm, k, be = par[:4]
    r = float(np.exp(z.ln_r))
    dln_r, dk, dbe = direction(ln_r=1.0), slope[2], slope[3]
    per = k / r
    dper = dk / r - per * dln_r
    found = {
        "resistance": (r, r * dln_r),
        "inductance": (r * te, r * te * direction(ln_r=1.0, ln_te=1.0)),
        "motor_constant": (k, dk),
        "inertia": (tm * per, tm * per * slope[1] + tm * dper),
        "viscous_friction": (be * per, dbe * per + be * dper),
        "coulomb_friction": (z.vc_plus * per, direction(vc_plus=per) + z.vc_plus * dper),
        "coulomb_friction_reverse": (z.vc_minus * per, direction(vc_minus=per) + z.vc_minus * dper),
    }
    return {n: (float(v), g) for n, (v, g) in found.items()}


def from_physical(
    resistance: float,
    inductance: float,
    motor_constant: float,
    inertia: float,
    viscous_friction: float,
    coulomb_friction: float = 0.0,
) -> Coordinates:
    """Return the coordinates of a motor."""
    r, k = resistance, motor_constant
    te, tm, be = inductance / r, r * inertia / k, r * viscous_friction / k
    found = Coordinates(
        ln_a0=np.log(k + be),
        ln_a1=np.log(tm + te * be),
        ln_a2=np.log(max(te * tm, 1e-300)),
        ln_te=np.log(max(te, 1e-300)),
        ln_r=np.log(r),
    )
    return found.with_friction(r * coulomb_friction / k)
