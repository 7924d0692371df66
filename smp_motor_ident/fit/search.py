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
from smp_motor_ident.chain.sensor import Angle, DifferencedSpeed, LowPassedSpeed, Speed
from smp_motor_ident.errors import CurrentError, InsufficientExcitationError
from smp_motor_ident.fit.adequacy import (
    MAX_ADEQUATE_SCATTER,
    compute_scatters,
    leaves_only_rounding,
)
from smp_motor_ident.fit.data import Data
from smp_motor_ident.fit.descend import Fit, approach, descend, fit, fit_noises
from smp_motor_ident.fit.linear import Linear
from smp_motor_ident.fit.start import guess_motors

SEARCH_ORDER = 2
"""Order of the noise model during the search; a higher one would absorb missing components."""
SEARCH_TOLERANCE = 0.3  # of the deviance, at which a fit of the search ends
MIN_DEVIANCE_DIFFERENCE = 1.0  # between fits at different minima
MIN_DEVIANCE_GAIN = 20.0  # of a chain, whatever its price
MIN_CORRELATION_SIGMAS = 4.0  # at which an autocorrelation differs from zero
MAX_MEMORY_ROWS = 40  # of a residual, unless it repeats itself as a periodic command does
MAX_ALTERNATIVE_COST_RATIO = 1.5  # of a chain without second lag of the motor to one with it
REQUIRED_COMPONENTS = ("friction", "asymmetric_friction")  # components that every motor has

Say = Callable[[str], None]


@dataclass(frozen=True)
class SelectionPolicy:
    """How components are chosen."""

    max_candidates: int = 3  # fitted after every screening
    max_rounds: int = 5  # of additions and exchanges
    restarts: bool = True  # whether to search again from other starts if inadequate
    first_order: bool = False  # whether the motor has no inductance
    given: Mapping[str, float] = field(default_factory=dict)  # by the names of `catalogue.GIVEN`
    extra_price: float = 6.0  # deviance: odds beyond even ones

    def price(self, component: Component, variance_ratio: float) -> float:
        """Return the gain in deviance that a component must bring.

        Twice the logarithm of the prior odds against it, and of the Occam factor of its size
        (``variance_ratio``: prior variance over that given by the data).
        """
        odds = 2 * math.log((1 - component.prior) / component.prior)
        others = max(len(component.parameters) - 1, 0)
        return odds + math.log1p(variance_ratio) + 6.0 * others + self.extra_price


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
    found = _improve_chain(_fit_simplest(data, policy), data, policy, say)
    if policy.restarts and measure_inadequacy(data, found) > MAX_ADEQUATE_SCATTER:
        for begun in _restart_with_component(found, data, policy, say):
            other = _improve_chain(begun, data, policy, say)
            if other.deviance < found.deviance - MIN_DEVIANCE_GAIN:
                found = other
    return found


def measure_inadequacy(data: Data, found: Fit) -> float:
    """Return the disagreement between parts of the record relative to chance: 1 if adequate.

    A motion that is explained to the rounding of its counts asks for nothing more.
    """
    if leaves_only_rounding(data, found.motion):
        return 1.0
    return max((one.ratio for one in compute_scatters(data, found)), default=1.0)


def _improve_chain(found: Fit, data: Data, policy: SelectionPolicy, say: Say) -> Fit:
    """Return the fit of a chain with components added, exchanged and dropped."""
    exchanged = False
    for _ in range(policy.max_rounds):
        better = _fit_best_addition(found, data, policy, say)
        if (
            better is None
            and not exchanged
            and measure_inadequacy(data, found) > MAX_ADEQUATE_SCATTER
        ):
            exchanged = True
            better = _fit_best_exchange(found, data, policy, say)
        if better is None:
            break
        found = better
    return _drop_unneeded(found, data, policy)


