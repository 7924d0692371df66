# SPDX-License-Identifier: Apache-2.0
"""Random uncertainty of the parameters: a sum of named contributions.

- ``noise``: least squares under the noise model;
- ``autocorrelation`` and ``regime``: scatter of the score between blocks of the record and between
  regimes of the motion, beyond chance (sandwich);
- one for every absent component: its effect, weighted by the probability of its presence.

A recording with few sizes or directions of voltage leaves more of them open.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.chain.component import Component
from smp_motor_ident.chain.motor import Delay, Friction
from smp_motor_ident.chain.quantities import REPORTED
from smp_motor_ident.chain.sensor import LowPassedSpeed
from smp_motor_ident.fit.adequacy import Scatter
from smp_motor_ident.fit.data import MIN_SEARCH_ROWS, Data
from smp_motor_ident.fit.descend import Fit, evaluate_on_rows
from smp_motor_ident.fit.search import (
    Effect,
    SelectionPolicy,
    exchange_lags,
    fit_alternative,
    measure_effects,
    replace_second_lag,
)
from smp_motor_ident.limits import LEVEL_TOLERANCE, MAX_REST_VOLTAGE, TIMING_ACCURACY

MIN_SWINGS = 6
MAX_STEP_SHARE = 0.2  # of the rows, in which a command of steps changes

MIN_COASTING_SPEED_SHARE = 0.2  # of the largest speed


@dataclass(frozen=True)
class Levels:
    """Levels of a command [V]; 0 where there are several."""

    one_size: float  # the only size, both ways or one way, or that of the only swing
    one_step: float  # the only size of its steps
    steady: float  # the only level besides zero, with its sign
    one_way: bool  # whether it drives in one direction only


def detect_levels(data: Data) -> Levels:
    """Return the levels of a recording's command."""
    command = data.rows.command
    one_way = not command.min() < 0 < command.max()
    size = _find_only_size(command)
    steady = 0.0
    if size and one_way and not _has_coasting(data):
        steady = float(command[np.argmax(np.abs(command))])
    return Levels(size or _find_only_swing(data), _find_only_step(command), steady, one_way)


def _has_coasting(data: Data) -> bool:
    """Tell whether the motor runs down without voltage, which shows its friction."""
    speed, off = np.abs(data.speed), data.rows.mean_command == 0.0
    fast = speed > MIN_COASTING_SPEED_SHARE * float(np.nanquantile(speed, 0.98))
    return int((off & fast).sum()) >= 3


def _find_only_size(command: Array) -> float:
    """Return the only size of a command besides zero; a row between two levels is no third."""
    top = float(np.abs(command).max())
    other = (top - np.abs(command) > LEVEL_TOLERANCE * top) & (
        np.abs(command) > MAX_REST_VOLTAGE * top
    )
    change = np.diff(command)
    between = (change[:-1] * change[1:] > 0) & ~other[:-2] & ~other[2:]
    other[1:-1] &= ~between
    return 0.0 if other.any() else top


def _find_only_swing(data: Data) -> float:
    """Return the peak of a command that swings there and back always as far and as long."""
    command, begin = data.rows.command, data.rows.begin
    turns = np.flatnonzero(np.diff(command >= 0)) + 1
    if turns.size < MIN_SWINGS:
        return 0.0
    peaks = np.maximum.reduceat(np.abs(command), turns)[:-1]
    lengths = np.diff(begin[turns])
    peak, length = float(np.median(peaks)), float(np.median(lengths))
    alike = (np.abs(peaks - peak) < LEVEL_TOLERANCE * peak) & (
        np.abs(lengths - length) < LEVEL_TOLERANCE * length + 1.5 * data.rows.step
    )
    return peak if float(alike.mean()) > 1 - LEVEL_TOLERANCE else 0.0


def _find_only_step(command: Array) -> float:
    change = np.abs(np.diff(command))
    steps = change[change > MAX_REST_VOLTAGE * float(np.abs(command).max())]
    if not MIN_SWINGS <= steps.size < MAX_STEP_SHARE * change.size:
        return 0.0
    size = float(np.median(steps))
    alike = np.abs(steps - size) < LEVEL_TOLERANCE * size
    return size if float(alike.mean()) > 1 - LEVEL_TOLERANCE else 0.0


MIN_SUPPORTED_PROBABILITY = 0.1  # of a component in the random uncertainty
MAX_LEFT_SECOND_LAG = 0.1  # of the motor's second lag, where another component replaces it
MIN_SHOWN_VARIANCE_RATIO = 100.0  # prior over posterior variance of a size that the data show

