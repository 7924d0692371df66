"""A motor without inductance: gain, one lag, friction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident._compile import compiled
from smp_motor_ident.model.columns import A0, A1, LN_R
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.structure import Regressions, Structure


@dataclass(frozen=True)
class FirstOrder(Structure):
    """``a1 w' = v - a0 w - F``: what a motor shows whose L/R is far below the sampling interval."""

    name = "first_order"
    order = 1

    def _response(self) -> tuple[str, ...]:
        return "ln_a0", "ln_a1"

    def internal(self, z: Coordinates) -> tuple[Array, Array]:
        """Return te = 0, tm = a1, K = a0, be = 0 and their derivative."""
        par, slope = z.array.copy(), np.zeros((z.array.size,) * 2)
        _internal(par, slope)
        return par, slope

    def guesses(self, regressions: Regressions) -> list[Coordinates]:
        """Return motors of the first order, or of the second where there are none."""
        found = regressions.speed(1, self._frictions)
        return found or regressions.speed(2, (True, False))


@compiled
def _internal(par: Array, slope: Array) -> None:
    for i in range(4, par.shape[0]):
        slope[i, i] = 1.0
    a0, a1 = np.exp(par[A0]), np.exp(par[A1])
    par[LN_R] = np.exp(par[LN_R])
    par[0], par[1], par[2], par[3] = 0.0, a1, a0, 0.0
    slope[2, A0] = a0
    slope[1, A1] = 1.0
