# SPDX-License-Identifier: Apache-2.0
"""Winding, rotor, friction and loads."""

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


class AsymmetricFriction(Component):
    """Coulomb friction that differs by direction [V]."""

    code, slot, title = "asymmetric_friction", "friction", "friction that differs by direction"
    parameters = (
        Parameter("vc", "V", 0.0, 1.0),
        Parameter("vc_reverse", "V", 0.0, 1.0),
    )
    places = (at.VC_PLUS, at.VC_MINUS)

    def starts_in(
        self, values: Mapping[str, float], scales: Scales
    ) -> Sequence[Mapping[str, float]]:
        """Return friction around that of both directions."""
        vc = max(values.get("vc", 0.0), 0.01 * scales.volts)
        return [{"vc": 1.3 * vc, "vc_reverse": 0.7 * vc}, {"vc": 0.7 * vc, "vc_reverse": 1.3 * vc}]


class Drag(Component):
    """A load by the square of the speed: volts per square of the volts of back-EMF [1/V]."""

    code, slot, title = "drag", "drag", "drag by the square of the speed"
    linear = "quadratic_drag"
    parameters = (Parameter("quadratic_drag", "1/V", 0.0, 5.0, typical=0.03),)

    def write(self, p: Values, lanes: Array) -> None:
        """Put the drag on the speed."""
        k = lanes[at.K] + lanes[at.BE]
        lanes[at.DRAG] = p["quadratic_drag"] * k * k

    def starts(self, scales: Scales) -> Sequence[Mapping[str, float]]:
        """Return slight and strong drag."""
        return [{"quadratic_drag": x / scales.volts} for x in (0.03, 0.2)]


class Stribeck(Component):
    """Friction that falls from standstill on: by a share, within a speed."""

    code, slot, title = "stribeck", "stribeck", "friction larger at standstill (Stribeck)"
    linear = "stribeck"
    parameters = (
        Parameter("stribeck", "1", 0.0, 10.0, typical=0.3),
        Parameter("stribeck_speed", "rad/s", 0.003, 0.5),
    )
    places = (at.STRIBECK, at.STRIBECK_SPEED)

    def starts(self, scales: Scales) -> Sequence[Mapping[str, float]]:
        """Return a share within a small and a larger speed."""
        return [{"stribeck": 0.4, "stribeck_speed": x * scales.speed} for x in (0.02, 0.08)]


class FrictionDrift(Component):
    """Friction that changes by a share over the recording."""

    code = slot = "friction_drift"
    title = "friction that changes during the recording"
    advice = "let the gearbox warm up before recording"
    linear = "friction_drift"
    parameters = (Parameter("friction_drift", "1", -0.95, 3.0, typical=0.1),)
    guesses = (-0.2,)  # it warms up
    places = (at.FRICTION_DRIFT,)


class LoadStep(Component):
    """A load [V] that begins at a share of the recording."""

    code, slot, title = "load_step", "load_step", "load that begins during the recording"
    severity = "warning"
    advice = "look for what brakes the motor from then on"
    linear = "load_step"
    needs_own_start = True
    parameters = (
        Parameter("load_step", "V", -1.0, 1.0, typical=0.05),
        Parameter("load_step_at", "1", 0.0, 1.0),
    )
    places = (at.LOAD_STEP, at.LOAD_STEP_AT)

    def starts(self, scales: Scales) -> Sequence[Mapping[str, float]]:
        """Return loads that begin early and late."""
        load = 0.03 * scales.volts
        return [{"load_step": load, "load_step_at": k / 8} for k in range(1, 8)]
