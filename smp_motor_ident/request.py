# SPDX-License-Identifier: Apache-2.0
"""Validate a user's request for an estimate."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from smp_motor_control.motor.parameters import PHYSICAL
from smp_motor_ident.chain.catalogue import GIVEN
from smp_motor_ident.chain.chain import Constraint
from smp_motor_ident.errors import ParameterError
from smp_motor_ident.fit.search import SelectionPolicy
from smp_motor_ident.limits import MIN_CURRENT_SHARE
from smp_motor_ident.record import Record

MODELS = ("first_order", "second_order", "electromechanical")
LOSSES = {"linear": np.inf, "huber": 2.0}
FIXABLE = (*PHYSICAL, *GIVEN)


@dataclass(frozen=True)
class Request:
    """The arguments of `estimate`, checked."""

    model: str  # ``auto`` or one of `MODELS`
    known: Mapping[str, float]  # values given by the user, including an ohmmeter's resistance
    bounds: Mapping[str, tuple[float, float]]  # limits of physical parameters
    loss: str  # one of `LOSSES`
    validation: Sequence[Record] | None  # held-out records
    say: Callable[[str], None]  # receives the name of each step
    use_current: bool  # whether the current is an output of the model
    window: float = 0.0  # over which a recorded speed is known to be averaged [s]

    @property
    def policy(self) -> SelectionPolicy:
        """Return the policy of the search."""
        forced = self.model != "auto"
        given = {n: v for n, v in self.known.items() if n in GIVEN}
        if self.window > 0 and not {"averaging_window", "sensor_lag"} & set(given):
            given["averaging_window"] = self.window
        return SelectionPolicy(
            max_rounds=0 if forced else SelectionPolicy.max_rounds,
            restarts=not forced,
            first_order=self.model == "first_order",
            given=given,
        )

    @property
    def constraints(self) -> tuple[Constraint, ...]:
        """Return the known values and limits of the motor's quantities."""
        exact = {n: (v, v) for n, v in self.known.items() if n in PHYSICAL}
        if not self.use_current:
            exact = {n: (v, v) for n, v in self._list_separating_quantities()}
        limits = {**self.bounds, **exact}
        return tuple(Constraint(n, low, high) for n, (low, high) in limits.items())

    def _list_separating_quantities(self) -> Iterator[tuple[str, float]]:
        """Yield the quantities that separate the parameters without a current."""
        resistance, inductance, constant = (
            self.known.get(n) for n in ("resistance", "inductance", "motor_constant")
        )
        if resistance and inductance:
            yield "electrical_time_constant", inductance / resistance
        if resistance and constant:
            yield "back_emf_constant", constant

    @property
    def may_leave_current(self) -> bool:
        """Whether the request allows an estimate without the current."""
        return self.use_current and self.model == "auto" and not self.bounds

    def without_current(self, group: Sequence[Record]) -> tuple[list[Record], Request]:
        """Return the records without their current, and the request for them."""
        bare = [replace(r, current=None) for r in group]
        return bare, replace(self, known=_add_ohmmeter(self.known, bare), use_current=False)


def check_request(
    group: Sequence[Record],
    model: str,
    fixed: Mapping[str, float] | None,
    bounds: Mapping[str, tuple[float, float]] | None,
    loss: str,
    validation: Sequence[Record] | None,
    progress: Callable[[str], None] | None,
) -> Request:
    """Check the arguments of `estimate` and return them."""
    if not group:
        raise ParameterError("estimate needs at least one record")
    if model not in ("auto", *MODELS):
        raise ParameterError(f"model {model!r} is not one of auto, {', '.join(MODELS)}")
    if loss not in LOSSES:
        raise ParameterError(f"loss {loss!r} is not one of {', '.join(LOSSES)}")
    known = dict(fixed or {})
    for name, value in known.items():
        if name not in FIXABLE:
            raise ParameterError(f"fixed {name!r} is not one of {', '.join(FIXABLE)}")
        positive = name in (*PHYSICAL[:4], *GIVEN) and name != "delay"
        if not np.isfinite(value) or value < 0 or (positive and value == 0):
            raise ParameterError(f"fixed {name} = {value} is impossible for a motor")
    wheels = {r.wheel for r in group}
    if len(wheels) > 1:
        raise ParameterError(f"records of one motor are needed, got {', '.join(sorted(wheels))}")
    _check_outputs(group)
    _check_bounds(bounds or {}, model, group)
    use_current = has_current(group) and model in ("auto", "electromechanical")
    if model == "electromechanical" and not use_current:
        raise ParameterError("model 'electromechanical' needs a recorded current")
    return Request(
        model, _add_ohmmeter(known, group), bounds or {}, loss, validation,
        progress or (lambda _: None), use_current, max(r.velocity_window for r in group),
    )  # fmt: skip


def _add_ohmmeter(known: Mapping[str, float], group: Sequence[Record]) -> dict[str, float]:
    ohmmeter = group[0].hardware.resistance
    if "resistance" not in known and ohmmeter and np.isfinite(ohmmeter) and not has_current(group):
        return {**known, "resistance": float(ohmmeter)}
    return dict(known)


def _check_outputs(group: Sequence[Record]) -> None:
    speed_alone = next((r for r in group if r.count is None and r.position is None), None)
    no_speed = next((r for r in group if r.velocity is None), None)
    if speed_alone and no_speed:
        raise ParameterError(
            f"{no_speed.source or 'a record'} has no speed and {speed_alone.source or 'another'} "
            "neither angle nor counts: records that are estimated together need a common signal; "
            "estimate these separately"
        )


def _check_bounds(
    bounds: Mapping[str, tuple[float, float]], model: str, group: Sequence[Record]
) -> None:
    for name, limits in bounds.items():
        if name not in PHYSICAL:
            raise ParameterError(f"bounds of {name!r}; the name must be of {', '.join(PHYSICAL)}")
        if len(limits) != 2 or not limits[0] <= limits[1]:
            raise ParameterError(
                f"bounds of {name} = {limits}; it must be two numbers, the lower one first"
            )
        if model not in ("auto", "electromechanical") or not has_current(group):
            raise ParameterError(
                f"bounds of {name}: voltage and speed alone do not determine it; record the "
                "current too, or leave the bounds out"
            )


def has_current(group: Sequence[Record]) -> bool:
    """Return whether a current was measured in enough samples."""
    there = [r.current for r in group if r.current is not None]
    finite = sum(int(np.isfinite(c).sum()) for c in there)
    enough = finite > MIN_CURRENT_SHARE * sum(len(r) for r in group)
    return enough and any(np.nanstd(c) > 0 for c in there)
