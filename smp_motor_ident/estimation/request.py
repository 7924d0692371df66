"""What a user asks of an estimate, held against what can be asked; the structure to begin with."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from smp_motor_control.motor.parameters import PHYSICAL
from smp_motor_ident.diagnosis.limits import CURRENT_THERE
from smp_motor_ident.errors import ParameterError
from smp_motor_ident.estimation.driver_effect import DriverFit
from smp_motor_ident.estimation.fit import Options
from smp_motor_ident.model.driver import DECLARABLE
from smp_motor_ident.model.structures import (
    CANDIDATES,
    MODELS,
    Electromechanical,
    SecondOrder,
    Structure,
)
from smp_motor_ident.record import Record

LOSSES = {"linear": np.inf, "huber": 2.0}
SENSOR = ("averaging_window", "sensor_lag")
FIXABLE = (*PHYSICAL, "delay", *SENSOR, *DECLARABLE)


@dataclass(frozen=True)
class Request:
    """The arguments of `estimate`, checked."""

    model: str  # ``auto`` or a candidate structure
    # What the user holds fixed, the ohmmeter's resistance among it where nothing measures it
    known: Mapping[str, float]
    bounds: Mapping[str, tuple[float, float]]  # limits of physical parameters
    loss: str  # one of `LOSSES`
    validation: Sequence[Record] | None  # Held-out records
    say: Callable[[str], None]  # receives in words what is being done
    use_current: bool  # whether the current is an output of the model
    driver: DriverFit | None = None  # what the driver is taken to make of its command
    # Time at which the excitation of each record begins [s]; none where disturbances are left out
    since: tuple[float, ...] = ()
    suspected: bool = False  # whether the driver is sought although nothing is lacking
    loaded: bool = False  # whether every candidate has a constant load
    own_loads: bool = False  # whether every segment has a constant load of its own
    earlier: bool = False  # whether the command was taken an interval earlier

    @property
    def options(self) -> Options:
        """Return what a descent needs of it."""
        return Options(huber=LOSSES[self.loss])

    @property
    def within(self) -> bool:
        """Whether it is asked of a motor behind a driver, or without what disturbed it."""
        return self.driver is not None or not self.since

    @property
    def may_leave_current(self) -> bool:
        """Whether an answer without the current is an answer to what was asked."""
        return self.use_current and self.model == "auto" and not self.bounds

    def without_current(self, group: Sequence[Record]) -> "tuple[list[Record], Request]":
        """Return the records without their current, and the request for them."""
        bare = [replace(r, current=None) for r in group]
        known = _with_ohmmeter(self.known, bare)
        return bare, replace(self, known=known, use_current=False)


def checked(
    group: Sequence[Record],
    model: str,
    fixed: Mapping[str, float] | None,
    bounds: Mapping[str, tuple[float, float]] | None,
    loss: str,
    validation: Sequence[Record] | None,
    progress: Callable[[str], None] | None,
) -> Request:
    """Return the request; what makes no sense is refused."""
    if not group:
        raise ParameterError("estimate needs at least one record")
    if model != "auto" and model.removesuffix("_asymmetric") not in MODELS:
        raise ParameterError(f"model {model!r} is not one of auto, {', '.join(MODELS)}")
    if loss not in LOSSES:
        raise ParameterError(f"loss {loss!r} is not one of {', '.join(LOSSES)}")
    known = dict(fixed or {})
    for name, value in known.items():
        if name not in FIXABLE:
            raise ParameterError(f"fixed {name!r} is not one of {', '.join(FIXABLE)}")
        positive = name in (*PHYSICAL[:4], *SENSOR, *DECLARABLE)
        if not np.isfinite(value) or value < 0 or (positive and value == 0):
            raise ParameterError(f"fixed {name} = {value} is not a motor's")
    wheels = {r.wheel for r in group}
    if len(wheels) > 1:
        raise ParameterError(f"records of one motor are needed, got {', '.join(sorted(wheels))}")
    _check_outputs(group)
    _check_bounds(bounds or {}, model, group)
    use_current = has_current(group) and model in ("auto", "electromechanical")
    return Request(
        model, _with_ohmmeter(known, group), bounds or {}, loss, validation,
        progress or (lambda _: None), use_current,
    )  # fmt: skip


def _with_ohmmeter(known: Mapping[str, float], group: Sequence[Record]) -> dict[str, float]:
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
            "neither angle nor counts: records that are estimated together need one of them in "
            "common; estimate these apart"
        )


def _check_bounds(
    bounds: Mapping[str, tuple[float, float]], model: str, group: Sequence[Record]
) -> None:
    for name, limits in bounds.items():
        if name not in PHYSICAL:
            raise ParameterError(f"bounds of {name!r}: not one of {', '.join(PHYSICAL)}")
        if len(limits) != 2 or not limits[0] <= limits[1]:
            raise ParameterError(f"bounds of {name} = {limits}: two numbers, the lower one first")
        if model not in ("auto", "electromechanical") or not has_current(group):
            raise ParameterError(
                f"bounds of {name}: voltage and speed alone do not tell it; record the current "
                "too, or leave the bounds out"
            )


def has_current(group: Sequence[Record]) -> bool:
    """Tell whether a current was measured, often enough to tell something."""
    there = [r.current for r in group if r.current is not None]
    finite = sum(int(np.isfinite(c).sum()) for c in there)
    enough = finite > CURRENT_THERE.value * sum(len(r) for r in group)
    return enough and any(np.nanstd(c) > 0 for c in there)


def base_structure(request: Request, group: Sequence[Record]) -> Structure:
    """Return the structure that order selection begins with."""
    known, model, use_current = request.known, request.model, request.use_current
    fixed: dict[str, float] = {}
    if "resistance" in known and (use_current or "inductance" in known):
        fixed["ln_r"] = float(np.log(known["resistance"]))
    if "resistance" in known and "inductance" in known:
        fixed["ln_te"] = float(np.log(known["inductance"] / known["resistance"]))
    if "delay" in known:
        fixed["delay"] = known["delay"]
    low_pass = "sensor_lag" in known
    window = known.get("averaging_window", max(r.velocity_window for r in group))
    window = 2 * known["sensor_lag"] if low_pass else window
    if window > 0:
        fixed["window"] = window
    candidate = model.removesuffix("_asymmetric")
    asymmetric = model.endswith("_asymmetric")
    friction = "asymmetric" if asymmetric else "symmetric"
    own = request.own_loads
    load = (asymmetric or request.loaded) and not own
    if use_current:
        return Electromechanical(friction, load, low_pass=low_pass, fixed=fixed, own_load=own)
    if candidate in ("auto", "electromechanical"):
        candidate = "second_order"
    structure = CANDIDATES[candidate](friction, load, low_pass=low_pass, fixed=fixed, own_load=own)
    # How friction is felt depends on L/R, which the linear response leaves open.
    return structure.with_(shape=True) if isinstance(structure, SecondOrder) else structure