def _restart_with_component(found: Fit, data: Data, policy: SelectionPolicy, say: Say) -> list[Fit]:
    """Return the best fit that has one more component from the beginning.

    A component with a large effect is not found from a motor that was fitted without it.
    """
    motion = replace(data, current=None)
    fits = []
    for one in (*OPTIONAL, *(() if data.is_angle else SPEED_SENSORS)):
        if not one.needs_own_start or found.chain.has(one.code):
            continue
        say(f"beginning again with {one.title}")
        fits += _fit_starts(motion, guess_motors(motion, 1, one), policy)
    fits.sort(key=lambda f: f.deviance)
    best = fits[:1]
    return best if data.current is None else [_fit_current(data, f) for f in best]


def list_candidates(found: Fit, data: Data) -> Iterator[tuple[Component, Chain]]:
    """Yield every chain with one component added or replaced, at each of its starts."""
    sensors = ANGLE_SENSORS if data.is_angle else SPEED_SENSORS
    currents = () if data.current is None else CURRENT_SENSORS
    for one in (*OPTIONAL, *sensors, *currents):
        if not found.chain.has(one.code) and one.slot not in _list_fixed_slots(found.chain):
            for values in one.starts_in(found.chain.values, found.scales):
                yield one, found.chain.with_component(one, values)


def _is_fixed(one: Component, chain: Chain) -> bool:
    return any(p.name in chain.fixed for p in one.parameters)


def _list_fixed_slots(chain: Chain) -> set[str]:
    """Return the slots of components that a user has given."""
    return {c.slot for c in chain.components if _is_fixed(c, chain)}


@dataclass(frozen=True, eq=False)
class Effect:
    """What an absent component of some size would change."""

    component: Component
    chain: Chain
    shift: Array  # shape (p,): change of the parameters, which take up a part of it
    rest: Array  # shape (m + priors,): change of the residual that is left
    energy: float  # sum of squares of that
    optimum: float  # size at which the residual is smallest, over this size
    prior_std: float  # standard deviation of the size before the data are seen, over this size


def measure_effects(found: Fit, data: Data) -> Iterator[Effect]:
    """Simulate every absent component at each of its starts."""
    columns, base = found.linear.columns, found.linear.residual
    signature = np.zeros(base.size)
    for one, chain in list_candidates(found, data):
        r = found.residual(data, chain)
        if r is not None:
            signature[: r.size] = r - base[: r.size]
            shift = found.covariance @ (columns.T @ signature)
            rest = signature - columns @ shift
            energy = float(rest @ rest)
            optimum = -float(rest @ base) / energy if energy > 0 else 0.0
            prior_std = _compute_relative_prior_std(one, chain, found)
            yield Effect(one, chain, shift, rest, energy, optimum, prior_std)


def screen_candidates(found: Fit, data: Data, policy: SelectionPolicy) -> list[Candidate]:
    """Return all candidates with their expected gains, the best first."""
    base = found.linear.residual
    best: dict[str, Candidate] = {}
    for effect in measure_effects(found, data):
        one, chain = effect.component, effect.chain
        price = policy.price(one, effect.energy * effect.prior_std**2)
        gain = compute_gain(data, found.linear, base + effect.rest)
        scaled = _scale_to_optimum(one, chain, found, effect.optimum)
        if scaled is not None:
            along = compute_gain(data, found.linear, base + effect.optimum * effect.rest)
            if along > gain:
                gain, chain = along, scaled
        if one.code not in best or gain > best[one.code].gain:
            best[one.code] = Candidate(chain, one, gain, price)
    return sorted(best.values(), key=lambda c: c.price - c.gain)


def _compute_relative_prior_std(one: Component, chain: Chain, found: Fit) -> float:
    """Return the prior standard deviation of a component over its size in a chain."""
    new = next((p for p in one.parameters if p.name not in found.chain.values), None)
    if new is None or new.unit == "ln":
        return 1.0
    unit = found.scales.of(new.unit)
    size = abs(chain.values[new.name] - new.neutral * unit)
    return new.typical * unit / size if size > 0 else 1.0


def _scale_to_optimum(one: Component, chain: Chain, found: Fit, share: float) -> Chain | None:
    """Scale a component to its optimal size, if its effect is proportional to the size."""
    p = next((p for p in one.parameters if p.name == one.linear), None)
    if p is None or not abs(share) < 4.0:
        return None
    neutral = p.neutral * found.scales.of(p.unit)
    low, high = p.bounds(found.scales)
    value = neutral + share * (chain.values[p.name] - neutral)
    return chain.with_values({p.name: value}) if low < value < high else None


