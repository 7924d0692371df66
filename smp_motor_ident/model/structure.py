"""What all candidate structures share: which coordinates are free, and how the others hang on them.

A candidate structure is a class of its own, one file each: the coordinates of its response, the
parameters that the compiled pass runs with, what it separates, and where a fit of it begins.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.model.coordinates import NAMES, Coordinates, direction, place
from smp_motor_ident.model.measurement import LATE_SPEED, MEAN_SPEED, SPEED, Measurement, smoothed

S = TypeVar("S", bound="Structure")
Gradients = dict[str, tuple[float, Array]]
"""Values of quantities, each with its gradient by the coordinates, shape (12,)."""


class Regressions(Protocol):
    """Linear regressions on filtered data, of which a fit begins without any guess."""

    def speed(self, order: int, frictions: tuple[bool, ...]) -> list[Coordinates]:
        """Return motors of an order from voltage and speed, with friction or without."""

    def current(self) -> list[Coordinates]:
        """Return motors from voltage, speed and current."""


@dataclass(frozen=True)
class Structure(ABC):
    """A candidate structure of the motor, and what is added to it."""

    name: ClassVar[str]
    order: ClassVar[int]  # of the response from voltage to speed
    current: ClassVar[bool] = False  # whether current is an output; R is a coordinate then

    friction: str = "symmetric"  # none, symmetric or asymmetric
    # load, delay, window: whether these are coordinates
    load: bool = False
    delay: bool = False
    window: bool = False
    low_pass: bool = False  # whether a low-pass of half the window's lag stands in its place
    ticks: int = 0  # samples of the speed that a digital one takes a row
    mean: float = 0.0  # over which each of these is a mean, as a difference of counts is [s]
    late: bool = False  # whether the speed that was then, by the same lag, stands in its place
    # How the command ran: a row's value before it, after it, or interpolated from row to row
    held: str = "before"
    shift: float = 0.0  # by how much later than recorded such a command ran as a whole [s]
    own_load: bool = False  # whether every segment has a constant load of its own
    # Coordinates fixed at a value, by name
    fixed: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def like(cls: type[S], other: Structure, **changes: Any) -> S:
        """Return this candidate with all that another has and it can have."""
        shared = {f.name for f in fields(cls)} & {f.name for f in fields(other)}
        return cls(**{**{n: getattr(other, n) for n in shared}, **changes})

    def with_(self: S, **changes: Any) -> S:
        """Return a copy with some attributes changed."""
        return replace(self, **changes)

    def frictionless(self: S) -> S:
        """Return the same without Coulomb friction."""
        return self.with_(friction="none")

    @property
    def speed(self) -> Measurement:
        """What the sensor shows of the speed."""
        if not self.has("window"):
            return SPEED
        if self.late:
            return LATE_SPEED
        return smoothed(self.ticks, self.mean > 0) if self.low_pass else MEAN_SPEED

    @property
    def lags(self) -> bool:
        """Whether the measured current lags behind the current."""
        return False

    @cached_property
    def free(self) -> tuple[str, ...]:
        """Names of the free coordinates."""
        wanted = {*self._response(), *self._added()}
        return tuple(n for n in NAMES if n in wanted and n not in self.fixed)

    @abstractmethod
    def _response(self) -> tuple[str, ...]:
        """Return the coordinates of the response."""

    def _added(self) -> Iterator[str]:
        yield from {"none": (), "symmetric": ("vc_plus",)}.get(
            self.friction, ("vc_plus", "vc_minus")
        )
        yield from (n for n in ("load", "delay", "window") if getattr(self, n))

    @cached_property
    def matrix(self) -> Array:
        """Derivative of all coordinates by the free ones, shape (12, free), read-only."""
        m: Array = np.zeros((len(NAMES), len(self.free)))
        for j, name in enumerate(self.free):
            m[place(name), j] = 1.0
        if self.friction == "symmetric":
            m[place("vc_minus")] = m[place("vc_plus")]
        m = self._tied_steps(m)
        m.flags.writeable = False
        return m

    def _tied_steps(self, matrix: Array) -> Array:
        """Return the matrix with the ties of this structure."""
        return matrix

    def of_free(self, vector: Array) -> Array:
        """Return the part of a vector over all coordinates that is of the free ones, shape (f,)."""
        return vector[[place(n) for n in self.free]]

    def complete(self, z: Coordinates) -> Coordinates:
        """Return coordinates with the fixed and tied ones put to their values."""
        values = self._settled
        if self.friction == "symmetric":
            friction = values.get("vc_plus", z.vc_plus)
            values = {**values, "vc_plus": friction, "vc_minus": friction}
        return self._tied(z.with_(**values))

    @cached_property
    def _settled(self) -> dict[str, float]:
        """The coordinates that are fixed, or nothing."""
        absent = {"load", "current_offset", "delay", "current_lag"} - {*self._added()}
        values = {**dict.fromkeys(absent, 0.0), **self.fixed}
        return values | ({"vc_plus": 0.0, "vc_minus": 0.0} if self.friction == "none" else {})

    def _tied(self, z: Coordinates) -> Coordinates:
        """Return coordinates with the ties of this structure held."""
        return z

    @abstractmethod
    def internal(self, z: Coordinates) -> tuple[Array, Array]:
        """Return the parameters of the compiled pass and their derivative by the coordinates.

        The first four are te, tm, K, be, then follow the coordinates, R itself; shapes (12,) and
        (12, 12).
        """

    @property
    def size(self) -> int:
        """Number of parameters that the structure is charged for.

        Loops hold a command, which a log has before its row or after it: one that runs straight
        from row to row is an addition, as a parameter is.
        """
        return len(self.free) + (self.held == "interpolated")

    @property
    def title(self) -> str:
        """The name that a user asks for it by."""
        return self.name + ("_asymmetric" if self.friction == "asymmetric" else "")

    @property
    def label(self) -> str:
        """Name of the structure with what was added to it, in words."""
        added = [word for there, word in self._words() if there]
        return self.name + (" with " + ", ".join(added) if added else "")

    def _words(self) -> Iterator[tuple[bool, str]]:
        yield self.friction == "none", "no friction"
        yield self.friction == "asymmetric", "asymmetric friction"
        yield self.load, "load"
        yield self.delay, "delay"
        yield self.late, "late speed"
        yield self.window and not (self.low_pass or self.late), "averaged speed"
        yield self.window and self.low_pass and not self.ticks, "low-passed speed"
        of = "difference" if self.mean else "speed"
        yield self.window and self.ticks > 0, f"{of} smoothed {self.ticks} times a row"
        yield self.held == "after", "command held after its row"
        yield self.held == "interpolated", "command interpolated"

    def has(self, name: str) -> bool:
        """Tell whether a coordinate is part of the structure, free or fixed."""
        return name in self.free or name in self.fixed

    def combinations(self, z: Coordinates) -> Gradients:
        """Return what voltage and speed tell of the motor."""
        found = self._lags_of(z)
        reported = {
            "static_voltage": "vc_plus",
            "static_voltage_reverse": "vc_minus",
            "load_voltage": "load",
            "current_lag": "current_lag",
        }
        found |= {n: (z.value(c), direction(**{c: 1.0})) for n, c in reported.items()}
        late = 0.5 * self.late
        by_window = direction(window=float(not self.mean))
        found["averaging_window"] = self.mean or z.window, by_window
        found["delay"] = self.shift + z.delay + late * z.window, direction(delay=1.0, window=late)
        return found | {"sensor_lag": (0.5 * z.window, direction(window=0.5))}

    def _lags_of(self, z: Coordinates) -> Gradients:
        """Return the gain and the lags of the response."""
        return {
            "dc_gain": (z.dc_gain, direction(ln_a0=-z.dc_gain)),
            "time_constant": (
                z.time_constant,
                direction(ln_a1=z.time_constant, ln_a0=-z.time_constant),
            ),
        }

    def separates(self) -> Iterator[str]:
        """Return the combinations that this structure reports, in their order."""
        yield from self._reported_lags()
        yield "static_voltage"
        if self.friction == "asymmetric":
            yield "static_voltage_reverse"
        if self.load:
            yield "load_voltage"
        yield "steady_speed"
        if self.has("delay") or self.shift > 0 or self.late:
            yield "delay"
        if self.has("window") and not self.late:
            yield from ("sensor_lag",) * self.low_pass
            yield from ("averaging_window",) * (not self.low_pass or self.mean > 0)
        if self.lags:
            yield "current_lag"

    def _reported_lags(self) -> tuple[str, ...]:
        return "dc_gain", "time_constant"

    @abstractmethod
    def guesses(self, regressions: Regressions) -> list[Coordinates]:
        """Return motors at which a fit may begin."""

    @property
    def _frictions(self) -> tuple[bool, ...]:
        return (False,) if self.friction == "none" else (True, False)