DRIVER_SLOTS = (
    "dead_zone", "clip", "sag", "drop", "current_limit", "decay", "free", "slew", "drag",
)  # fmt: skip
"""Slots of components that take a share of the voltage that depends on its size."""


@dataclass(frozen=True, eq=False)
class Contribution:
    """One part of the covariance of the free parameters, shape (p, p)."""

    name: str
    covariance: Array
    systematic_shift: Array | None = None  # shape (p,): change by one standard deviation
    adds: Mapping[str, float] = field(default_factory=dict)  # shifts of absent quantities


def collect_contributions(
    data: Data,
    found: Fit,
    levels: Levels,
    scatters: Sequence[Scatter],
    timing: float | None = None,
) -> list[Contribution]:
    """Collect all parts of the uncertainty; their sum does not depend on their order.

    ``timing``: accuracy of the instants of the readings [s].
    """
    parts = [*assess_noise(found), *assess_priors(found), *assess_thresholds(data, found)]
    if levels.steady and "vc" in found.names:
        parts.append(assess_one_level(found))
    for one in scatters:
        if one.significant:
            parts.append(Contribution(one.name, one.excess))
    some = data.thin(MIN_SEARCH_ROWS)
    seen = found if some is data else evaluate_on_rows(some, found)
    share = seen.linear.data.row.size / found.linear.data.row.size
    parts += assess_absent_components(some, seen, bool(levels.one_size), 1 / share)
    parts += assess_second_lag_alternatives(some, seen)
    seconds = TIMING_ACCURACY * data.sample if timing is None else timing
    parts += assess_timing(some, seen, seconds)
    return parts


def assess_noise(found: Fit) -> list[Contribution]:
    """Return the covariance between repeated recordings."""
    m = found.linear.data.row.size
    columns = found.linear.columns[:m]
    half = found.covariance @ columns.T
    return [Contribution("noise", half @ half.T)]


def assess_priors(found: Fit) -> list[Contribution]:
    """Return the contribution of the priors on motors.

    Together with the noise of the data it is the whole covariance of the fit.
    """
    m = found.linear.data.row.size
    nothing = np.zeros_like(found.covariance)
    shifts = found.linear.columns[m:] @ found.covariance
    thresholds = [p.name for p in found.chain.free if p.threshold]
    return [
        Contribution(name, nothing, shift)
        for name, shift in zip(found.prior_causes, shifts, strict=True)
        if name not in thresholds
    ]


def assess_thresholds(data: Data, found: Fit) -> Iterator[Contribution]:
    """Yield the uncertainty of thresholds between two commands of the recording."""
    size = np.sort(np.abs(data.rows.command))
    for k, parameter in enumerate(found.chain.free):
        if parameter.threshold:
            at = int(np.searchsorted(size, found.chain.values[parameter.name]))
            lower, upper = size[max(at - 1, 0)], size[min(at, size.size - 1)]
            covariance = np.zeros_like(found.covariance)
            covariance[k, k] = (upper - lower) ** 2 / 6
            yield Contribution(parameter.name, covariance)


def assess_one_level(found: Fit) -> Contribution:
    """Return the contribution of typical friction in a recording with one level of voltage.

    Only the instant of breaking away shows friction then, and a delay shifts it.
    """
    k = found.names.index("vc")
    (_, _, deviation) = Friction().list_priors(found.scales)[0]
    shift = found.covariance[:, k] / found.covariance[k, k]
    return Contribution("vc", np.zeros_like(found.covariance), shift * deviation)


def assess_timing(data: Data, found: Fit, seconds: float) -> list[Contribution]:
    """Return the change of the parameters if readings are later than their stamps.

    A delay in the chain absorbs it.
    """
    if found.chain.has("delay"):
        return []
    late = 0.1 * data.sample
    r = found.residual(data, found.chain.with_component(Delay(), {"delay": late}))
    if r is None:
        return []
    m = found.linear.data.row.size
    signature = r - found.linear.residual[:m]
    shift = found.covariance @ (found.linear.columns[:m].T @ signature)
    return [Contribution("timing", np.zeros_like(found.covariance), -shift * seconds / late)]


