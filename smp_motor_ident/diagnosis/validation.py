"""Validation: fit on held-out data, comparison of wheels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.limits import LEAST_FIT, REST, UNEXPLAINED
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.candidate_starts import of_kind
from smp_motor_ident.estimation.descent import ROUGHLY
from smp_motor_ident.estimation.fit import Fit, solve
from smp_motor_ident.estimation.request import Request
from smp_motor_ident.estimation.selection import FittedCandidate
from smp_motor_ident.likelihood.experiments import Experiments, prepare
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.record import Record
from smp_motor_ident.result import Candidate, Estimate

SMOOTH = 0.1  # of an angle's own roughness: what the motion may have of it
COARSE = 0.02  # of the speed's scatter: what a counter's resolution may add to it


def percent(measured: Array, predicted: Array, scatter: float = 0.0) -> float:
    """Return the normalised fit ``100 (1 - |y - yhat| / |y - mean y|)``.

    With ``scatter`` [rad/s] given the root mean square of the error is held against that.
    """
    ok = np.isfinite(measured) & np.isfinite(predicted)
    y, z = measured[ok], predicted[ok]
    scatter = scatter or (float(y.std()) if y.size else 0.0)
    if scatter == 0.0 or not y.size:
        return float("nan")
    return float(100 * (1 - np.sqrt(np.square(y - z).mean()) / scatter))


def speed_fit(
    records: Sequence[Record], data: Experiments, fit: Fit, scatter: float = 0.0
) -> float:
    """Return the fit percent of the freely simulated speed, of its own scatter or a given one."""
    predicted = prediction.simulate(data, fit)
    at_once = predicted[:, 1] if data.kind != ANGLE else predicted[:, 0]
    if data.kind != ANGLE:
        return percent(data.output, at_once, scatter)
    lag = _lag(data, predicted[:, 1])
    best = percent(_means(data, _filled(data), lag), _means(data, predicted[:, 1], lag), scatter)
    given = [r.velocity for r in records]
    if given and all(v is not None for v in given):
        velocity = np.concatenate([v for v in given if v is not None])
        means = _means(data, predicted[:, 1], 1)
        reported = percent(velocity, at_once, scatter), percent(velocity, means, scatter)
        best = max([best, *(x for x in reported if np.isfinite(x))])
    return best


def within_resolution(data: Experiments, fit: Fit) -> bool:
    """Tell whether the free run follows an output as closely as its sensor lets anything.

    That is a counter's rounding, or the scatter of an angle whose motion is smooth beside it.  A
    difference of counts that is one more with the probability p has a variance of p (1 - p).
    """
    if fit.noise_ratio > 0:
        return False
    if data.kind != ANGLE:
        return bool(fit.noise[0, 0] < data.quantum**2 / 4)
    moved = _roughness(prediction.simulate(data, fit)[:, 1])
    scatter = _roughness(data.output)
    own = max(data.quantum**2 / 12, scatter if moved < SMOOTH * scatter else 0.0)
    return bool(fit.noise[0, 0] < UNEXPLAINED.value * own)


def stands(data: Experiments, fit: Fit) -> bool:
    """Tell whether the free run of an angle stays within what its sensor scatters."""
    if data.kind != ANGLE or fit.noise_ratio > 0:
        return False
    angle = prediction.simulate(data, fit)[:, 1]
    parts = (angle[a:b] for a, b in pairwise(data.starts))
    return bool(max(np.var(part) for part in parts) < UNEXPLAINED.value * fit.noise[0, 0])


def _roughness(angle: Array) -> float:
    """Return the variance of what is white in an angle, by its fourth differences: 1 4 6 4 1."""
    y = angle[np.isfinite(angle)]
    return float(np.diff(y, n=4).var() / 70) if y.size > 8 else 0.0


def _lag(data: Experiments, angle: Array) -> int:
    """Return over how many samples angles tell a speed, and not mostly their resolution."""
    noise = np.sqrt(2 * max(_roughness(data.output), data.quantum**2 / 12))
    first = float(np.nanstd(_means(data, angle, 1)))
    lag = 1
    while noise / (lag * data.step) > COARSE * first and 8 * lag < data.size:
        longer = _means(data, angle, 2 * lag)
        if np.isnan(longer).all() or np.nanstd(longer) < 0.7 * first:
            break  # no segment is as long, or the motion itself would be averaged away
        lag *= 2
    return lag


def _filled(data: Experiments) -> Array:
    """Return counts with a standstill's repeats, which the fit leaves out, put back."""
    if data.quantum == 0.0:
        return data.output
    last = np.maximum.accumulate(np.where(np.isfinite(data.output), np.arange(data.size), 0))
    return np.asarray(data.output[last])


def _means(data: Experiments, angle: Array, lag: int) -> Array:
    speed = np.full(data.size, np.nan)
    speed[lag:] = (angle[lag:] - angle[:-lag]) / (data.time[lag:] - data.time[:-lag])
    for first in data.starts[:-1]:
        speed[first : first + lag] = np.nan
    return speed


