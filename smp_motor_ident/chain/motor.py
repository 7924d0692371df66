# SPDX-License-Identifier: Apache-2.0
"""Winding, rotor and Coulomb friction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.chain.component import Component, Parameter, Scales, Values
from smp_motor_ident.simulate import lanes as at


def _expect_gain(scales: Scales) -> tuple[Mapping[str, float], float, float]:
    return {"ln_a0": 1.0}, math.log(scales.volts / scales.speed), 1.5


class FirstOrder(Component):
    """A motor without inductance: one time constant."""

    code, slot, title = "first_order", "motor", "first order"
    parameters = (Parameter("ln_a0", "ln"), Parameter("ln_a1", "ln"))

    def list_priors(self, scales: Scales) -> Sequence[tuple[Mapping[str, float], float, float]]:
        """Return that the largest command reaches about the largest speed."""
        return (_expect_gain(scales),)

    def write(self, p: Values, lanes: Array) -> None:
        """Put ``a1 w' + a0 w = v - F``."""
        lanes[at.TE], lanes[at.BE] = 0.0, 0.0
        lanes[at.K], lanes[at.TM] = np.exp(p["ln_a0"]), np.exp(p["ln_a1"])


class SecondOrder(Component):
    """A motor with inductance, described by its response from voltage to speed.

    ``a0 = K + be``, ``a1 = tm + te be``, ``a2 = te tm``.  ``viscous``: the share ``be/a0``, which
    voltage and speed show only where friction acts.
    """

    code, slot, title = "second_order", "motor", "second order"
    prior = 0.7
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("ln_a0", "ln"),
        Parameter("ln_a1", "ln"),
        Parameter("ln_a2", "ln"),
        Parameter("viscous", "1", 0.0, 0.99),
    )

    def write(self, p: Values, lanes: Array) -> None:
        """Put te, tm, K and be."""
        a0, a1, a2 = (np.exp(p[n]) for n in ("ln_a0", "ln_a1", "ln_a2"))
        be = p["viscous"] * a0
        root = np.sqrt(np.maximum(a1 * a1 - 4 * a2 * be, 0.0))
        tm = 0.5 * (a1 + root)
        lanes[at.TM], lanes[at.TE] = tm, a2 / tm
        lanes[at.K], lanes[at.BE] = a0 - be, be

    def list_priors(self, scales: Scales) -> Sequence[tuple[Mapping[str, float], float, float]]:
        """Return values of small motors: L/R of 0.003 to 0.15 time constants, some damping."""
        lag = {"ln_a2": 1.0, "ln_a1": -2.0, "ln_a0": 1.0}
        return _expect_gain(scales), (lag, math.log(0.02), 1.5), ({"viscous": 1.0}, 0.12, 0.12)


class Electromechanical(SecondOrder):
    """A motor whose current is recorded too: all physical parameters."""

    code, title = "electromechanical", "electromechanical"
    parameters = (*SecondOrder.parameters, Parameter("ln_r", "ln"))


class Friction(Component):
    """Coulomb friction, alike in both directions [V]."""

    code, slot, title = "friction", "friction", "Coulomb friction"
    linear = "vc"
    prior = 0.9
    parameters = (Parameter("vc", "V", 0.0, 1.0, typical=0.05),)
    guesses = (0.02, 0.1)  # of a good and of a poor gearbox

    def write(self, p: Values, lanes: Array) -> None:
        """Put friction in both directions."""
        lanes[at.VC_PLUS] = lanes[at.VC_MINUS] = p["vc"]

    def list_priors(self, scales: Scales) -> Sequence[tuple[Mapping[str, float], float, float]]:
        """Return values of geared motors."""
        return (({"vc": 1.0}, 0.05 * scales.volts, 0.15 * scales.volts),)


class Load(Component):
    """A constant load [V]."""

    code, slot, title = "load", "load", "constant load"
    needs_own_start = True
    linear = "load"
    prior = 0.3
    parameters = (Parameter("load", "V", -1.0, 1.0, typical=0.02),)
    guesses = (0.03, -0.2, 0.2)
    places = (at.LOAD,)


class Delay(Component):
    """A command that acts later than recorded [s]."""

    code, slot, title = "delay", "delay", "delay"
    linear = "delay"
    lag = "delay"
    prior = 0.3
    parameters = (Parameter("delay", "row", -8.0, 1000.0, typical=1.0),)
    guesses = (-1.0, 0.5, 1.0, 2.0, 4.0)