def compute_gain(data: Data, before: Linear, after: Array) -> float:
    """Return the gain in deviance from one fit to another residual, both whitened alike.

    Autocorrelation of the residual reduces the number of samples that count.
    """
    total = 0.0
    for k in range(len(data.outputs)):
        part = before.data.output == k
        old, new = before.residual[: part.size][part], after[: part.size][part]
        energy = float(new @ new)
        if energy <= 0 or not np.isfinite(energy):
            return -math.inf
        gain = new.size * math.log(max(float(old @ old), 1e-300) / energy)
        if gain > 0:
            max_lag = new.size if data.rows.is_periodic else MAX_MEMORY_ROWS
            gain /= _compute_variance_inflation(new, max_lag)
        total += gain
    return total


def _compute_variance_inflation(residual: Array, max_lag: int) -> float:
    """Return the number of rows over that of independent rows with the same information.

    References
    ----------
    G. V. Bayley, J. M. Hammersley, J. R. Statist. Soc. Suppl. 8 (1946), 184.
    """
    length = 2 ** (2 * residual.size).bit_length()
    spectrum = np.abs(np.fft.rfft(residual, length)) ** 2
    covariance = np.fft.irfft(spectrum, length)[: residual.size]
    share = (covariance[1:max_lag] / covariance[0]) ** 2
    return 1.0 + 2.0 * float(share[share > MIN_CORRELATION_SIGMAS**2 / residual.size].sum())


def _fit_simplest(data: Data, policy: SelectionPolicy) -> Fit:
    """Return the best fit of the simplest motors from the best guesses."""
    motion = replace(data, current=None)
    fits = _fit_starts(motion, guess_motors(motion, 3), policy)
    if not fits:
        raise InsufficientExcitationError("no motor follows the voltage")
    return fits[0] if data.current is None else _fit_current(data, fits[0])


def _fit_starts(data: Data, chains: Sequence[Chain], policy: SelectionPolicy) -> list[Fit]:
    """Return the fits that begin at guesses, the best first."""
    firsts: list[Fit] = []
    for chain in chains:
        scales = data.scales(math.exp(chain.values["ln_a1"] - chain.values["ln_a0"]))
        chain = chain.with_values({"vc": max(chain.values["vc"], 0.01 * scales.volts)})
        chain = chain.with_component(*choose_plain_sensor(data))
        chain = add_fixed_effects(chain, data, policy.given)
        firsts.append(approach(data, chain, scales, data.initial, SEARCH_ORDER))
    firsts = _drop_equal_fits(firsts)
    fits = [fit(data, first, 2, SEARCH_ORDER, SEARCH_TOLERANCE) for first in firsts]
    fits = _drop_equal_fits(fits)
    if not policy.first_order:
        fits = [_fit_second_order(data, first) for first in fits]
    return sorted(fits, key=lambda f: f.deviance)


def _drop_equal_fits(fits: Sequence[Fit]) -> list[Fit]:
    """Return one fit of every minimum."""
    kept: list[Fit] = []
    for one in fits:
        if all(abs(one.deviance - other.deviance) > MIN_DEVIANCE_DIFFERENCE for other in kept):
            kept.append(one)
    return kept


def choose_plain_sensor(data: Data) -> tuple[Component, Mapping[str, float]]:
    """Return the default sensor of the motion, and its parameters."""
    if data.is_angle:
        return Angle(), {}
    return (DifferencedSpeed(), {"window": data.sample}) if data.quantum else (Speed(), {})


def add_fixed_effects(chain: Chain, data: Data, given: Mapping[str, float]) -> Chain:
    """Add the components whose size a user has given to a chain."""
    for name, value in given.items():
        component, parameter = GIVEN[name]
        if component.slot == "speed sensor" and data.is_angle:
            continue
        size = data.volts / value if name == "slew_rate" else value
        chain = chain.with_component(component, {parameter: size})
        chain = replace(chain, fixed=chain.fixed | {parameter})
    return chain


