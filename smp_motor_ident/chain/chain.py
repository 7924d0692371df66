# SPDX-License-Identifier: Apache-2.0
"""The chain that produced a recording: its components with their values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.chain.component import Component, Parameter, Scales, Sensor
from smp_motor_ident.result import ChainRecord
from smp_motor_ident.simulate import lanes as at
from smp_motor_ident.simulate.motion import follows_motion, simulate
from smp_motor_ident.simulate.rows import Rows

PIECES_PER_LAG = 8.0
"""Pieces a time constant where the voltage follows the motion: it is held within a piece."""


@dataclass(frozen=True)
class Constraint:
    """A quantity of the motor that is known, or within limits."""

    quantity: str  # as in `chain.quantities`
    low: float
    high: float
    deviation: float = 1e-6  # relative, to which it is held


@dataclass(frozen=True)
class Chain:
    """Components of a recording, the value of every parameter, and which of them are given."""

    components: tuple[Component, ...]
    values: Mapping[str, float]
    fixed: frozenset[str] = field(default_factory=frozenset)
    constraints: tuple[Constraint, ...] = ()

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters of the components."""
        return tuple(p for c in self.components for p in c.parameters)

    @cached_property
    def free(self) -> tuple[Parameter, ...]:
        """The parameters that are estimated."""
        return tuple(p for p in self.parameters if p.name not in self.fixed)

    @property
    def codes(self) -> tuple[str, ...]:
        """Codes of the components."""
        return tuple(c.code for c in self.components)

    def has(self, code: str) -> bool:
        """Tell whether a component is part of the chain."""
        return code in self.codes

    def sensor(self, slot: str) -> Sensor | None:
        """Return the sensor in a slot."""
        return next((c for c in self.components if c.slot == slot and isinstance(c, Sensor)), None)

    def with_component(self, component: Component, values: Mapping[str, float]) -> Chain:
        """Return the chain with a component in place of the one in its slot, or added."""
        kept = [c for c in self.components if c.slot != component.slot]
        return self._of((*kept, component), {**self.values, **values})

    def without(self, code: str) -> Chain:
        """Return the chain without a component."""
        return self._of(tuple(c for c in self.components if c.code != code), self.values)

    def without_slot(self, slot: str) -> Chain:
        """Return the chain without the component of a slot."""
        return self._of(tuple(c for c in self.components if c.slot != slot), self.values)

    @property
    def record(self) -> ChainRecord:
        """The chain as plain data."""
        return ChainRecord(self.codes, dict(self.values))

    def _of(self, components: tuple[Component, ...], values: Mapping[str, float]) -> Chain:
        names = {p.name for c in components for p in c.parameters}
        return replace(
            self, components=components, values={n: v for n, v in values.items() if n in names}
        )

    def with_values(self, values: Mapping[str, float]) -> Chain:
        """Return the chain with other values of some parameters."""
        return replace(self, values={**self.values, **values})

    def lanes(self, values: Mapping[str, Array], count: int) -> Array:
        """Return the parameters of the simulation, one column for each set of values."""
        made = np.tile(at.NEUTRAL[:, None], (1, count))
        for component in self.components:
            component.write(values, made)
        return made


@dataclass(frozen=True, eq=False)
class Response:
    """Outputs of a chain for several sets of parameters, shape (n, lanes) each."""

    motion: Array
    current: Array | None


def respond(
    chain: Chain,
    values: Mapping[str, Array],
    rows: Rows,
    scales: Scales,
    initial: Array,
    own: Array | None = None,
) -> Response:
    """Simulate the recording of a chain.

    Parameters
    ----------
    chain : Chain
        Whose components are simulated.
    values : mapping of str to ndarray, shape (lanes,)
        Every parameter of the chain, for every lane.
    rows, scales : Rows, Scales
        Of the recording.
    initial : ndarray, shape (segments, 4)
        As in `simulate.motion.simulate`.
    own : ndarray, shape (4, lanes), optional
        Added by a lane to every segment's initial state.

    Returns
    -------
    Response
        Readings of the chain's sensors.
    """
    count = next(iter(values.values())).size
    lanes = chain.lanes(values, count)
    command = rows.command[:, None]
    for component in sorted(chain.components, key=lambda c: c.rank):
        command = component.shape_command(values, command, rows, scales)
    delays = values.get("delay", np.zeros(1))
    earliest = float(delays.min())
    speed, current = chain.sensor("speed sensor"), chain.sensor("current sensor")
    moving = bool((delays != earliest).any())
    longest = np.inf
    if follows_motion(lanes):
        lag = float(np.median(lanes[at.TM] / (lanes[at.K] + lanes[at.BE])))
        lag = min(lag, scales.duration) if lag > rows.step else rows.step
        longest = 2.0 ** round(math.log2(lag / PIECES_PER_LAG))
    pieces = rows.pieces(earliest, longest, moving)
    shift = delays - earliest if moving else np.zeros(count)
    motion = simulate(
        rows, pieces, lanes, command, initial, own, np.broadcast_to(shift, count).copy(),
        scales.full_duty, current is not None and current.needs_charge,
    )  # fmt: skip
    assert speed is not None
    return Response(
        speed.sense(values, motion, rows, scales),
        None if current is None else current.sense(values, motion, rows, scales),
    )
