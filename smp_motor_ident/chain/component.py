# SPDX-License-Identifier: Apache-2.0
"""A link of the chain that produces a recording: parameters, effect, starting values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.finding import Severity
from smp_motor_ident.simulate.motion import Motion
from smp_motor_ident.simulate.rows import Rows

MIN_SECOND_LAG_SHARE = 0.005  # of the first lag, that another component may replace

Values = Mapping[str, Array]
"""Parameters by their names, each for every lane."""


@dataclass(frozen=True)
class Scales:
    """Sizes of a recording, which sizes of effects are relative to."""

    volts: float  # largest command [V]
    full_duty: float  # command [V] at which the driver is always on
    step: float  # interval between rows [s]
    speed: float  # largest speed at the motor shaft [rad/s]
    duration: float  # [s]
    lag: float  # time constant of the motor [s]
    amperes: float = 1.0  # largest current [A]
    sample: float = 0.0  # interval between rows as recorded [s]

    def of(self, unit: str) -> float:
        """Return the scale of a unit."""
        return {
            "ln": 1.0, "1": 1.0, "V": self.volts, "V/s": self.volts / self.lag, "s": self.lag,
            "row": self.step, "1/V": 1 / self.volts, "rad/s": self.speed, "A": self.amperes,
        }[unit]  # fmt: skip


@dataclass(frozen=True)
class Parameter:
    """A number of a component, in the coordinate in which it is fitted."""

    name: str
    unit: str  # of `Scales.of`
    low: float = -np.inf  # in that unit
    high: float = np.inf
    neutral: float = 0.0  # value without effect
    typical: float = 1.0  # standard deviation of the prior, in that unit
    threshold: bool = False  # whether it only tells which commands act

    def difference(self, scales: Scales) -> float:
        """Return the step of a finite difference."""
        return 1e-6 * scales.of(self.unit)

    def bounds(self, scales: Scales) -> tuple[float, float]:
        """Return its limits."""
        return self.low * scales.of(self.unit), self.high * scales.of(self.unit)


class Component:
    """A link of the chain.  Subclasses override the methods for their effects."""

    code: ClassVar[str]
    slot: ClassVar[str]
    title: ClassVar[str] = ""
    severity: ClassVar[Severity] = "note"  # of the finding that names it
    advice: ClassVar[str] = ""  # what to do about it
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    places: ClassVar[tuple[int, ...]] = ()  # in the simulation's lanes, of its first parameters
    # Sizes of its last parameter, in that one's unit, at which a fit with it may begin
    guesses: ClassVar[tuple[float, ...]] = ()
    prior: ClassVar[float] = 0.1  # probability of its presence in a recording
    rank: ClassVar[int] = 0  # place among the components that shape a command, the lowest first
    linear: ClassVar[str] = ""  # parameter that its effect is proportional to
    needs_own_start: ClassVar[bool] = False  # whether no fit without it leads to it
    lag: ClassVar[str] = ""  # parameter of its delay, if it can replace a lag
    lateness: ClassVar[float] = 1.0  # delay [s] of a size of that parameter of 1

    def list_priors(self, scales: Scales) -> Sequence[tuple[Mapping[str, float], float, float]]:
        """Return prior knowledge: weights of a sum of parameters, its mean and its deviation."""
        return ()

    def write(self, p: Values, lanes: Array) -> None:
        """Put parameters of the simulation, one column a lane."""
        for place, parameter in zip(self.places, self.parameters):
            lanes[place] = p[parameter.name]

    def shape_command(self, p: Values, command: Array, rows: Rows, scales: Scales) -> Array:
        """Return the voltage [V] that a driver makes of a command, shape (sections, lanes)."""
        return command

    def starts(self, scales: Scales) -> Sequence[Mapping[str, float]]:
        """Return sizes at which a fit with this component may begin."""
        last = self.parameters[-1:]
        return [{p.name: guess * scales.of(p.unit)} for p in last for guess in self.guesses]

    def starts_in(
        self, values: Mapping[str, float], scales: Scales
    ) -> Sequence[Mapping[str, float]]:
        """Return where a fit with this component begins in a chain of some values."""
        return self.starts(scales)

    def replace_second_lag(self, values: Mapping[str, float]) -> Mapping[str, float]:
        """Return values of a chain in which this component replaces most of the second lag.

        A component that the chain already has absorbs the lag, too.
        """
        if not self.lag or "ln_a2" not in values:
            return {}
        first, second = compute_lags(values)
        if second < MIN_SECOND_LAG_SHARE * first or second > 0.9 * first:
            return {}
        rest = max(first - second, 0.1 * first)
        ln_a1 = values["ln_a0"] + math.log(rest)
        return {
            self.lag: values.get(self.lag, 0.0) + second / self.lateness, "ln_a1": ln_a1,
            "ln_a2": ln_a1 + math.log(0.01 * rest),
        }  # fmt: skip


def compute_lags(values: Mapping[str, float]) -> tuple[float, float]:
    """Return the sum of a motor's lags and the shorter one [s]."""
    first = math.exp(values["ln_a1"] - values["ln_a0"])
    product = math.exp(values["ln_a2"] - values["ln_a0"]) if "ln_a2" in values else 0.0
    return first, 0.5 * (first - math.sqrt(max(first**2 - 4 * product, 0.0)))


class Sensor(Component):
    """The link that shows the motion, or the current."""

    needs_charge: ClassVar[bool] = False

    def sense(self, p: Values, motion: Motion, rows: Rows, scales: Scales) -> Array:
        """Return the recorded signal, shape (n, lanes)."""
        raise NotImplementedError
