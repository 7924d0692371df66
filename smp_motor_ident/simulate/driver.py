# SPDX-License-Identifier: Apache-2.0
"""Voltage at the motor's terminals where it depends on the motion."""

from __future__ import annotations

import math

from smp_motor_control.arrays import Array
from smp_motor_ident._compile import compiled, inlined
from smp_motor_ident.simulate.lanes import (
    CURRENT_LIMIT,
    DECAY,
    DECLINE,
    DIODES,
    DROP,
    FREE,
    SAG,
)


@inlined
def _fast_decay(te: float, command: float, emf: float, supply: float, diodes: float) -> float:
    """Return the mean voltage of a bridge that is off for the rest of each PWM period [V].

    The current that rose meanwhile falls against the supply through the diodes until it is zero or
    the next period begins; without current the terminals show the back-EMF.  ``te``: electrical
    time constant in periods.
    """
    duty = min(abs(command) / supply, 1.0)
    along = emf if command > 0.0 else -emf
    drive, brake = supply - along, supply + diodes + along
    if drive <= 0.0 or brake <= 0.0:
        return command
    rise = drive * (1.0 - math.exp(-duty / te))
    fall = min(te * math.log1p(rise / brake), 1.0 - duty)
    mean = along + duty * drive - fall * brake
    return mean if command > 0.0 else -mean


@compiled
def terminal_voltage(
    b: int, command: float, emf: float, age: float, full_duty: float, lanes: Array
) -> float:
    """Return the voltage at the terminals of lane ``b`` [V] for a command and a back-EMF [V]."""
    out: float = command * (1.0 - lanes[DECLINE, b] * age)
    if command == 0.0:
        out += lanes[FREE, b] * emf
        return out
    if lanes[DECAY, b] > 0.0:
        out = _fast_decay(lanes[DECAY, b], out, emf, full_duty, lanes[DIODES, b])
    drive: float = out - emf
    duty = command / full_duty
    drive /= 1.0 + lanes[SAG, b] * duty * duty
    drop = lanes[DROP, b]
    drive -= min(max(drive, -drop), drop)
    most: float = lanes[CURRENT_LIMIT, b]
    return emf + min(max(drive, -most), most)
