"""A motor that is faster than its samples: a gain and friction."""

from __future__ import annotations

from dataclasses import dataclass

from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.first_order import FirstOrder

INSTANTLY = -30.0
"""Logarithm of a lag [s] that shows in nothing."""


@dataclass(frozen=True)
class StaticGain(FirstOrder):
    """``a0 w = v - F``: the speed follows the voltage at once."""

    name = "static_gain"

    def _response(self) -> tuple[str, ...]:
        return ("ln_a0",)

    def _tied(self, z: Coordinates) -> Coordinates:
        return z.with_(ln_a1=z.ln_a0 + INSTANTLY)

    def _reported_lags(self) -> tuple[str, ...]:
        return ("dc_gain",)
