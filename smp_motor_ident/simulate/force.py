# SPDX-License-Identifier: Apache-2.0
"""Forces on the rotor that depend on its motion, in volts."""

from __future__ import annotations

import math

from smp_motor_control.arrays import Array
from smp_motor_ident._compile import inlined
from smp_motor_ident.simulate.lanes import (
    DRAG,
    LOAD_STEP,
    LOAD_STEP_AT,
    STRIBECK,
    STRIBECK_SPEED,
)

LOAD_ONSET_SHARE = 0.01  # of the record, within which a load sets in


@inlined
def extra_force(w: float, dry: float, age: float, lane: Array) -> float:
    """Return the force [V] on a lane besides its Coulomb friction ``dry`` and constant load."""
    f = 0.0
    if lane[DRAG] != 0.0:
        f = lane[DRAG] * w * abs(w)
    if lane[STRIBECK] != 0.0:
        r = w / lane[STRIBECK_SPEED]
        f += dry * lane[STRIBECK] * math.exp(-r * r)
    if lane[LOAD_STEP] != 0.0:
        f += lane[LOAD_STEP] * min(
            max((age - lane[LOAD_STEP_AT]) / LOAD_ONSET_SHARE + 0.5, 0.0), 1.0
        )
    return f
