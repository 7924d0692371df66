# SPDX-License-Identifier: Apache-2.0
"""The driver of a chain as a loop sees it: from its command to the voltage at the terminals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident._compile import compiled
from smp_motor_ident.chain.chain import Chain
from smp_motor_ident.simulate import lanes as at
from smp_motor_ident.simulate.driver import terminal_voltage

DEAD_ZONE, CLIP, RATE, WEAK, FULL_DUTY, EMF_SHARE, LEAST = range(7)


@dataclass(frozen=True, eq=False)
class Driver:
    """A driver with its limits.

    Attributes
    ----------
    numbers : ndarray, shape (7,)
        Dead zone [V], clip [V], rate [V/s], weakness in reverse, command of full duty [V], the
        share of a0 that is back-EMF, and the least effective command [V].
    lane : ndarray, shape (parameters,)
        As in `simulate.lanes`.
    """

    numbers: Array
    lane: Array

    @property
    def threshold(self) -> float:
        """Largest command [V] without output."""
        return float(self.numbers[DEAD_ZONE] + self.lane[at.DROP])

    @property
    def limit(self) -> float:
        """Largest voltage [V] that it puts out."""
        return float(self.numbers[CLIP])

    @property
    def slew(self) -> float:
        """Fastest change of its voltage [V/s]."""
        return float(self.numbers[RATE])

    @property
    def drive(self) -> float:
        """Largest voltage [V] beyond the back-EMF, to which it limits the current."""
        return float(self.lane[at.CURRENT_LIMIT])


def make_driver(chain: Chain, largest: float, supply: float) -> Driver:
    """Return the driver of a chain that was identified with commands up to ``largest`` [V]."""
    values = chain.values
    lane = chain.lanes({n: np.array([v]) for n, v in values.items()}, 1)[:, 0].copy()
    lane[[at.DECLINE, at.FRICTION_DRIFT, at.LOAD_STEP]] = 0.0
    ramp = values.get("ramp_time", 0.0)
    numbers = np.array([
        values.get("dead_zone", 0.0),
        values.get("clip_voltage", np.inf),
        largest / ramp if ramp > 0 else np.inf,
        values.get("weak_side", 0.0),
        max(supply, largest) or 1.0,
        1.0 - values.get("viscous", 0.0),
        values.get("least_command", 0.0),
    ])  # fmt: skip
    return Driver(numbers, lane)


def make_ideal_driver() -> Driver:
    """Return a driver that puts out its command."""
    return Driver(np.array([0.0, np.inf, np.inf, 0.0, 1.0, 1.0, 0.0]), at.NEUTRAL.copy())


@compiled
def apply_driver(
    numbers: Array, lane: Array, command: float, back_emf: float, before: float, interval: float
) -> tuple[float, float]:
    """Return the mean voltage at the terminals over an interval, and the command at its end [V].

    ``back_emf``: voltage [V] that the speed needs if it runs steadily.  ``before``: the ramped
    command at the beginning of the interval.
    """
    u = command - min(max(command, -numbers[DEAD_ZONE]), numbers[DEAD_ZONE])
    if abs(command) < numbers[LEAST]:
        u = 0.0
    if u < 0.0:
        u *= 1.0 - numbers[WEAK]
    u = min(max(u, -numbers[CLIP]), numbers[CLIP])
    end = u
    if numbers[RATE] < np.inf:
        most = numbers[RATE] * interval
        end = before + min(max(u - before, -most), most)
        share = min(abs(u - before) / most, 1.0) if most > 0.0 else 1.0
        u = end - 0.5 * (end - before) * share
    emf = numbers[EMF_SHARE] * back_emf
    return terminal_voltage(u, emf, 0.0, numbers[FULL_DUTY], lane), end