def held_out(records: Sequence[Record], fit: Fit, hold: str, scatter: float) -> tuple[float, float]:
    """Return the fit percent on records that the fit has not seen.

    Of their own scatter, and of that of the records that the fit has seen: where the motor
    hardly moves, its own scatter is what the sensor adds.  The latter is NaN where the motion is
    followed as closely as the sensor lets anything: what is left then is the sensor's, not the
    motor's, and differences of few counts make a large speed of it.  The former is, where the motor
    hardly moves beside how it did: what is left is no share of anything.
    """
    kind = "speed" if fit.kind != ANGLE else "auto"
    data = prepare(records, False, kind, hold).measured_as(fit.kind).held(fit.structure.held)
    settled = prediction.settle(data, fit)
    own = speed_fit(records, data, settled)
    if prediction.simulate(data, settled)[:, 0].std() < REST.value * scatter:
        own = float("nan")
    if within_resolution(data, settled):
        return own, float("nan")
    return own, speed_fit(records, data, settled, scatter)


def split(records: Sequence[Record], share: float = 0.7) -> tuple[list[Record], list[Record]]:
    """Divide records into a part to fit and a part to hold out."""
    if len(records) >= 3:
        n = max(1, round((1 - share) * len(records)))
        kept = list(range(1, len(records), max(1, len(records) // n)))[:n]
        return (
            [r for i, r in enumerate(records) if i not in kept],
            [r for i, r in enumerate(records) if i in kept],
        )
    fitted, kept_records = [], []
    for record in records:
        cut = int(share * len(record))
        if cut < 50 or len(record) - cut < 25:
            fitted.append(record)
            continue
        fitted.append(record.slice(0, cut))
        kept_records.append(record.slice(cut, len(record)))
    return fitted, kept_records


def validated(
    group: Sequence[Record], request: Request, data: Experiments, fit: Fit, hold: str
) -> tuple[float | None, float | None]:
    """Return the fit percent of held-out data: of their own motion, and of the records'."""
    validation, options = request.validation, request.options
    scatter = float(prediction.simulate(data, fit)[:, 0].std())
    if validation is not None:
        found = held_out(list(validation), fit, hold, scatter)
    else:
        fitted, kept = split(group)
        if not kept:
            return None, None
        part = of_kind(prepare(fitted, fit.structure.current, hold=hold), fit)
        if np.ptp(part.hold_value) == 0 or all(np.ptp(r.voltage) == 0 for r in kept):
            return None, None
        start = replace(fit, initial=part.initial)
        refined = solve(part, fit.structure, start, options, 30, ROUGHLY)
        found = held_out(kept, refined, hold, scatter)
    own, common = (x if np.isfinite(x) else None for x in found)
    return own, common


def candidates_of(
    candidates: Sequence[FittedCandidate], chosen: Fit, group: Sequence[Record], data: Experiments
) -> tuple[Candidate, ...]:
    """Return the candidates as the result lists them, each with its fit percent."""
    out = []
    for n, candidate in enumerate(candidates):
        last = n == len(candidates) - 1
        fit = chosen if last else candidate.fit
        part = candidate.on
        seen = (group, data) if part is None else ([], part)
        value = speed_fit(seen[0], of_kind(seen[1], fit), fit)
        if value < LEAST_FIT.value and not last:
            value = float("nan")  # a descent that left the motor behind has no fit to speak of
        out.append(
            Candidate(
                candidate.label,
                value if np.isfinite(value) else None,
                candidate.bic,
                last,
                candidate.reason,
            )
        )
    return tuple(out)


@dataclass(frozen=True)
class Comparison:
    """One quantity across wheels."""

    name: str  # quantity
    mean: float  # over the wheels
    spread: float  # largest minus smallest over the mean
    outlier: str | None  # wheel that stands out most from the others
    sigmas: float  # by how many standard deviations of the difference


def compare(estimates: Mapping[str, Estimate]) -> list[Comparison]:
    """Put wheels side by side."""
    names = [n for e in estimates.values() for n in (*e.parameters, *e.combinations)]
    out = []
    for name in dict.fromkeys(names):
        wheels, values, stds = [], [], []
        for wheel, estimate in estimates.items():
            q = estimate.combinations.get(name) or estimate.parameters.get(name)
            if q is not None and q.value is not None and q.std is not None:
                wheels.append(wheel)
                values.append(q.value)
                stds.append(q.std)
        if len(wheels) < 2 or len(wheels) != len(estimates):
            continue
        v, s = np.array(values), np.array(stds)
        sigmas = np.zeros(len(v))
        for i in range(len(v)):
            others = np.delete(v, i)
            scatter = others.var(ddof=1) if len(others) > 1 else 0.0
            variance = s[i] ** 2 + (np.delete(s, i) ** 2).sum() / len(others) ** 2 + scatter
            sigmas[i] = abs(v[i] - others.mean()) / np.sqrt(max(variance, 1e-300))
        worst = int(np.argmax(sigmas))
        mean = float(v.mean())
        spread = float(np.ptp(v) / abs(mean)) if mean else float("nan")
        out.append(Comparison(name, mean, spread, wheels[worst], float(sigmas[worst])))
    return out
