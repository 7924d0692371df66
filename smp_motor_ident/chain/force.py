# SPDX-License-Identifier: Apache-2.0
"""Friction and loads other than Coulomb friction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from smp_motor_control.arrays import Array
from smp_motor_ident.chain.component import Component, Parameter, Scales, Values
from smp_motor_ident.simulate import lanes as at


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

    code, slot, title = (
        "friction_drift",
        "friction_drift",
        "friction that changes during the recording",
    )
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
