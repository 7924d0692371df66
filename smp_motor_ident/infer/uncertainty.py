# SPDX-License-Identifier: Apache-2.0
"""Random uncertainty of the parameters: a sum of named contributions.

- ``noise``: least squares under the noise model;
- ``autocorrelation`` and ``regime``: scatter of the score between blocks of the record and between
  regimes of the motion, beyond chance (sandwich);
- one for every absent component: its effect, weighted by the probability of its presence.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.chain.chain import Chain
from smp_motor_ident.chain.component import Component
from smp_motor_ident.chain.motor import Delay, Friction
from smp_motor_ident.chain.quantities import REPORTED
from smp_motor_ident.fit.adequacy import scatters
from smp_motor_ident.fit.data import SEARCH_ROWS, Data
from smp_motor_ident.fit.descend import Fit, restate
from smp_motor_ident.fit.search import (
    SelectionPolicy,
    candidates,
    fit_roughly,
    relabelled,
    typical_size,
)
from smp_motor_ident.infer.levels import Levels
from smp_motor_ident.limits import TIMING_ACCURACY

SUPPORTED = 0.1  # probability from which a component is part of the random uncertainty
KNOWN = 100.0  # squared ratio of prior and posterior width from which the data show a size

DRIVER_SLOTS = (
    "dead_zone", "clip", "sag", "drop", "current_limit", "decay", "free", "slew", "drag",
)  # fmt: skip
"""Slots whose components take a part of the voltage that depends on its size."""


@dataclass(frozen=True, eq=False)
class Contribution:
    """One part of the covariance of the free parameters, shape (p, p)."""

    name: str
    covariance: Array
    unseen: Array | None = None  # shape (p,): systematic change by one standard deviation of it
    adds: Mapping[str, float] = field(default_factory=dict)  # to quantities that the chain lacks


def contributions(
    data: Data, found: Fit, levels: Levels, timing: float | None = None
) -> list[Contribution]:
    """Return all parts of the uncertainty; their sum does not depend on their order.

    ``timing``: accuracy of the instants of the readings [s].
    """
    parts = [*of_noise(found), *of_priors(found), *of_thresholds(data, found)]
    if levels.steady and "vc" in found.names:
        parts.append(of_one_level(found))
    for one in scatters(data, found):
        if one.significant:
            parts.append(Contribution(one.name, one.excess))
    some = data.thinned(SEARCH_ROWS)
    seen = found if some is data else restate(some, found)
    share = seen.linear.row.size / found.linear.row.size
    parts += considered(some, seen, bool(levels.one_size), 1 / share)
    parts += of_relabelled(some, seen)
    seconds = TIMING_ACCURACY * data.sample if timing is None else timing
    parts += of_timing(some, seen, seconds)
    return parts


def of_noise(found: Fit) -> list[Contribution]:
    """Return the covariance between repeated recordings."""
    m = found.linear.row.size
    columns = found.linear.columns[:m]
    half = found.covariance @ columns.T
    return [Contribution("noise", half @ half.T)]


def of_priors(found: Fit) -> list[Contribution]:
    """Return the contribution of the priors on motors.

    Together with the noise of the data it is the whole covariance of the fit.
    """
    m = found.linear.row.size
    nothing = np.zeros_like(found.covariance)
    shifts = found.linear.columns[m:] @ found.covariance
    thresholds = [p.name for p in found.chain.free if p.threshold]
    return [
        Contribution(name, nothing, shift)
        for name, shift in zip(found.priors, shifts, strict=True)
        if name not in thresholds
    ]


def of_thresholds(data: Data, found: Fit) -> Iterator[Contribution]:
    """Yield where a size of command that the driver tells from smaller ones may lie.

    It is anywhere between two commands of the recording, as the estimate is.
    """
    size = np.sort(np.abs(data.rows.command))
    for k, parameter in enumerate(found.chain.free):
        if parameter.threshold:
            at = int(np.searchsorted(size, found.chain.values[parameter.name]))
            lower, upper = size[max(at - 1, 0)], size[min(at, size.size - 1)]
            covariance = np.zeros_like(found.covariance)
            covariance[k, k] = (upper - lower) ** 2 / 6
            yield Contribution(parameter.name, covariance)


def of_one_level(found: Fit) -> Contribution:
    """Return the contribution of typical friction in a recording with one level of voltage.

    Only the instant of breaking away shows friction then, and a delay shifts it.
    """
    k = found.names.index("vc")
    (_, _, deviation) = Friction().expected(found.scales)[0]
    shift = found.covariance[:, k] / found.covariance[k, k]
    return Contribution("vc", np.zeros_like(found.covariance), shift * deviation)


def of_timing(data: Data, found: Fit, seconds: float) -> list[Contribution]:
    """Return what changes if the readings were taken so much later than their stamps say.

    A delay that is part of the chain takes that up.
    """
    if found.chain.has("delay"):
        return []
    late = 0.1 * data.sample
    r = found.residual(data, found.chain.with_component(Delay(), {"delay": late}))
    if r is None:
        return []
    m = found.linear.row.size
    signature = r - found.linear.residual[:m]
    shift = found.covariance @ (found.linear.columns[:m].T @ signature)
    return [Contribution("timing", np.zeros_like(found.covariance), -shift * seconds / late)]


def of_relabelled(data: Data, found: Fit) -> Iterator[Contribution]:
    """Yield what changes if another component stands for the motor's second lag.

    Both explain the data nearly alike, far apart, so that no derivative tells.  The likelihoods,
    and the priors of both, tell how probable the other is.
    """
    for one, chain in relabelled(found, data):
        other = fit_roughly(data, chain, found)
        odds = one.prior / (1 - one.prior)
        odds *= math.exp(min(0.5 * (found.linear.cost - other.linear.cost), 50.0))
        weight = math.sqrt(odds / (1 + odds))
        changes = []
        for p in found.chain.free:
            change = other.chain.values.get(p.name, 0.0) - found.chain.values[p.name]
            changes.append(math.expm1(change) if p.unit == "ln" else change)
        adds = {
            REPORTED[p.name]: weight * other.chain.values[p.name]
            for p in one.parameters
            if p.name in REPORTED and p.name not in found.names
        }
        nothing = np.zeros_like(found.covariance)
        yield Contribution(one.code, nothing, weight * np.array(changes), adds)


def considered(
    data: Data, found: Fit, one_size: bool = False, rows: float = 1.0
) -> list[Contribution]:
    """Return what each absent component would change, weighted by how probable it is.

    A component of size s moves the parameters by ``g s``.  The data put s at ``m`` with variance v,
    of a prior of variance t^2; it is there with the probability w that follows from the prior odds
    and the gain in likelihood: ``w g g^T (m^2 + v)``.  Of an effect that is proportional to its
    size, the smallest is taken.  Where the voltage has ``one_size``, an effect of the driver is
    systematic: it changes the gain, and only details of transients would show it.  ``rows``: rows
    of the recording for each row of the data.
    """
    policy = replace(SelectionPolicy(), extra=0.0)
    best: dict[str, tuple[float, float, Contribution]] = {}
    for one, chain in candidates(found, data):
        hidden = one_size and one.slot in DRIVER_SLOTS
        part = _considered(one, chain, data, found, policy, rows, hidden)
        small = typical_size(one, chain, found) if one.linear else 0.0
        if part is not None and (one.code not in best or (small, part[0]) > best[one.code][:2]):
            best[one.code] = small, *part
    return [part for *_, part in best.values()]


def _considered(
    one: Component,
    chain: Chain,
    data: Data,
    found: Fit,
    policy: SelectionPolicy,
    rows: float,
    hidden: bool,
) -> tuple[float, Contribution] | None:
    r = found.residual(data, chain)
    if r is None:
        return None
    base, m = found.linear.residual, found.linear.row.size
    signature = np.concatenate([r - base[:m], np.zeros(base.size - m)])
    columns = found.linear.columns
    shift = found.covariance @ (columns.T @ signature)  # of the parameters, for this size
    rest = signature - columns @ shift
    energy = float(rest @ rest)  # of the rows that are looked at
    unit = typical_size(one, chain, found)
    information = rows * energy * unit**2
    optimum = -float(rest @ base) / energy if energy > 0 else 0.0
    variance = 1 / (rows * energy + 1 / unit**2)
    size = optimum * energy / (energy + 1 / unit**2)
    if rows > 1.0:  # chance of fewer rows is no size
        size = math.sqrt(max(size**2 - 1 / (energy + 1 / unit**2), 0.0))
    gain = optimum**2 * energy
    if _one_sided(one) and optimum < 0:
        gain, size = 0.0, 0.0
    price = policy.price(one, information)
    weight = 1 / (1 + math.exp(min(max(0.5 * (price - gain), -50.0), 50.0)))
    shown = information**2 / (KNOWN**2 + information**2)  # share of the size that the data show
    spread = weight * shown * (size**2 + variance)
    unseen = (1 - shown) * unit**2
    if hidden or weight < SUPPORTED:  # the record does not speak for it, nor quite against it
        spread, unseen = 0.0, unseen + spread
    return weight, Contribution(
        one.code, spread * np.outer(shift, shift), shift * math.sqrt(unseen)
    )


def _one_sided(one: Component) -> bool:
    first = one.parameters[0] if one.parameters else None
    return first is not None and (first.low >= first.neutral or first.high <= first.neutral)
