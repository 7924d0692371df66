# SPDX-License-Identifier: Apache-2.0
"""Search for the chain that produced a recording.

Every absent component is screened at once: it is simulated at the sizes at which a fit with it may
begin, and the part of the change that the other parameters do not take up tells its expected gain.
The best are fitted.  Components are added, exchanged and dropped at one price (`SelectionPolicy`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.chain.catalogue import (
    ANGLE_SENSORS,
    CURRENT_SENSORS,
    GIVEN,
    MOTORS,
    OPTIONAL,
    SPEED_SENSORS,
)
from smp_motor_ident.chain.chain import Chain, respond
from smp_motor_ident.chain.component import Component
from smp_motor_ident.chain.sensor import Angle, DifferencedSpeed, Speed
from smp_motor_ident.errors import CurrentError, InsufficientExcitationError
from smp_motor_ident.fit.adequacy import scatters
from smp_motor_ident.fit.data import Data
from smp_motor_ident.fit.descend import Fit, approach, descend, fit, fit_noises
from smp_motor_ident.fit.linear import Linear
from smp_motor_ident.fit.start import guesses

SEARCH_ORDER = 2
"""Order of the noise model during the search; a higher one would absorb missing components."""
RESOLVED = 1.1  # residual over the rounding of an encoder up to which it is rounding
CLEARLY = 0.3  # gain by screening over that of another's fit, below which a component waits for it
ROUGH = 0.3  # change of the deviance at which a fit of the search ends
ADEQUATE = 2.0  # disagreement between parts of a record, up to which a chain explains it
SAME = 1.0  # difference of the deviance up to which two fits are at one minimum
CERTAIN = 20.0  # deviations from none at which a component is needed without a fit that says so
NEEDED = ("friction", "asymmetric_friction")  # components that every motor has

Say = Callable[[str], None]


@dataclass(frozen=True)
class SelectionPolicy:
    """How components are chosen."""

    tried: int = 3  # components that are fitted after every screening
    rounds: int = 5  # of additions and exchanges
    restarts: bool = True  # whether to begin anew where the chain is inadequate
    first_order: bool = False  # whether the motor has no inductance
    given: Mapping[str, float] = field(default_factory=dict)  # by the names of `catalogue.GIVEN`
    most: int = 4  # largest number of optional components for exchanges
    extra: float = 6.0  # deviance: odds that an addition must have beyond even ones
    inadequate: float = 4.0  # disagreement between parts of a record that asks for another start

    def price(self, component: Component, information: float) -> float:
        """Return the gain in deviance that a component must bring.

        Twice the logarithm of the prior odds against it, and of how much narrower the data make its
        size than the prior (``information``: squared ratio of the two widths).
        """
        odds = 2 * math.log((1 - component.prior) / component.prior)
        others = max(len(component.parameters) - 1, 0)
        return odds + math.log1p(information) + 6.0 * others + self.extra


@dataclass(frozen=True)
class Candidate:
    """A chain with one more component, and its expected gain by screening."""

    chain: Chain
    component: Component
    gain: float  # in deviance
    price: float


def search(data: Data, policy: SelectionPolicy | None = None, say: Say = lambda _: None) -> Fit:
    """Return the fit of the chain that explains the data at the lowest price."""
    policy = policy or SelectionPolicy()
    found = _improve(_fit_simplest(data, policy), data, policy, say)
    if policy.restarts and inadequacy(data, found) > policy.inadequate:
        for begun in _restarts(found, data, policy, say):
            other = _improve(begun, data, policy, say)
            if other.deviance < found.deviance - 20.0:
                found = other
    return found


def inadequacy(data: Data, found: Fit) -> float:
    """Return the disagreement between parts of the record relative to chance: 1 if adequate.

    An angle that is explained to the resolution of its encoder asks for nothing more.
    """
    if data.is_angle:
        left = float(np.nanstd(data.motion - found.motion))
        if left < RESOLVED * data.quantum / math.sqrt(12):
            return 1.0
    return max((one.ratio for one in scatters(data, found)), default=1.0)


def _improve(found: Fit, data: Data, policy: SelectionPolicy, say: Say) -> Fit:
    """Return the fit of a chain with components added, exchanged and dropped."""
    exchanged = False
    for _ in range(policy.rounds):
        better = _best_addition(found, data, policy, say)
        few = len(list(_optional(found, data))) <= policy.most
        if better is None and few and not exchanged and inadequacy(data, found) > ADEQUATE:
            exchanged = True
            better = _best_exchange(found, data, policy, say)
        if better is None:
            break
        found = better
    return _drop_needless(found, data, policy)


def _restarts(found: Fit, data: Data, policy: SelectionPolicy, say: Say) -> list[Fit]:
    """Return the best of the fits that begin anew with one component in place from the beginning.

    A component that changes much is not found from a motor that was fitted without it.
    """
    motion = replace(data, current=None)
    fits = []
    for one in (*OPTIONAL, *(() if data.is_angle else SPEED_SENSORS)):
        if not one.alters or found.chain.has(one.code):
            continue
        say(f"beginning again with {one.title}")
        fits += _fit_starts(motion, guesses(motion, 1, one), policy)
    fits.sort(key=lambda f: f.deviance)
    best = fits[:1]
    return best if data.current is None else [_with_current(data, f) for f in best]


def candidates(found: Fit, data: Data) -> Iterator[tuple[Component, Chain]]:
    """Yield every chain with one more, or another, component, at each of its starts."""
    sensors = ANGLE_SENSORS if data.is_angle else SPEED_SENSORS
    currents = () if data.current is None else CURRENT_SENSORS
    for one in (*OPTIONAL, *sensors, *currents):
        slots = {c.slot for c in found.chain.components if _is_given(c, found.chain)}
        if not found.chain.has(one.code) and one.slot not in slots:
            for values in one.starts_in(found.chain.values, found.scales):
                yield one, found.chain.with_component(one, values)


def _is_given(one: Component, chain: Chain) -> bool:
    return any(p.name in chain.fixed for p in one.parameters)


def screen(found: Fit, data: Data, policy: SelectionPolicy) -> list[Candidate]:
    """Return the candidates, the most promising first."""
    m = found.linear.row.size
    columns = found.linear.columns[:m]
    base = found.linear.residual[:m]
    best: dict[str, Candidate] = {}
    for one, chain in candidates(found, data):
        r = found.residual(data, chain)
        if r is None:
            continue
        # What the other parameters take up of it, as far as their priors let them.
        signature = r - base
        signature -= columns @ (found.covariance @ (columns.T @ signature))
        rest = base + signature
        energy = float(signature @ signature)
        price = policy.price(one, _information(one, chain, found, energy))
        gain = gain_of(data, found.linear, rest)
        share = -float(signature @ base) / energy if energy > 0 else 0.0
        scaled = _rescale(one, chain, found, share)
        if scaled is not None:
            along = gain_of(data, found.linear, base + share * signature)
            if along > gain:
                gain, chain = along, scaled
        if one.code not in best or gain > best[one.code].gain:
            best[one.code] = Candidate(chain, one, gain, price)
    return sorted(best.values(), key=lambda c: c.price - c.gain)


def _information(one: Component, chain: Chain, found: Fit, energy: float) -> float:
    """Return how much narrower the data make a component's size than the prior, squared."""
    unit = typical_size(one, chain, found)
    return energy * unit**2


