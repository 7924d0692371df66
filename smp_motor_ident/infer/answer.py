# SPDX-License-Identifier: Apache-2.0
"""Quantities of a fitted chain with their random and systematic uncertainty.

Random: the sum of the contributions of `infer.uncertainty`.  Systematic: errors that no recording
shows (JCGM 100:2008, section 4.3.1, Type B): what rests on priors, absent components that the data
cannot tell from the motor, and the scale of the current's sensor.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_control.motor.parameters import PHYSICAL
from smp_motor_ident.chain.catalogue import find_component
from smp_motor_ident.chain.quantities import HIDDEN, jacobian
from smp_motor_ident.fit.data import Data
from smp_motor_ident.fit.descend import Fit
from smp_motor_ident.infer.uncertainty import DRIVER_SLOTS, Contribution, Levels
from smp_motor_ident.limits import CURRENT_ACCURACY, MAX_RELATIVE_STD, ONE_SIZE_ACCURACY
from smp_motor_ident.record import Hardware
from smp_motor_ident.result import NORMAL_95, UNITS, Quantity, Share, Systematic

SCALE_POWERS: Mapping[str, float] = {
    "resistance": -1.0, "inductance": -1.0, "inertia": 1.0, "viscous_friction": 1.0,
    "coulomb_friction": 1.0,
}  # fmt: skip
"""Powers of the current's scale: with a current s times as large the same motion and voltage are
those of R/s, L/s, s J, s b and s Tc, and of the same K."""
CAUSE_OF_PRIOR = {
    "window": "averaged_speed",
    "vc": "one_level", "viscous": "damping", "ln_a2": "second_lag", "ln_a0": "prior_gain",
}  # fmt: skip
"""Name of the systematic uncertainty by the prior of a parameter."""
MAX_SHARES = 3
MIN_SYSTEMATIC_SHARE = 1e-6  # of a number
MIN_STATED_RATIO = 0.25  # of a systematic to the random uncertainty


@dataclass(frozen=True, eq=False)
class Answer:
    """Quantities of a motor."""

    parameters: dict[str, Quantity]
    combinations: dict[str, Quantity]
    names: tuple[str, ...]  # of the covariance
    covariance: Array  # shape (n, n): random
    systematic: tuple[Systematic, ...]


def state_quantities(
    data: Data, found: Fit, parts: Sequence[Contribution], levels: Levels, hardware: Hardware,
    known: Mapping[str, float],
) -> Answer:  # fmt: skip
    """Return the quantities of a fit, and those that the data leave open.

    ``parts`` are the contributions to the uncertainty of the chain's parameters, ``known`` the
    values that the user fixed, by the names of `result.UNITS`.
    """
    separated = any(c.quantity in HIDDEN for c in found.chain.constraints)
    every, rows = jacobian(
        found.chain, levels.steady, known.get("resistance", 0.0) if separated else 0.0
    )
    stated = [k for k, name in enumerate(every) if name not in HIDDEN]
    values = {n: v for n, v in every.items() if n not in HIDDEN}
    rows = rows[stated]
    covariance = rows @ sum(p.covariance for p in parts) @ rows.T
    names = tuple(values)
    errors = _list_systematic(names, values, rows, parts, levels, hardware, found)
    systematic = tuple(_add_in_quadrature(errors))
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    made = {}
    for k, name in enumerate(names):
        if name in known:
            made[name] = Quantity(known[name], unit=UNITS[name], status="fixed")
            continue
        shares = _select_shares(name, values[name], float(std[k]), systematic)
        valid = {"voltage": (-levels.one_size, levels.one_size)} if levels.one_size else None
        holds_there = any(s.cause in ("one_size_of_voltage", "one_level") for s in shares)
        made[name] = _make_quantity(
            name, values[name], float(std[k]), shares, valid if holds_there else None
        )
    return Answer(
        {n: made.get(n, _make_unknown_quantity(n, known)) for n in PHYSICAL},
        {n: q for n, q in made.items() if n not in PHYSICAL},
        names, covariance, systematic,
    )  # fmt: skip


def _make_unknown_quantity(name: str, known: Mapping[str, float]) -> Quantity:
    if name in known:
        return Quantity(known[name], unit=UNITS[name], status="fixed")
    return Quantity(None, unit=UNITS[name], status="unidentifiable")


def _make_quantity(
    name: str, value: float, std: float, shares: tuple[Share, ...],
    valid: Mapping[str, tuple[float, float]] | None,
) -> Quantity:  # fmt: skip
    """Return one quantity, without a value if it is uncertain by more than half of itself."""
    low, high = value - NORMAL_95 * std, value + NORMAL_95 * std
    positive = name not in ("delay", "load_voltage", "steady_speed")
    low = max(low, 0.0) if positive else low
    made = Quantity(value, std, (low, high), UNITS[name], "estimated", shares, valid)
    of_priors = math.hypot(std, *(s.size for s in shares if s.cause in CAUSE_OF_PRIOR.values()))
    loose = name in WITHHELD_IF_LOOSE and of_priors > MAX_RELATIVE_STD * abs(value)
    if loose or not math.isfinite(std):
        ends = made.total_ci95 or (low, high)
        return Quantity(None, None, (max(ends[0], 0.0), ends[1]), UNITS[name], "unidentifiable")
    return made


WITHHELD_IF_LOOSE = ("time_constant_product", "inductance", "time_constant", "dc_gain")
"""Quantities without a value if they are uncertain by more than half of themselves."""


def _list_systematic(
    names: Sequence[str], values: Mapping[str, float], rows: Array,
    parts: Sequence[Contribution], levels: Levels, hardware: Hardware, found: Fit,
) -> Iterator[Systematic]:  # fmt: skip
    """Yield every systematic error and the change of every quantity by it."""
    for part in parts:
        if part.systematic_shift is None or not np.any(part.systematic_shift):
            continue
        moves = rows @ part.systematic_shift
        if "steady_speed" in names:  # which was observed, whatever the chain
            moves[names.index("steady_speed")] = 0.0
        cause = CAUSE_OF_PRIOR.get(part.name, part.name)
        component = find_component(part.name)
        if component is not None and component.slot in DRIVER_SLOTS and levels.one_size:
            cause = "one_size_of_voltage"
            if hardware.voltage_accuracy is not None:
                moves = moves * hardware.voltage_accuracy / ONE_SIZE_ACCURACY
        share = _find_largest_share(moves, values)
        if share > MIN_SYSTEMATIC_SHARE or part.adds:
            moved = dict(zip(names, map(float, moves))) | dict(part.adds)
            yield Systematic(cause, share, moved)
    if "ln_r" in found.names:
        accuracy = hardware.current_accuracy
        share = CURRENT_ACCURACY if accuracy is None else accuracy
        moves_of = {n: share * p * values[n] for n, p in SCALE_POWERS.items() if n in values}
        yield Systematic("current_scale", share, moves_of)


def _find_largest_share(moves: Array, values: Mapping[str, float]) -> float:
    shares = (abs(m / v) for m, v in zip(moves, values.values(), strict=True) if v)
    return float(max(shares, default=0.0))


def _add_in_quadrature(every: Iterator[Systematic]) -> Iterator[Systematic]:
    """Add errors of one cause in quadrature."""
    by_cause: dict[str, list[Systematic]] = {}
    for one in every:
        by_cause.setdefault(one.cause, []).append(one)
    for cause, some in by_cause.items():
        if len(some) == 1:
            yield some[0]
            continue
        names = {n: 0.0 for s in some for n in s.moves}
        moves = {n: math.hypot(*(s.moves.get(n, 0.0) for s in some)) for n in names}
        yield Systematic(cause, max(s.share for s in some), moves)


def _select_shares(
    name: str, value: float, std: float, systematic: Sequence[Systematic]
) -> tuple[Share, ...]:
    """Return the systematic uncertainties that are worth stating, the largest first."""
    made = [
        Share(s.cause, abs(s.moves[name] / value) if value else None, abs(s.moves[name]))
        for s in systematic
        if s.moves.get(name)
    ]
    made = [s for s in made if s.size > MIN_STATED_RATIO * std and s.size > 1e-4 * abs(value)]
    return tuple(sorted(made, key=lambda s: -s.size)[:MAX_SHARES])
