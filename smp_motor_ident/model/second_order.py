"""A motor with a second lag: winding and rotor, seen through voltage and speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident._compile import compiled
from smp_motor_ident.model.columns import A0, A1, A2, LN_R, LN_TE
from smp_motor_ident.model.coordinates import Coordinates, direction, place
from smp_motor_ident.model.structure import Gradients, Regressions, Structure

SHORT = 1 / 20
"""Second lag that is tried where only a first was found, of that one."""


@dataclass(frozen=True)
class SecondOrder(Structure):
    """``a2 w'' + a1 w' + a0 w = v - F``, whose L/R shows by the shape of stick and slip at most."""

    name = "second_order"
    order = 2

    # Whether L/R is a coordinate; if not, be = 0 (te = a2/a1), the motor of equal response
    shape: bool = False

    def frictionless(self) -> SecondOrder:
        """Return the same without Coulomb friction, by which alone L/R shows."""
        return self.with_(friction="none", shape=False)

    def _response(self) -> tuple[str, ...]:
        return ("ln_a0", "ln_a1", "ln_a2", *(("ln_te",) if self.shape else ()))

    def _tied_steps(self, matrix: Array) -> Array:
        if not self.has("ln_te"):
            matrix[place("ln_te")] = matrix[place("ln_a2")] - matrix[place("ln_a1")]
        return matrix

    def _tied(self, z: Coordinates) -> Coordinates:
        return z if self.has("ln_te") else z.undamped()

    def internal(self, z: Coordinates) -> tuple[Array, Array]:
        """Return te, ``tm = a2/te``, ``K = a0 - be``, ``be = a1/te - a2/te^2`` and derivative."""
        return internal(z)

    @property
    def size(self) -> int:
        """Number of parameters that are charged for: without current L/R only shapes friction."""
        return super().size - ("ln_te" in self.free and not self.current)

    def _lags_of(self, z: Coordinates) -> Gradients:
        product = float(np.exp(z.ln_a2 - z.ln_a0))
        found = {"time_constant_product": (product, direction(ln_a2=product, ln_a0=-product))}
        return super()._lags_of(z) | found

    def _reported_lags(self) -> tuple[str, ...]:
        return "dc_gain", "time_constant", "time_constant_product"

    def guesses(self, regressions: Regressions) -> list[Coordinates]:
        """Return motors of the second order, or of the first with a short second lag."""
        found = regressions.speed(2, self._frictions)
        first = [] if found else regressions.speed(1, (True, False))
        return found or [z.with_second_lag(SHORT * z.time_constant) for z in first]


def internal(z: Coordinates) -> tuple[Array, Array]:
    """Return the parameters of a motor with a winding; what overflows becomes infinite."""
    par, slope = z.array.copy(), np.zeros((z.array.size,) * 2)
    _internal(par, slope)
    return par, slope


@compiled
def _internal(par: Array, slope: Array) -> None:
    for i in range(4, par.shape[0]):
        slope[i, i] = 1.0
    a0, a1 = np.exp(par[A0]), np.exp(par[A1])
    a2, te = np.exp(par[A2]), np.exp(par[LN_TE])
    par[LN_R] = np.exp(par[LN_R])
    slope[2, A0] = a0
    be = (a1 - a2 / te) / te
    par[0], par[1], par[2], par[3] = te, a2 / te, a0 - be, be
    slope[0, LN_TE] = slope[1, A2] = 1.0
    slope[1, LN_TE] = -1.0
    slope[3, A1], slope[3, A2] = a1 / te, -a2 / te**2
    slope[3, LN_TE] = -a1 / te + 2 * a2 / te**2
    slope[2, A1], slope[2, A2], slope[2, LN_TE] = -slope[3, A1], -slope[3, A2], -slope[3, LN_TE]
