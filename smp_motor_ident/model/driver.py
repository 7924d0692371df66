"""What drivers, and a drag, leave of a command, each by one number: a Hammerstein model's input.

Derivation: docs/derivations.md, section 13.

References
----------
E. Bai, Identification of linear systems with hard input nonlinearities of known structure,
Automatica 38 (2002), 853-860 (one number beside a linear system: separable least squares).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from smp_motor_control.arrays import Array, Flags
from smp_motor_ident._compile import compiled, inlined
from smp_motor_ident.diagnosis.sample_limits import LARGEST_DROP

NOTHING, DEAD_ZONE, CLIP, SLEW, SAG, DROP, COAST, CURRENT, FREE, DRAG = range(10)
COASTING = (COAST, FREE)
REST = 0.05
"""Back-EMF of a motor that begins at rest, of the largest command at most."""


class Driver(NamedTuple):
    """One effect and its size."""

    kind: int = NOTHING
    size: float = 0.0
    full_duty: float = 1.0  # command [V] at which it is always on
    emf_share: float = 1.0  # of the voltage at steady speed that is back-EMF, not viscous friction
    diode_drop: float = 0.0  # over both diodes by which a bridge that is off lets a current on [V]

    @property
    def threshold(self) -> float:
        """Command [V] that it swallows before anything moves."""
        return self.size if self.kind in (DEAD_ZONE, DROP) else 0.0

    @property
    def limit(self) -> float:
        """Largest voltage [V] that it puts out."""
        return self.size if self.kind == CLIP else float("inf")

    @property
    def drive(self) -> float:
        """Largest voltage [V] beyond the back-EMF, to which it limits the current."""
        return self.size if self.kind == CURRENT else float("inf")

    @property
    def slew(self) -> float:
        """How fast its voltage changes at most [V/s]."""
        return self.size if self.kind == SLEW else float("inf")


@inlined
def _beyond(voltage: float, threshold: float) -> float:
    return voltage - min(max(voltage, -threshold), threshold)


@inlined
def _fast_decay(
    size: float, command: float, back_emf: float, supply: float, diodes: float
) -> float:
    """Return the mean voltage of a bridge that is off for the rest of each PWM period [V].

    The current that rose meanwhile falls against the supply, through the diodes, until it is none
    or the next period begins; without one the terminals show the back-EMF.  ``size``: the
    electrical time constant in periods.  ``diodes``: what they take [V].
    """
    duty = min(abs(command) / supply, 1.0)
    with_it = back_emf if command > 0 else -back_emf
    drive, brake = supply - with_it, supply + diodes + with_it
    if drive <= 0.0 or brake <= 0.0:  # beyond what the supply can reach: as if it braked
        return command
    rise = drive * (1.0 - math.exp(-duty / size))
    fall = min(size * math.log1p(rise / brake), 1.0 - duty)
    mean = with_it + duty * drive - fall * brake
    return mean if command > 0 else -mean


@compiled
def terminal_voltage(
    driver: Driver, command: float, back_emf: float, before: float, interval: float
) -> tuple[float, float]:
    """Return the mean voltage at the motor's terminals over an interval, and that at its end [V].

    ``back_emf``: what the speed needs if it runs steadily.  ``before``: the voltage at its
    beginning; only a slew limit remembers it.
    """
    kind, size, full_duty, share, diodes = driver
    steady, back_emf = back_emf, share * back_emf
    out = command
    if kind == DEAD_ZONE:
        out = _beyond(command, size)
    elif kind == CLIP:
        out = min(max(command, -size), size)
    elif kind == SLEW:
        step, most = command - before, size * interval
        end = before + min(max(step, -most), most)
        ramp = min(abs(step) / most, 1.0) if most > 0.0 else 1.0
        return end - 0.5 * (end - before) * ramp, end
    elif kind == SAG:  # a source's own resistance, which sees duty times the current
        duty = command / full_duty
        out = back_emf + (command - back_emf) / (1 + size * duty * duty)
    elif kind == DROP:
        out = back_emf + _beyond(command - back_emf, size)
    elif kind == CURRENT:
        out = back_emf + min(max(command - back_emf, -size), size)
    elif kind == COAST:
        out = _fast_decay(size, command, back_emf, full_duty, diodes)
    elif kind == FREE and command == 0.0:  # open: the terminals show the back-EMF
        out = back_emf
    elif kind == DRAG:  # a load that is as much less voltage; a search passes some of any size
        out = command - math.copysign(
            min(size * steady * steady, abs(command) + abs(steady)), steady
        )
    return out, out


@dataclass(frozen=True, eq=False)
class Rows:
    """A command, row by row, and how the motor runs meanwhile."""

    command: Array  # [V]
    back_emf: Array  # mean over each row's interval [V]
    interval: Array  # its length [s]
    first: Flags  # where a segment begins
    time_constant: float  # of the motor [s]
    supply: float = 0.0  # [V]; 0 where it is not known

    @property
    def top(self) -> float:
        """Largest command [V]."""
        return float(np.abs(self.command).max(initial=0.0)) or 1.0

    @property
    def full_duty(self) -> float:
        """Command [V] at which the driver is always on; the largest where that is not known."""
        return max(self.supply, self.top)

    def through(self, driver: Driver) -> Array:
        """Return the mean voltage at the terminals over each row's interval [V].

        A driver that remembers begins from nothing where the motor begins at rest.
        """
        rest = self.first & ~(np.abs(self.back_emf) >= REST * self.top)
        command = np.where(rest, 0.0, self.command) if driver.kind == SLEW else self.command
        return _through(driver, command, self.back_emf, self.interval, self.first)


@compiled
def _through(
    driver: Driver, command: Array, back_emf: Array, interval: Array, first: Flags
) -> Array:
    out = np.empty(command.shape[0])
    now = 0.0
    for k in range(command.shape[0]):
        if first[k]:
            now = command[k]
        out[k], now = terminal_voltage(driver, command[k], back_emf[k], now, interval[k])
    return out


@dataclass(frozen=True)
class DriverEffect:
    """One way in which the voltage at the terminals is not the command."""

    kind: int
    code: str  # of its finding
    quantity: str  # name of the number that it is described by
    cause: str
    # Sizes between which its own is looked for, in the unit or as shares of `scale`, the mildest
    # first: the motor behind each is where the search for the next begins
    shares: tuple[float, ...]

    def scale(self, rows: Rows) -> float:
        """Return what the shares are of."""
        if self.kind == SLEW:
            return rows.top / rows.time_constant
        if self.kind == DRAG:
            return 1 / rows.top
        return 1.0 if self.kind in (SAG, *COASTING) else rows.top

    def may_be(self, size: float, rows: Rows) -> bool:
        """Tell whether there is anything of it, and anything left of the command."""
        most = 2 * rows.top if self.kind == CURRENT else rows.top  # what brakes is twice as much
        if self.kind == DROP:
            most = min(most, LARGEST_DROP.value * rows.full_duty)
        return self.kind in (SLEW, SAG, DRAG, *COASTING) or size < most

    @property
    def follows_motion(self) -> bool:
        """Whether it depends on how the motor runs."""
        return self.feeds_back or self.kind == DRAG

    @property
    def feeds_back(self) -> bool:
        """Whether its voltage and the motion follow each other: it is sought with the motor."""
        return self.kind in (SAG, DROP, CURRENT, *COASTING)


EFFECTS = (
    DriverEffect(
        DEAD_ZONE, "dead_zone", "dead_zone", "a dead zone of the driver", (0.01, 0.03, 0.1, 0.3)
    ),
    DriverEffect(
        CLIP, "clip", "clip_voltage", "a command that is clipped at the supply",
        (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4),
    ),
    DriverEffect(
        SLEW, "slew", "slew_rate", "a driver that limits how fast the voltage rises",
        (30.0, 10.0, 5.5, 3.0, 1.8, 1.0, 0.55, 0.3, 0.18, 0.1),
    ),
    DriverEffect(
        SAG, "supply_sag", "source_resistance_ratio", "a supply that sags under load",
        (0.03, 0.1, 0.3, 1.0),
    ),
    DriverEffect(
        DROP, "brush_drop", "brush_drop", "a voltage drop over brushes or transistors",
        (0.01, 0.03, 0.1, 0.3),
    ),
    DriverEffect(
        CURRENT, "current_limit", "current_limit_voltage", "a driver that limits the current",
        (1.7, 1.2, 0.8, 0.5, 0.3, 0.15),
    ),
    DriverEffect(
        DRAG, "drag", "quadratic_drag", "a drag that grows with the square of the speed",
        (0.01, 0.03, 0.1, 0.3),
    ),
    DriverEffect(
        COAST, "coast", "fast_decay_ratio", "a driver that lets the motor coast (fast decay)",
        (0.05, 0.3, 1.0, 3.0, 30.0),
    ),
    DriverEffect(
        FREE, "coast", "coasting_share", "a driver that lets the motor coast at a command of zero",
        (1.0,),
    ),
)  # fmt: skip

RAMPS = tuple(e for e in EFFECTS if e.kind == SLEW)
"""What is no more than a delay to first order: it takes a search to see it."""

DRAGS = tuple(e for e in EFFECTS if e.kind == DRAG)
"""What is nearly a motor of another gain: beside torque noise it takes a search, too."""

AT_ONE_LEVEL = tuple(e for e in EFFECTS if e.kind in (FREE, DROP))
AT_ONE_SIZE = AT_ONE_LEVEL + DRAGS
"""What shows under one voltage, too, and under one size of it both ways, or one swing.

A limited current takes as long at each of steps of one size, and looks like a lag.
"""

DECLARABLE: Mapping[str, DriverEffect] = {e.quantity: e for e in EFFECTS if not e.follows_motion}
"""What a user may know of a driver: the command alone tells its voltage."""
