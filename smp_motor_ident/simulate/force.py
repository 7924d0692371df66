# SPDX-License-Identifier: Apache-2.0
"""Forces on the rotor that depend on its motion, in volts."""

from __future__ import annotations

import math

from smp_motor_control.arrays import Array
from smp_motor_ident._compile import compiled
from smp_motor_ident.simulate.lanes import (
    DRAG,
    FRICTION_DRIFT,
    LOAD_STEP,
    LOAD_STEP_AT,
    STRIBECK,
    STRIBECK_SPEED,
    VC_MINUS,
    VC_PLUS,
)

SOON = 0.01
"""Share of the record within which a load sets in."""


@compiled
def extra_force(b: int, w: float, direction: float, age: float, lanes: Array) -> float:
    """Return the force [V] on lane ``b`` besides Coulomb friction and constant load."""
    f: float = lanes[DRAG, b] * w * abs(w)
    dry = lanes[VC_PLUS, b] if direction > 0.0 else -lanes[VC_MINUS, b] if direction < 0.0 else 0.0
    if lanes[STRIBECK, b] != 0.0:
        r = w / lanes[STRIBECK_SPEED, b]
        f += dry * lanes[STRIBECK, b] * math.exp(-r * r)
    f += dry * lanes[FRICTION_DRIFT, b] * age
    if lanes[LOAD_STEP, b] != 0.0:
        f += lanes[LOAD_STEP, b] * min(max((age - lanes[LOAD_STEP_AT, b]) / SOON + 0.5, 0.0), 1.0)
    return f
