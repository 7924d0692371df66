"""Where several structures explain the data equally well, values that cover them all.

The deviance of each candidate is a sum over runs of samples.  Drawing the runs' shares again and
again shows how often each candidate would have been the best: its weight.  What is stated is the
weighted mean, its variance that within the chosen structure plus that between the candidates.

References
----------
Yao, Vehtari, Simpson and Gelman, Bayesian Analysis 13 (2018), 917, section 3.4 (pseudo-BMA+);
Burnham and Anderson, Model Selection and Multimodel Inference, 2nd ed., section 4.3.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.limits import CANDIDATE_WEIGHT
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.candidate_starts import of_kind
from smp_motor_ident.estimation.consider_covariance import latest
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.quantities import Answer, answer
from smp_motor_ident.estimation.selection import POLICY, FittedCandidate, slowly_filtered
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.structures import Structure
from smp_motor_ident.result import NORMAL_95, UNITS, Quantity

BLOCKS = 60
DRAWS = 400
ABSENT = (
    "delay", "averaging_window", "sensor_lag", "time_constant_product", "load_voltage",
    "current_lag",
)  # fmt: skip
"""Quantities that are nothing in a structure that does not have them."""


def weights(
    data: Sequence[Experiments], fits: Sequence[Fit], beside: Sequence[int] = (), seed: int = 0
) -> Array:
    """Return the weight of each candidate, the choice first, by a Bayesian bootstrap of runs.

    What costs nothing is a mean over a window where the speed comes in coarse steps, a difference
    of counts by its making, and a friction that the choice was found to do without.  What is late
    is as likely as a second lag, or has the odds of the choice against it: half of the weight each.
    ``beside``: how many numbers each has beside those of its structure.
    """
    rows = []
    for own, fit in zip(data, fits, strict=True):
        predicted = prediction.simulate(own, fit, gain=True)
        edges = np.linspace(0, own.size, BLOCKS + 1).astype(np.int64)[:-1]
        run = np.zeros(BLOCKS)
        measured = [own.output, own.current] if own.current.size else [own.output]
        for column, values in enumerate(measured, 1):
            residual = values - predicted[:, column]
            seen = np.isfinite(residual)
            square = np.where(seen, np.square(residual), 0.0)
            variance = float(square.sum() / max(seen.sum(), 1))
            run += np.add.reduceat(square / variance + seen * np.log(variance), edges)
        rows.append(run)
    runs = np.array(rows)
    rng = np.random.default_rng(seed)
    shares = rng.dirichlet(np.ones(BLOCKS), DRAWS) * BLOCKS
    # Of two holds nobody knows the odds, and a second lag is as likely as the later hold.
    rubs = fits[0].structure.friction
    sizes = [
        (s.with_(friction=rubs) if rubs == "none" else s).size
        + (s.order == 1 and s.shift > 0)
        - (own.quantum > 0 and s.window)
        for own, s in zip(data, (f.structure for f in fits), strict=True)
    ]
    sizes = np.array(sizes) + np.array(beside or [0] * len(sizes))
    price = np.array([POLICY.price(n, f.samples) for n, f in zip(sizes, fits, strict=True)])
    price += np.array([POLICY.second_lag * slowly_filtered(f) for f in fits])
    total = shares @ runs.T + price
    each = np.exp(-0.5 * (total - total.min(axis=1, keepdims=True)))
    each = _of_both_odds(each, data, fits)
    return np.asarray((each / each.sum(axis=1, keepdims=True)).mean(axis=0))


def _of_both_odds(each: Array, data: Sequence[Experiments], fits: Sequence[Fit]) -> Array:
    """Return likelihoods, half of each with even odds of a delay to a lag, half with the choice's.

    Shape (draws, candidates).  What a delay loses in the latter, the second lags gain.
    """
    late = np.array([_late_without_lag(o, f) for o, f in zip(data, fits, strict=True)])
    either = late | np.array([f.structure.order == 2 for f in fits])
    even = each[:, either]
    odds = even * np.exp(-0.5 * POLICY.second_lag * late[either])
    as_much = even.sum(axis=1, keepdims=True) / np.maximum(odds.sum(axis=1, keepdims=True), 1e-300)
    out = each.copy()
    out[:, either] = 0.5 * (even + odds * as_much)
    return out


def _late_without_lag(data: Experiments, fit: Fit) -> bool:
    """Tell whether a delay or a mean stands where every motor has a second lag."""
    s, late = fit.structure, {"delay"} if data.quantum > 0 else {"delay", "window"}
    return s.order == 1 and (s.shift > 0 or not late.isdisjoint(s.free))


def averaged(
    result: Answer, weight: Array, others: Sequence[Answer], own_fit: Answer | None = None
) -> Answer:
    """Return an answer that covers the candidates.

    ``own_fit``: what the choice's fit says, to hold the others' against; by default the answer.
    """
    keep = np.flatnonzero(weight[1:] > CANDIDATE_WEIGHT.value)
    if not keep.size or not result.names:
        return result
    # The choice keeps the least weight that leaves it inside of the interval of them all.
    chosen = max(float(weight[0]), float(weight[1:][keep].sum()) / NORMAL_95**2)
    share = np.concatenate([[chosen], weight[1:][keep]])
    share = share / share.sum()
    own = np.array([_value(result, n, 0.0) for n in result.names])
    values = np.array([own] + [[_value(others[k], n, v) for n, v in zip(result.names, own)]
                               for k in keep])  # fmt: skip
    mean = own + share @ (values - own)  # what is the same in all stays so
    between = (values - mean).T @ (share[:, None] * (values - mean))
    # One that explains the data better than the choice, and knows less, speaks for what it knows.
    variance = np.maximum(np.diag(result.covariance), 1e-300)
    variance = np.maximum(variance, _variances(own_fit or result, result.names, variance))
    each = np.array([variance] + [
        _variances(others[k], result.names, variance) if w >= share[0] else variance
        for k, w in zip(keep, share[1:])
    ])  # fmt: skip
    factor = np.sqrt(np.maximum(share @ each / variance, 1.0))
    shift = dict(zip(result.names, zip(mean, np.diag(between), factor)))
    known = _shifted(result.combinations, shift)
    if "time_constant_product" not in known:
        known |= _second_lag_of([others[k] for k in keep])
    return replace(
        result,
        combinations={n: known[n] for n in UNITS if n in known},
        parameters=_shifted(result.parameters, shift),
        covariance=result.covariance * np.outer(factor, factor) + between,
    )


def _second_lag_of(others: Sequence[Answer]) -> dict[str, Quantity]:
    """Return what a choice of one lag leaves open of a second, which others have."""
    name = "time_constant_product"
    there = [o.combinations[name] for o in others if name in o.combinations]
    up = [q.ci95[1] for q in there if q.ci95 is not None]
    return {name: Quantity(None, None, (0.0, max(up)), UNITS[name], "unidentifiable")} if up else {}


def candidate_weights(data: Experiments, candidates: Sequence[FittedCandidate]) -> dict[int, float]:
    """Return the weights of the structures that explain the data as well, by their places.

    One that has not settled explains them at least as well as that.
    """
    last = len(candidates) - 1
    finite = [bool(np.isfinite(r.fit.deviance)) for r in candidates]
    places = [n for n in range(last) if candidates[n].whole and finite[n]]
    if data.quantum > 0 and candidates[last].fit.structure.window:  # as it must be
        places = [n for n in places if candidates[n].fit.structure.window]
    if not places:
        return {}
    places = [last, *places]
    there = [candidates[n] for n in places]
    found = weights(
        [of_kind(r.on or data, r.fit) for r in there],
        [r.fit for r in there],
        [r.numbers for r in there],
    )
    return dict(zip(places, map(float, found), strict=True))


def covering(
    weight: Mapping[int, float],
    candidates: Sequence[FittedCandidate],
    result: Answer,
    known: Mapping[str, float],
) -> tuple[Answer, dict[str, float]]:
    """Return the answer over all structures that explain the data as well, and their weights."""
    if not weight:
        return result, {}
    own, *others = (answer(candidates[n].fit, known, level=result.level) for n in weight)
    found = averaged(result, np.array(list(weight.values())), others, own)
    likely = {candidates[n].label: w for n, w in weight.items() if w > CANDIDATE_WEIGHT.value}
    return found, likely if len(likely) > 1 else {}


def left_open(
    data: Experiments,
    fit: Fit,
    weight: Mapping[int, float],
    candidates: Sequence[FittedCandidate],
    late: float = 0.0,
) -> tuple[dict[str, float], ...]:
    """Return the motors that the data do not exclude beside the one of a fit.

    The structures that explain the data as well, and the longest delay where the fit has none: on
    it hangs what a loop bears far beyond the motor's own frequencies, which nothing else shows.
    ``late``: see `latest`.
    """
    rivals = [candidates[n].fit for n in list(weight)[1:] if weight[n] > CANDIDATE_WEIGHT.value]
    motors = [(f.structure, f.z) for f in rivals]
    last = latest(data, fit, late)
    found = [_reported(*motor) for motor in (*motors, *([last] if last else []))]
    return tuple(one for one in found if np.isfinite(list(one.values())).all())


def _reported(structure: Structure, z: Coordinates) -> dict[str, float]:
    """Return what voltage and speed tell of a motor, as far as its structure has it."""
    found = structure.combinations(z)
    return {n: float(found[n][0]) for n in structure.separates() if n in found}


def _variances(answer: Answer, names: Sequence[str], own: Array) -> Array:
    """Return a candidate's variances; the chosen one's where it has none."""
    known = dict(zip(answer.names, np.diag(answer.covariance)))
    return np.array([known.get(n, v) for n, v in zip(names, own)])


def _value(answer: Answer, name: str, own: float) -> float:
    """Return a candidate's value; the chosen one's where it has none."""
    quantity = answer.combinations.get(name) or answer.parameters.get(name)
    if quantity is None and name in ABSENT:
        return 0.0
    return own if quantity is None or quantity.value is None else quantity.value


def _shifted(
    quantities: Mapping[str, Quantity], shift: Mapping[str, tuple[float, float, float]]
) -> dict[str, Quantity]:
    """Return means over structures; of each the interval keeps what the choice alone says."""
    out = dict(quantities)
    for name, quantity in quantities.items():
        if name not in shift or quantity.value is None or quantity.std is None:
            continue
        mean, between, factor = map(float, shift[name])
        low, high = quantity.ci95 or (quantity.value, quantity.value)
        reach = NORMAL_95**2 * between
        down = mean - float(np.sqrt((factor * (quantity.value - low)) ** 2 + reach))
        up = mean + float(np.sqrt((factor * (high - quantity.value)) ** 2 + reach))
        out[name] = replace(
            quantity,
            value=mean,
            std=float(np.hypot(factor * quantity.std, np.sqrt(between))),
            ci95=(min(max(down, 0.0) if low >= 0 else down, low), max(up, high)),
        )
    return out