def assess_second_lag_alternatives(data: Data, found: Fit) -> Iterator[Contribution]:
    """Yield the change of the parameters if another component replaces the second lag.

    Both fit nearly alike with distant parameters, so derivatives do not show it.  The other is
    weighted by its prior and by the ratio of the likelihoods.  Where the chain has the component
    already, the deviance between both replaces that of the quadratic approximation.  A low-pass may
    also exchange its lag with the motor.
    """
    values = found.chain.values
    others = [(one, chain, False) for one, chain in replace_second_lag(found, data)]
    if found.chain.has(LowPassedSpeed.code):
        others += [(one, chain, True) for one, chain in exchange_lags(found)]
    for one, chain, exchanged in others:
        least = min(chain.values["ln_a2"], values["ln_a2"] + math.log(MAX_LEFT_SECOND_LAG))
        other = fit_alternative(data, chain.with_values({"ln_a2": least}), found)
        if other is None:
            continue
        difference = other.linear.cost - found.linear.cost
        change = np.array([other.chain.values.get(n, 0.0) - values[n] for n in found.names])
        if found.chain.has(one.code) and not exchanged:
            quadratic = float(change @ found.linear.normal @ change)
            weight = math.sqrt(max(1 / max(difference, 1.0) - 1 / max(quadratic, 1.0), 0.0))
        else:
            odds = 1.0 if exchanged else one.prior / (1 - one.prior)
            odds *= math.exp(min(-0.5 * difference, 50.0))
            weight = math.sqrt(odds / (1 + odds))
        units = np.array([p.unit for p in found.chain.free])
        change = np.where(units == "ln", np.expm1(change), change)
        adds = {
            REPORTED[p.name]: weight * other.chain.values[p.name]
            for p in one.parameters
            if p.name in REPORTED and p.name not in found.names
        }
        nothing = np.zeros_like(found.covariance)
        yield Contribution(one.code, nothing, weight * change, adds)


def assess_absent_components(
    data: Data, found: Fit, one_size: bool = False, rows: float = 1.0
) -> list[Contribution]:
    """Return the bias by each absent component, weighted by the probability of its presence.

    A component of size s moves the parameters by ``g s``.  The data put s at ``m`` with variance v,
    of a prior of variance t^2; it is there with the probability w that follows from the prior odds
    and the gain in likelihood: ``w g g^T (m^2 + v)``.  Of an effect that is proportional to its
    size, the smallest is taken.  Where the voltage has ``one_size``, an effect of the driver is
    systematic: it changes the gain, and only details of transients would show it.  ``rows``: rows
    of the recording for each row of the data.
    """
    best: dict[str, tuple[float, float, Contribution]] = {}
    for effect in measure_effects(found, data):
        one = effect.component
        hidden = one_size and one.slot in DRIVER_SLOTS
        part = _weigh_effect(effect, rows, hidden)
        small = effect.prior_std if one.linear else 0.0
        if one.code not in best or (small, part[0]) > best[one.code][:2]:
            best[one.code] = small, *part
    return [part for *_, part in best.values()]


def _weigh_effect(effect: Effect, rows: float, hidden: bool) -> tuple[float, Contribution]:
    """Return the probability of an absent component and its contribution."""
    one, energy, unit, optimum = effect.component, effect.energy, effect.prior_std, effect.optimum
    variance_ratio = rows * energy * unit**2
    variance = 1 / (rows * energy + 1 / unit**2)
    size = optimum * energy / (energy + 1 / unit**2)
    if rows > 1.0:  # chance in fewer rows
        size = math.sqrt(max(size**2 - 1 / (energy + 1 / unit**2), 0.0))
    gain = optimum**2 * energy
    if _is_one_sided(one) and optimum < 0:
        gain, size = 0.0, 0.0
    price = SelectionPolicy(extra_price=0.0).price(one, variance_ratio)
    weight = 1 / (1 + math.exp(min(max(0.5 * (price - gain), -50.0), 50.0)))
    shown = variance_ratio**2 / (MIN_SHOWN_VARIANCE_RATIO**2 + variance_ratio**2)
    spread = weight * shown * (size**2 + variance)
    hidden_variance = (1 - shown) * unit**2
    if hidden or weight < MIN_SUPPORTED_PROBABILITY:  # neither supported nor excluded
        spread, hidden_variance = 0.0, hidden_variance + spread
    covariance = np.asarray(spread * np.outer(effect.shift, effect.shift), np.float64)
    return weight, Contribution(one.code, covariance, effect.shift * math.sqrt(hidden_variance))


def _is_one_sided(one: Component) -> bool:
    first = one.parameters[0] if one.parameters else None
    return first is not None and (first.low >= first.neutral or first.high <= first.neutral)