def _fit_second_order(data: Data, first: Fit) -> Fit:
    """Return the fit of a second-order motor that begins at a first-order one."""
    values = first.chain.values
    lag = math.exp(values["ln_a1"] - values["ln_a0"])
    scales = data.scales(lag)
    begun = []
    for share in (0.01, 0.1):
        ln_a2 = values["ln_a1"] + math.log(share * lag)
        chain = first.chain.with_component(MOTORS[1], {"ln_a2": ln_a2, "viscous": 0.1})
        begun.append(descend(data, chain, scales, first.initial, first.noise, max_steps=4))
    return fit(data, min(begun, key=lambda f: f.linear.cost), 1, SEARCH_ORDER, SEARCH_TOLERANCE)


def _fit_current(data: Data, found: Fit) -> Fit:
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
    # The plain sensor, too: others compensate a motor that the motion alone determines badly.
    plain = [chain for _, chain in starts if chain.has("current")]
    tried = {chain.codes: chain for chain in (starts[0][1], *plain)}
    begun = [
        approach(data, chain, found.scales, found.initial, SEARCH_ORDER) for chain in tried.values()
    ]
    return fit(data, min(begun, key=lambda f: f.deviance), 2, SEARCH_ORDER, SEARCH_TOLERANCE)


def fit_roughly(data: Data, chain: Chain, like: Fit) -> Fit:
    """Fit a chain well enough for a comparison, under the noise of another fit."""
    return descend(data, chain, like.scales, like.initial, like.noise, 10, SEARCH_TOLERANCE)


def fit_alternative(data: Data, chain: Chain, like: Fit) -> Fit | None:
    """Fit a chain of `replace_second_lag`; return None where it explains much less than another.

    A second lag of the motor is added last: with it a distant fit would end at the other.
    """
    held = replace(chain, fixed=chain.fixed | {"ln_a2"})
    begun = descend(data, held, like.scales, like.initial, like.noise, 2, 10 * SEARCH_TOLERANCE)
    if begun.linear.cost > MAX_ALTERNATIVE_COST_RATIO * like.linear.cost:
        return None
    chain = replace(begun.chain, fixed=chain.fixed)
    return descend(data, chain, like.scales, begun.initial, like.noise, 10, SEARCH_TOLERANCE)


def _refit_noise(data: Data, found: Fit) -> Fit:
    """Return the fit under the noise of its own residual."""
    noise = fit_noises(data, found.linear.simulated, SEARCH_ORDER)
    return found.with_noise(data, noise).descend(data, SEARCH_TOLERANCE, 8)


def _fit_best_addition(found: Fit, data: Data, policy: SelectionPolicy, say: Say) -> Fit | None:
    screened = screen_candidates(found, data, policy)
    best = _fit_best_candidate(found, data, screened, policy, say, with_alternatives=True)
    if best is None:
        return None
    other = _refit_noise(data, best[1])
    if best[0] > 0:
        return other
    # The noise that was fitted to a misfit hides it; that of the other chain may not.
    known = found.with_noise(data, other.noise).descend(data, SEARCH_TOLERANCE, 8)
    return other if other.deviance < known.deviance - MIN_DEVIANCE_GAIN else None


def _fit_best_candidate(
    found: Fit, data: Data, screened: Sequence[Candidate], policy: SelectionPolicy, say: Say,
    with_alternatives: bool = False,
) -> tuple[float, Fit] | None:  # fmt: skip
    """Fit the promising candidates; return the best net gain and its fit."""
    best: tuple[float, Fit] | None = None
    promising = [c for c in screened[: policy.max_candidates] if c.gain > 0.5 * c.price]
    others = [
        Candidate(chain, one, math.nan, policy.price(one, 100.0))
        for one, chain in (*replace_second_lag(found, data), *exchange_lags(found))
        if with_alternatives and not found.chain.has(one.code)
    ]
    for candidate in (*promising, *others):
        say(f"fitting {candidate.component.title}")
        fits = fit_roughly if candidate in promising else fit_alternative
        one = fits(data, candidate.chain, found)
        if one is None:
            continue
        net = compute_gain(data, found.linear, one.linear.residual) - candidate.price
        if best is None or net > best[0]:
            best = net, one
    return best


