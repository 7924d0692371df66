"""The voltage of a driver that depends on how the motor runs, which runs as that voltage says.

Section by section of the command, the motor's exact response under the mean of that section.
Derivation: docs/derivations.md, section 13.
"""

from __future__ import annotations

import numpy as np

from smp_motor_control.arrays import Array, Flags
from smp_motor_ident._compile import compiled
from smp_motor_ident.likelihood.current_sensor import STATE
from smp_motor_ident.likelihood.events import STUCK
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.recursion import move
from smp_motor_ident.likelihood.sensitivities import begin, tabulate
from smp_motor_ident.model.columns import LOAD
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.driver import Driver, terminal_voltage
from smp_motor_ident.model.structures import Structure

TURNS = 4  # in which the mean speed of a section and its voltage agree


def terminal_voltages(
    data: Experiments, structure: Structure, z: Coordinates, initial: Array, driver: Driver
) -> Array:
    """Return the mean voltage of each section of the command [V], without a measured current."""
    par, _ = structure.internal(z)
    first = np.zeros(data.hold_end.size, dtype=np.bool_)
    first[data.hold_start[:-1]] = True
    friction = structure.friction != "none"
    return _follow(
        driver, data.hold_end, data.hold_value, first, par, z.a0, initial, friction, data.jittered
    )


@compiled
def _follow(
    driver: Driver, end: Array, command: Array, first: Flags, par: Array, a0: float,
    initial: Array, friction: bool, usual: float,
) -> Array:  # fmt: skip
    m, cache, marks, scratch = begin(np.zeros((12, 0)), np.zeros(0, dtype=np.int64), friction)
    table = tabulate(usual, par, m, cache, marks, scratch)
    x, after = np.zeros(STATE), np.zeros(STATE)
    out = command.copy()
    g, load, direction, now = -1, 0.0, 1.0, 0.0
    for k in range(command.shape[0]):
        h, now = end[k] - now, end[k]
        if first[k]:
            g += 1
            x[0], x[1] = initial[g, 0], initial[g, 1]
            load = par[LOAD] + initial[g, 3]
            direction = 1.0
            if friction:
                direction = STUCK if x[1] == 0.0 else (1.0 if x[1] > 0.0 else -1.0)
        elif h > 0.0:
            slack = 1e-9 * h + 1e-15 * abs(now)
            middle, turned = x[1], direction
            for turn in range(TURNS):
                before = out[k]
                out[k], _ = terminal_voltage(driver, command[k], a0 * middle, command[k], h)
                if turn > 0 and out[k] == before:
                    break
                after[:] = x
                turned = move(
                    h, slack, out[k], direction, load, friction, par, after, m, cache, marks,
                    table, scratch, False,
                )  # fmt: skip
                middle = 0.5 * (x[1] + after[1])
            x[:] = after
            direction = turned
    return out
