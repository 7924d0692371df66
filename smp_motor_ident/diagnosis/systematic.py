"""Systematic uncertainty (Type B): errors that leave no residual in any recording.

JCGM 100:2008 (GUM), section 4.3.  An error that is a symmetry of the motor's equations moves the
numbers without a trace in the data.  It is stated with each number and never merged with the
random uncertainty.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Literal

from smp_motor_ident.diagnosis.effects import EFFECTS
from smp_motor_ident.diagnosis.instrument_limits import (
    CURRENT_ACCURACY,
    ONE_SIZE_ACCURACY,
    TIMING_ACCURACY,
)
from smp_motor_ident.record import Hardware
from smp_motor_ident.result import Estimate, Quantity, Share, Systematic

BY_CURRENT: Mapping[str, float] = {
    "resistance": -1.0, "inductance": -1.0, "inertia": 1.0, "viscous_friction": 1.0,
    "coulomb_friction": 1.0, "coulomb_friction_reverse": 1.0,
}  # fmt: skip
"""``v = R i + L di/dt + K w`` and ``J dw/dt = K i - ...``: with a current that is s times too
large the same motion and voltage are those of R/s, L/s, s J, s b and s Tc, and of the same K."""
BY_VOLTAGE: Mapping[str, float] = {
    "dc_gain": -1.0, "static_voltage": 1.0, "static_voltage_reverse": 1.0, "load_voltage": 1.0,
    "motor_constant": 1.0, "resistance": 1.0, "inductance": 1.0, "inertia": 1.0,
    "viscous_friction": 1.0, "coulomb_friction": 1.0, "coulomb_friction_reverse": 1.0,
}  # fmt: skip
"""With a voltage that is s times as large the same motion and current are those of a motor with
s K, s R, s L, s J, s b and s Tc."""
BY_LAG: Mapping[str, float] = {
    "time_constant": 1.0, "time_constant_product": 1.0, "inertia": 1.0,
}  # fmt: skip
"""What a driver that answers slowly, or through a resistance, adds to the motor's own lag."""
BY_LOAD: Mapping[str, float] = {"static_voltage": -1.0, "coulomb_friction": -1.0}
"""What is a constant load's, one way, is none of the friction's."""
OF_ANYTHING = 1.0 / math.sqrt(3.0)
"""Root mean square of what is anything from nothing to all of it, each as likely."""


def of_current(hardware: Hardware) -> float:
    """Return how well the scale of a current is known, relative."""
    stated = hardware.current_accuracy
    return CURRENT_ACCURACY.value if stated is None else stated


def of_one_size(hardware: Hardware) -> float:
    """Return how well gain and lag at other voltages are known from one size of it, relative."""
    stated = hardware.voltage_accuracy
    return ONE_SIZE_ACCURACY.value if stated is None else stated


def of_timing(hardware: Hardware, sample_time: float) -> float:
    """Return how well it is known when a loop's instruments read [s]."""
    stated = hardware.timing_accuracy
    return TIMING_ACCURACY.value * sample_time if stated is None else stated


def with_systematic(estimate: Estimate) -> Estimate:
    """State with every number the systematic uncertainties that the findings name."""
    for one in _unseen(estimate):
        estimate = _stated(estimate, one)
    return estimate


def _unseen(estimate: Estimate) -> Iterator[Systematic]:
    """Yield the errors that the findings speak of, in the numbers that are estimated."""
    codes = {f.code for f in estimate.findings}
    hardware = estimate.hardware
    if "current_scale" in codes:
        yield _moved(estimate, "current_scale", of_current(hardware), BY_CURRENT)
    if "one_size_of_voltage" in codes:
        for by in (BY_VOLTAGE, BY_LAG):
            yield _moved(estimate, "one_size_of_voltage", of_one_size(hardware), by)
    if "one_direction" in codes:
        yield replace(_moved(estimate, "one_direction", OF_ANYTHING, BY_LOAD), one_sided=True)
    if _lag_is_open(estimate):
        share = estimate.evidence("second_lag", "shift_share")
        by = {"time_constant": -share, "time_constant_product": -1.0}
        yield _beyond_random(estimate, _moved(estimate, "second_lag", OF_ANYTHING, by))
    if "timing" in codes:
        yield from _mistimed(estimate, of_timing(hardware, estimate.sample_time))


def _moved(estimate: Estimate, cause: str, share: float, by: Mapping[str, float]) -> Systematic:
    known = {**estimate.parameters, **estimate.combinations}
    moves = {
        name: share * power * quantity.value
        for name, power in by.items()
        if (quantity := known.get(name)) is not None
        and quantity.status == "estimated"
        and quantity.value is not None
    }
    return Systematic(cause, share, moves)


def _lag_is_open(estimate: Estimate) -> bool:
    """Tell whether a second lag may be another's than a filter's, of which its odds are known.

    It is too long for a winding's, or the records show what the model lacks.
    """
    grave = {f.code for f in estimate.findings if f.severity != "note"}
    shown = any(f.code == "second_lag" for f in estimate.findings)
    return shown and bool(grave & {"second_lag", *(e.code for e in EFFECTS)})


def _beyond_random(estimate: Estimate, one: Systematic) -> Systematic:
    """Return what moves one way, and of that what the scatter does not hold already."""
    moves = {
        name: math.copysign(math.sqrt(max(move**2 - _std(estimate, name) ** 2, 0.0)), move)
        for name, move in one.moves.items()
    }
    return replace(one, moves=moves, one_sided=True)


def _mistimed(estimate: Estimate, seconds: float) -> Iterator[Systematic]:
    """Yield what is late by some seconds: a current is a longer L/R, all together a delay.

    ``v(t) = R i(t) + L i'(t) + K w(t)`` of a current that is read later by d is ``R i + (L + R d)
    i' + K w`` to first order.
    """
    late = {"inductance": "resistance", "time_constant_product": "time_constant"}
    moves = {name: seconds * estimate.value(of) for name, of in late.items()}
    for every in (moves, {"delay": seconds}):
        known = {**estimate.parameters, **estimate.combinations}
        there = {
            n: d for n, d in every.items()
            if (q := known.get(n)) is not None and q.status == "estimated" and q.value is not None
        }  # fmt: skip
        yield Systematic("timing", seconds / estimate.sample_time, there)


def _std(estimate: Estimate, name: str) -> float:
    quantity = estimate.combinations.get(name) or estimate.parameters[name]
    return quantity.std or 0.0


def _stated(estimate: Estimate, one: Systematic) -> Estimate:
    """Return the estimate with one more systematic error in the numbers that it moves."""
    if not any(one.moves.values()):
        return estimate
    size = estimate.evidence("one_size_of_voltage", "voltage")
    at = {"voltage": (-size, size)} if one.cause == "one_size_of_voltage" and size else None
    parameters, combinations = (
        {n: _with(q, one, one.moves[n], at) if one.moves.get(n) else q for n, q in group.items()}
        for group in (estimate.parameters, estimate.combinations)
    )
    return replace(
        estimate,
        parameters=parameters,
        combinations=combinations,
        systematic=(*estimate.systematic, one),
    )


def _with(
    quantity: Quantity, one: Systematic, move: float, at: Mapping[str, tuple[float, float]] | None
) -> Quantity:
    share = abs(move / quantity.value) if quantity.value else None
    side: Literal[-1, 0, 1] = 0 if not one.one_sided else 1 if move > 0 else -1
    added = Share(one.cause, share, abs(move), side)
    valid = quantity.valid if at is None else at
    return replace(quantity, systematic=(*quantity.systematic, added), valid=valid)