def typical_size(one: Component, chain: Chain, found: Fit) -> float:
    """Return the prior's standard deviation of a component, over its size in a chain."""
    new = next((p for p in one.parameters if p.name not in found.chain.values), None)
    if new is None or new.unit == "ln":
        return 1.0
    unit = found.scales.of(new.unit)
    size = abs(chain.values[new.name] - new.neutral * unit)
    return new.typical * unit / size if size > 0 else 1.0


def _rescale(one: Component, chain: Chain, found: Fit, share: float) -> Chain | None:
    """Return the chain with a component of another size, where its effect is proportional to it."""
    p = next((p for p in one.parameters if p.name == one.linear), None)
    if p is None or not abs(share) < 4.0:
        return None
    neutral = p.neutral * found.scales.of(p.unit)
    low, high = p.bounds(found.scales)
    value = neutral + share * (chain.values[p.name] - neutral)
    return chain.with_values({p.name: value}) if low < value < high else None


def gain_of(data: Data, before: Linear, after: Array) -> float:
    """Return the gain in deviance from one fit to another residual, both whitened alike.

    Autocorrelation of the residual reduces the number of samples that count.
    """
    total = 0.0
    for k in range(len(data.outputs)):
        part = before.output == k
        old, new = before.residual[: part.size][part], after[: part.size][part]
        energy = float(new @ new)
        if energy <= 0 or not np.isfinite(energy):
            return -math.inf
        factor = 1.0
        for lag in range(1, min(40, new.size // 4)):
            factor += 2 * (float(new[lag:] @ new[:-lag]) / energy) ** 2
        total += new.size / factor * math.log(max(float(old @ old), 1e-300) / energy)
    return total


def _fit_simplest(data: Data, policy: SelectionPolicy) -> Fit:
    """Return the best fit of the plainest motors from the best guesses."""
    motion = replace(data, current=None)
    fits = _fit_starts(motion, guesses(motion, 3), policy)
    if not fits:
        raise InsufficientExcitationError("no motor follows the voltage")
    return fits[0] if data.current is None else _with_current(data, fits[0])


def _fit_starts(data: Data, chains: Sequence[Chain], policy: SelectionPolicy) -> list[Fit]:
    """Return the fits that begin at guesses, the best first."""
    firsts: list[Fit] = []
    for chain in chains:
        scales = data.scales(math.exp(chain.values["ln_a1"] - chain.values["ln_a0"]))
        chain = chain.with_values({"vc": max(chain.values["vc"], 0.01 * scales.volts)})
        chain = chain.with_component(*plain_sensor(data))
        chain = with_given(chain, data, policy.given)
        begun = approach(data, chain, scales, data.initial, SEARCH_ORDER)
        if all(abs(begun.deviance - other.deviance) > SAME for other in firsts):
            firsts.append(begun)
    fits = [fit(data, first, 2, SEARCH_ORDER, ROUGH) for first in firsts]
    if not policy.first_order:
        fits = [_second_order(data, first) for first in fits]
    return sorted(fits, key=lambda f: f.deviance)


def plain_sensor(data: Data) -> tuple[Component, Mapping[str, float]]:
    """Return the sensor of the motion that needs no evidence, and its parameters."""
    if data.is_angle:
        return Angle(), {}
    return (DifferencedSpeed(), {"window": data.sample}) if data.quantum else (Speed(), {})


def with_given(chain: Chain, data: Data, given: Mapping[str, float]) -> Chain:
    """Return a chain with the components whose size a user has given."""
    for name, value in given.items():
        component, parameter = GIVEN[name]
        if component.slot == "speed sensor" and data.is_angle:
            continue
        size = data.volts / value if name == "slew_rate" else value
        chain = chain.with_component(component, {parameter: size})
        chain = replace(chain, fixed=chain.fixed | {parameter})
    return chain


def _second_order(data: Data, first: Fit) -> Fit:
    """Return the fit of a second-order motor that begins at a first-order one."""
    values = first.chain.values
    lag = math.exp(values["ln_a1"] - values["ln_a0"])
    scales = data.scales(lag)
    begun = []
    for share in (0.01, 0.1):
        ln_a2 = values["ln_a1"] + math.log(share * lag)
        chain = first.chain.with_component(MOTORS[1], {"ln_a2": ln_a2, "viscous": 0.1})
        begun.append(descend(data, chain, scales, first.initial, first.noise, most=4))
    return fit(data, min(begun, key=lambda f: f.linear.cost), 1, SEARCH_ORDER, ROUGH)


def _with_current(data: Data, found: Fit) -> Fit:
    """Return the fit of motion and current that begins at a fit of the motion."""
    assert data.current is not None
    found = replace(found, scales=data.scales(found.scales.lag))
    ok = np.isfinite(data.current)
    y = data.current[ok]
    starts: list[tuple[float, Chain]] = []
    for sensor in CURRENT_SENSORS:
        for start in sensor.starts(found.scales) or ({},):
            chain = found.chain.with_component(MOTORS[2], {"ln_r": 0.0})
            chain = chain.with_component(sensor, {"current_offset": 0.0, **start})
            values = {p.name: np.array([chain.values[p.name]]) for p in chain.parameters}
            drive = respond(chain, values, data.rows, found.scales, found.initial).current
            assert drive is not None
            design = np.column_stack([drive[ok, 0], np.ones(y.size)])
            (slope, offset), *_ = np.linalg.lstsq(design, y, rcond=None)
            rest = float(np.square(y - design @ (slope, offset)).sum())
            if slope > 0:
                at = {"ln_r": -math.log(slope), "current_offset": float(offset)}
                starts.append((rest, chain.with_values(at)))
    if not starts:
        raise CurrentError("the current does not follow from voltage and motion")
    starts.sort(key=lambda one: one[0])
    # The plain sensor, too: others make up for a motor that the motion alone tells badly.
    plain = [chain for _, chain in starts if chain.has("current")]
    tried = {chain.codes: chain for chain in (starts[0][1], *plain)}
    begun = [
        approach(data, chain, found.scales, found.initial, SEARCH_ORDER) for chain in tried.values()
    ]
    return fit(data, min(begun, key=lambda f: f.deviance), 2, SEARCH_ORDER, ROUGH)


def fit_roughly(data: Data, chain: Chain, like: Fit) -> Fit:
    """Return a fit that is good enough to be compared, under the noise of another."""
    return descend(data, chain, like.scales, like.initial, like.noise, most=10, converged=ROUGH)


def _refit_noise(data: Data, found: Fit) -> Fit:
    """Return the fit under the noise of its own residual."""
    noise = fit_noises(data, found.linear, SEARCH_ORDER)
    return found.under(data, noise).descended(data, ROUGH, 8)


def _best_addition(found: Fit, data: Data, policy: SelectionPolicy, say: Say) -> Fit | None:
    best = _fitted(found, data, screen(found, data, policy), policy, say)
    return None if best is None or best[0] <= 0 else _refit_noise(data, best[1])


def _fitted(
    found: Fit, data: Data, screened: Sequence[Candidate], policy: SelectionPolicy, say: Say
) -> tuple[float, Fit] | None:
    """Return the best of the candidates that are worth a fit, and its gain beyond its price."""
    best: tuple[float, Fit] | None = None
    promising = [c for c in screened[: policy.tried] if c.gain > 0.5 * c.price]
    others = [
        Candidate(chain, one, math.nan, policy.price(one, 100.0))
        for one, chain in relabelled(found, data)
        if not found.chain.has(one.code)
    ]
    for candidate in (*promising, *others):
        if best is not None and candidate.gain < CLEARLY * best[0]:
            continue  # the next round screens it again
        say(f"fitting {candidate.component.title}")
        one = fit_roughly(data, candidate.chain, found)
        net = gain_of(data, found.linear, one.linear.residual) - candidate.price
        if best is None or net > best[0]:
            best = net, one
    return best


def relabelled(found: Fit, data: Data) -> Iterator[tuple[Component, Chain]]:
    """Yield chains in which another component replaces the motor's second lag.

    Derivatives do not show them: at the found values their effect equals that of more lag.
    """
    sensors = () if data.is_angle else SPEED_SENSORS
    for one in (*OPTIONAL, *sensors):
        values = one.relabelled(found.chain.values)
        if values:
            yield one, found.chain.with_component(one, values)


def _optional(found: Fit, data: Data) -> Iterator[tuple[Component, Chain]]:
    """Yield every component beyond the simplest chain, and the chain without it."""
    for one in found.chain.components:
        if one.code in NEEDED or one.slot == "motor" or _is_given(one, found.chain):
            continue
        if one.slot == "speed sensor":
            if one.code != plain_sensor(data)[0].code:
                yield one, found.chain.with_component(*plain_sensor(data))
        elif one.slot == "current sensor":
            if one.code != "current":
                plain = {"current_offset": found.chain.values["current_offset"]}
                yield one, found.chain.with_component(CURRENT_SENSORS[0], plain)
        else:
            yield one, found.chain.without(one.code)


def _best_exchange(found: Fit, data: Data, policy: SelectionPolicy, say: Say) -> Fit | None:
    """Return a fit with another component in place of one of the chain, where that is better."""
    best: tuple[float, Fit] | None = None
    for one, plainer in _optional(found, data):
        bare = fit_roughly(data, plainer, found)
        worth = gain_of(data, bare.linear, found.linear.residual) - policy.price(one, 100.0)
        others = [c for c in screen(bare, data, policy) if c.component.code != one.code]
        other = _fitted(bare, data, others, replace(policy, tried=2), say)
        if (
            other is not None
            and other[0] > worth + 2.0
            and (best is None or other[0] - worth > best[0])
        ):
            best = other[0] - worth, other[1]
    return None if best is None else _refit_noise(data, best[1])


def _drop_needless(found: Fit, data: Data, policy: SelectionPolicy) -> Fit:
    """Return the fit without components that do not earn their price."""
    while True:
        best: tuple[float, Fit] | None = None
        for one, plainer in _optional(found, data):
            if _distance_from_none(found, one) > CERTAIN:
                continue
            bare = fit_roughly(data, plainer, found)
            net = policy.price(one, 100.0) - gain_of(data, bare.linear, found.linear.residual)
            if net > 0 and (best is None or net > best[0]):
                best = net, bare
        if best is None:
            return found
        found = best[1]


def _distance_from_none(found: Fit, one: Component) -> float:
    """Return the distance of a component's size from none, in standard deviations."""
    p = next((p for p in one.parameters if p.name == one.linear and p.name in found.names), None)
    if p is None:
        return 0.0
    k = found.names.index(p.name)
    off = found.chain.values[p.name] - p.neutral * found.scales.of(p.unit)
    return float(abs(off) / math.sqrt(found.covariance[k, k]))


def prune(data: Data, found: Fit) -> Fit:
    """Return the fit to all rows without components whose size does not differ from none."""
    while True:
        every = _optional(found, data)
        plainer = next((c for one, c in every if _is_negligible(data, found, one, c)), None)
        if plainer is None:
            return found
        found = fit(data, fit_roughly(data, plainer, found))


def _is_negligible(data: Data, found: Fit, one: Component, plainer: Chain) -> bool:
    """Tell whether a component is tiny, or explains no more than three deviations of its size."""
    own = [p for p in one.parameters if p.name in found.names and p.name != "current_offset"]
    first = next(iter(own), None)
    if first is None:
        return False
    unit, k = found.scales.of(first.unit), found.names.index(first.name)
    off = abs(found.chain.values[first.name] - first.neutral * unit)
    if off < 0.01 * first.typical * unit and one.slot != "current sensor":
        return True
    if one.severity == "note" or off > 3 * math.sqrt(found.covariance[k, k]):
        return False
    bare = fit_roughly(
        data, plainer, found
    )  # a size that no derivative tells may be needed all the same
    return gain_of(data, bare.linear, found.linear.residual) < 9.0