def replace_second_lag(found: Fit, data: Data) -> Iterator[tuple[Component, Chain]]:
    """Yield chains in which another component replaces the motor's second lag.

    Derivatives do not show them: at the found values their effect equals that of more lag.  A
    measured current shows that lag by itself.
    """
    if data.current is not None:
        return
    sensors = () if data.is_angle else SPEED_SENSORS
    for one in (*OPTIONAL, *sensors):
        values = one.replace_second_lag(found.chain.values)
        if values and one.slot not in _list_fixed_slots(found.chain):
            yield one, found.chain.with_component(one, values)


def exchange_lags(found: Fit) -> Iterator[tuple[Component, Chain]]:
    """Yield the chain in which a low-pass of the speed has the motor's longer lag."""
    one, chain = LowPassedSpeed(), found.chain
    if (chain.has("speed") or chain.has(one.code)) and "ln_a2" in chain.values:
        values = one.exchange_lags(chain.values)
        if values and one.slot not in _list_fixed_slots(chain):
            yield one, chain.with_component(one, values)


def _list_optional_components(found: Fit, data: Data) -> Iterator[tuple[Component, Chain]]:
    """Yield every component that may be dropped, and the chain without it."""
    for one in found.chain.components:
        if one.code in REQUIRED_COMPONENTS or one.slot == "motor" or _is_fixed(one, found.chain):
            continue
        if one.slot == "speed sensor":
            if one.code != choose_plain_sensor(data)[0].code:
                yield one, found.chain.with_component(*choose_plain_sensor(data))
        elif one.slot == "current sensor":
            if one.code != "current":
                plain = {"current_offset": found.chain.values["current_offset"]}
                yield one, found.chain.with_component(CURRENT_SENSORS[0], plain)
        else:
            yield one, found.chain.without(one.code)


def _fit_best_exchange(found: Fit, data: Data, policy: SelectionPolicy, say: Say) -> Fit | None:
    """Replace one component by a better one; return None if no exchange pays."""
    best: tuple[float, Fit] | None = None
    for one, plainer in _list_optional_components(found, data):
        bare = fit_roughly(data, plainer, found)
        worth = compute_gain(data, bare.linear, found.linear.residual) - policy.price(one, 100.0)
        others = [c for c in screen_candidates(bare, data, policy) if c.component.code != one.code]
        other = _fit_best_candidate(bare, data, others, replace(policy, max_candidates=2), say)
        if other is not None and other[0] - worth > (0.0 if best is None else best[0]):
            best = other[0] - worth, other[1]
    return None if best is None else _refit_noise(data, best[1])


def _drop_unneeded(found: Fit, data: Data, policy: SelectionPolicy) -> Fit:
    """Drop the components whose gain is below their price."""
    while True:
        best: tuple[float, Fit] | None = None
        for one, plainer in _list_optional_components(found, data):
            bare = fit_roughly(data, plainer, found)
            net = policy.price(one, 100.0) - compute_gain(data, bare.linear, found.linear.residual)
            if net > 0 and (best is None or net > best[0]):
                best = net, bare
        if best is None:
            return found
        found = best[1]


def prune(data: Data, found: Fit) -> Fit:
    """Drop the components whose size does not differ from zero, on all rows."""
    while True:
        every = _list_optional_components(found, data)
        plainer = next((c for one, c in every if _is_negligible(data, found, one, c)), None)
        if plainer is None:
            return found
        found = fit(data, fit_roughly(data, plainer, found))


def _is_negligible(data: Data, found: Fit, one: Component, plainer: Chain) -> bool:
    """Tell whether a component explains no more than three standard deviations of its size."""
    own = [p for p in one.parameters if p.name in found.names and p.name != "current_offset"]
    first = next(iter(own), None)
    if first is None:
        return False
    unit, k = found.scales.of(first.unit), found.names.index(first.name)
    off = abs(found.chain.values[first.name] - first.neutral * unit)
    if off > 3 * math.sqrt(found.covariance[k, k]):
        return False
    bare = fit_roughly(data, plainer, found)  # its derivative may be zero although it is needed
    return compute_gain(data, bare.linear, found.linear.residual) < 9.0
