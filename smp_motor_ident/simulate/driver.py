# SPDX-License-Identifier: Apache-2.0
"""Voltage at the motor's terminals where it depends on the motion."""

from __future__ import annotations

import math

from smp_motor_control.arrays import Array
from smp_motor_ident._compile import inlined
from smp_motor_ident.simulate.lanes import (
    CURRENT_LIMIT,
    DECAY,
    DECLINE,
    DROP,
    FREE,
    SAG,
)


@inlined
def _average_fast_decay(te: float, command: float, emf: float, supply: float) -> float:
    """Return the mean voltage of a bridge that is off for the rest of each PWM period [V].

    The current that rose meanwhile falls against the supply through the diodes until it is zero or
    the next period begins; without current the terminals show the back-EMF.  ``te``: electrical
    time constant in periods.
    """
    duty = min(abs(command) / supply, 1.0)
    along = emf if command > 0.0 else -emf
    drive, brake = supply - along, supply + along
    if drive <= 0.0 or brake <= 0.0:
        return command
    rise = drive * (1.0 - math.exp(-duty / te))
    fall = min(te * math.log1p(rise / brake), 1.0 - duty)
    mean = along + duty * drive - fall * brake
    return mean if command > 0.0 else -mean


@inlined
def terminal_voltage(
    command: float, emf: float, age: float, full_duty: float, lane: Array
) -> float:
    """Return the voltage at the terminals of a lane [V] for a command and a back-EMF [V]."""
    out: float = command * (1.0 - lane[DECLINE] * age)
    if command == 0.0:
        out += lane[FREE] * emf
        return out
    if lane[DECAY] > 0.0:
        out = _average_fast_decay(lane[DECAY], out, emf, full_duty)
    sag, drop, most = lane[SAG], lane[DROP], lane[CURRENT_LIMIT]
    if sag == 0.0 and drop == 0.0 and most == math.inf:
        return out
    drive: float = out - emf
    if sag != 0.0:
        duty = command / full_duty
        drive /= 1.0 + sag * duty * duty
    drive -= min(max(drive, -drop), drop)
    out = emf + min(max(drive, -most), most)
    return out
