"""A motor is not the same from one minute to the next: the scatter between parts of a record.

Each part, with a beginning of its own, asks for a step ``d_b = N_b^-1 g_b`` of its own from the
common estimate.  Where these steps scatter or drift more than their covariances ``C_b`` let them
(chi-square for each coordinate), the motor changes: the excess ``S - mean C_b`` is a random
effect that the next recording has as well, and a drift is expected to go on as far again.  The
drift of one record is a single draw, and says nothing of another day: its temperature is added.

References
----------
DerSimonian and Laird, Controlled Clinical Trials 7 (1986), 177 (the excess by moments);
Higgins, Thompson and Spiegelhalter, J. R. Stat. Soc. A 172 (2009), 137 (interval of a new one);
docs/derivations.md, section 9 (temperature).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from scipy.special import chdtri, fdtri, stdtrit

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.diagnosis.limits import (
    HOMOGENEITY,
    SEGMENT_INFORMATION,
    SEGMENTS,
    TEMPERATURE,
)
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.prediction import inverse as inverse_of
from smp_motor_ident.estimation.prediction import positive_part, simulate
from smp_motor_ident.estimation.quantisation import rounded
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.passes import gather
from smp_motor_ident.model.coordinates import LOGARITHMS, PLAUSIBLE, Coordinates
from smp_motor_ident.model.measurement import ANGLE, LATE_SPEED, MEAN_SPEED
from smp_motor_ident.model.structures import sensor_of
from smp_motor_ident.result import NORMAL_95

FEWEST = 4  # parts of which a scatter can be taken
ORDERED = 6  # parts of which a drift is distinguishable from scatter
WHOLE = 1  # part of all that is recorded: cut only where the segments begin
LOOSE = 0.3  # e-folds, or of the value: a coordinate known worse from a part is left out
ROUNDING = 1e-12  # of the largest eigenvalue: what the sums of a part are exact to
# What changes with temperature [1/K]: the resistance of copper, the flux of ferrite magnets, and
# the torque of a lubricant's film (power 2/3 of a viscosity that falls by 5.5 % a kelvin).
COPPER, FERRITE, LUBRICANT = 0.0039, -0.002, -0.037


@dataclass(frozen=True)
class Change:
    """How a motor changes from part to part: nothing where it does not."""

    std: Mapping[str, float] = field(default_factory=dict)  # by coordinate
    segment: int | None = None  # the only one that differs from the others, which agree
    differs: Mapping[str, float] = field(default_factory=dict)  # by how much, by coordinate


@dataclass(frozen=True, eq=False)
class Steps:
    """What parts of the data ask for, each from the common estimate."""

    middle: Array  # when, of the whole, 0 in the middle
    step: Array
    cov: Array
    known: Array  # variances where residuals are white, and what is in the intervals beside
    owner: Integers  # which segment a part is of
    free: list[int]  # which of the coordinates

    def without(self, segment: int) -> "Steps":
        """Return the steps of all other segments."""
        kept = self.owner != segment
        when = self.middle[kept]
        return Steps(when - when.mean(), self.step[kept], self.cov[kept], self.known[kept],
                     self.owner[kept], self.free)  # fmt: skip

    def by_segment(self) -> tuple[Array, Array, Array, int]:
        """Return the segments' means and numbers of parts, and the parts' scatter around them."""
        owners, place, count = np.unique(self.owner, return_inverse=True, return_counts=True)
        means = np.zeros((owners.size, self.step.shape[1]))
        np.add.at(means, place, self.step)
        means /= count[:, None]
        left, freedom = self.step - means[place], len(self.step) - owners.size
        return means, count.astype(np.float64), left.T @ left / max(freedom, 1), freedom


def heterogeneous(data: Experiments, fit: Fit) -> tuple[Fit, Change]:
    """Return the fit with its covariance widened by how the motor changes.

    Segments are compared whole as well: one that is too poor in parts may tell all of the motor.
    """
    parts = _steps(data, fit, int(SEGMENTS.value))
    whole = _steps(data, fit, WHOLE) if len(data.starts) > 2 else None
    level = HOMOGENEITY.value / (1 if whole is None else 3)
    unlike = _unlike(whole, parts, level)
    use = whole if unlike and (parts is None or len(data.starts) > FEWEST) else parts
    if use is parts and parts and not unlike and _changed(parts, level):
        use = parts = _as_rounded(data, fit, parts)
    if use is None or not (unlike or _changed(use, level)):
        return fit, Change()
    ordered = len(data.starts) - 1 < FEWEST and len(use.step) >= ORDERED  # no sequence of records
    between, freedom = _between(use.middle, use.step, _noise(use, parts, level), ordered)
    between = between * (stdtrit(freedom, 0.975) / NORMAL_95) ** 2
    names = [fit.structure.free[i] for i in use.free]
    if ordered:
        between = between + _another_day(fit.z, names)
    added = np.zeros((len(fit.structure.free),) * 2)
    added[np.ix_(use.free, use.free)] = between
    std = dict(zip(names, map(float, np.sqrt(np.diag(between))), strict=True))
    widened = added + (0.0 if fit.added is None else fit.added)
    return replace(fit, added=widened), _named(whole, parts, level, fit, Change(std))


def _as_rounded(data: Experiments, fit: Fit, parts: Steps) -> Steps:
    """Return steps that are as unsure as the same motor's, replayed through its counter.

    A steady speed of a whole number of counts in a few samples is off by the same for as long.
    """
    seen = simulate(data, fit)
    current = data.current
    if current.size:
        current = np.where(np.isfinite(current), seen[:, 2], np.nan)
    squares = np.zeros_like(parts.step)
    errors = rounded(data, fit)
    for error in errors:
        again = replace(data, output=seen[:, 1] + error, current=current)
        steps = _steps(again, fit, int(SEGMENTS.value))
        if steps is None or steps.step.shape != parts.step.shape:
            return parts
        squares += np.square(steps.step - steps.step.mean(axis=0)) / len(errors)
    expected = np.maximum(np.einsum("bii->bi", parts.cov), 1e-300)
    more = np.sqrt(np.maximum(squares / expected, 1.0))
    return replace(parts, cov=parts.cov * more[:, :, None] * more[:, None, :])


def _noise(use: Steps, parts: Steps | None, level: float) -> Array:
    """Return the covariance of a step of a motor that does not change.

    Where segments differ, so do the scores within one, and what these let expect is too much:
    parts of one segment tell.
    """
    expected = np.asarray(use.cov.mean(axis=0))
    if parts is None or parts.free != use.free or not _differ(parts, level):
        return expected
    _, count, scatter, _ = parts.by_segment()
    return scatter if use is parts else scatter / float(count.mean())


def _unlike(whole: Steps | None, parts: Steps | None, level: float) -> bool:
    """Tell whether segments are of different motors."""
    if whole is None:
        return False
    return _changed(whole, level) or (parts is not None and _differ(parts, level))


def _differ(parts: Steps, level: float) -> bool:
    """Tell whether segments differ by more than their own parts do (analysis of variance)."""
    means, count, scatter, freedom = parts.by_segment()
    between = len(means) - 1
    if between < 1 or freedom < 2:
        return False
    square = count @ np.square(means - count @ means / count.sum())
    each = level / means.shape[1]
    ratio = square / between / np.maximum(np.diag(scatter), 1e-300)
    sure = square > chdtri(between, each) * parts.known.mean(axis=0)  # rounding is no change
    return bool((sure & (ratio > fdtri(between, freedom, 1 - each))).any())


def _changed(steps: Steps, level: float) -> bool:
    """Tell whether steps scatter or drift more than their covariances let them."""
    middle, step, cov = steps.middle, steps.step, steps.cov
    parts, size = step.shape
    # Nothing of what stands at its bound in every part.
    expected = np.maximum(np.einsum("bii->i", cov) / parts, 1e-300)
    scatter = np.square(step - step.mean(axis=0)).sum(axis=0)
    if parts < FEWEST:
        return bool(parts > 1 and (scatter / expected > chdtri(parts - 1, level / size)).any())
    drift = np.square(middle @ step) / float(np.square(middle).sum())
    own = (scatter - drift) / (parts - 2)  # a drift is judged by its own scatter as well
    each = level / (3 * size)  # Bonferroni: three tests of each coordinate
    changed = (
        (scatter / expected > chdtri(parts - 1, each))
        | (drift / expected > chdtri(1, each))
        | (drift / np.maximum(own, 1e-300) > fdtri(1, parts - 2, 1 - each))
    )
    return bool(changed.any())


def _named(
    whole: Steps | None, parts: Steps | None, level: float, fit: Fit, change: Change
) -> Change:
    """Return a change with the only segment without which all others are of one motor."""
    if whole is None or len(whole.step) < 3 or not _unlike(whole, parts, level):
        return change
    alone = [
        b
        for b in whole.owner
        if not _unlike(whole.without(b), None if parts is None else parts.without(b), level)
    ]
    if len(alone) != 1:
        return change
    at = whole.owner == alone[0]
    by = whole.step[at].mean(axis=0) - whole.step[~at].mean(axis=0)
    names = [fit.structure.free[i] for i in whole.free]
    return replace(change, segment=int(alone[0]), differs=dict(zip(names, map(float, by))))


def _between(middle: Array, step: Array, noise: Array, ordered: bool) -> tuple[Array, int]:
    """Return the covariance of the next recording's motor around this one's."""
    parts = len(step)
    if not ordered:
        return positive_part(np.cov(step.T).reshape(noise.shape) - noise, noise), parts - 1
    x = np.column_stack([np.ones(parts), middle])
    answer = np.linalg.lstsq(x, step, rcond=None)[0]
    rest = step - x @ answer
    scatter = np.atleast_2d(rest.T @ rest / (parts - 2))
    drift = np.outer(answer[1], answer[1]) - scatter / np.square(middle).sum()
    return positive_part(scatter - noise, noise) + positive_part(drift, noise), parts - 2


def _another_day(z: Coordinates, names: Sequence[str]) -> Array:
    """Return the covariance of a motor at another day's temperature.

    Nobody knows how much of friction is the lubricant's: anything from nothing to all of it.
    """
    tm, plus, minus = COPPER - FERRITE, z.vc_plus, z.vc_minus
    winding = Coordinates(ln_a0=FERRITE, ln_a1=tm, ln_a2=-FERRITE, ln_te=-COPPER, ln_r=COPPER,
                          vc_plus=tm * plus, vc_minus=tm * minus, load=tm * z.load)  # fmt: skip
    lubricant = Coordinates(vc_plus=LUBRICANT * plus, vc_minus=LUBRICANT * minus)
    own, film = (np.array([by.value(n) for n in names]) for by in (winding, lubricant))
    half = own + film / 2
    cov: Array = TEMPERATURE.value**2 * (np.outer(half, half) + np.outer(film, film) / 12)
    return cov


def _steps(data: Experiments, fit: Fit, count: int) -> Steps | None:
    """Return the steps of the segments, of what is cut into ``count`` parts at least."""
    structure, f = fit.structure, len(fit.structure.free)
    cut = _parted(data, fit, count)
    fewest = FEWEST if count > WHOLE else 2
    sums = gather(cut, structure, fit.z, cut.initial, fit.noise_model())
    common = [i for i, c in enumerate(structure.free) if c != "ln_te"]
    # Of residuals that hang together for less than a part: differences between neighbouring
    # blocks (von Neumann) leave out what drifts.
    factors = np.sqrt(fit.factors(lambda sums: 0.5 * np.square(np.diff(sums, axis=0)).sum(axis=0)))
    plausible = np.diag(structure.of_free(PLAUSIBLE))
    asked = []
    for normal, gradient in zip(sums.normal, sums.gradient, strict=True):
        left, score = _without_beginning(normal, gradient, f)
        asked.append((left + plausible, score))
    step, cov = _answered(asked, list(range(f)), factors)
    when = 0.5 * (cut.starts[:-1] + cut.starts[1:]) / data.size
    variance = np.einsum("bii->bi", cov)
    size = [1.0 if n in LOGARITHMS else abs(fit.z.value(n)) for n in structure.free]
    known = 1 / np.maximum(variance, 1e-300)
    enough = known >= SEGMENT_INFORMATION.value * known.mean(axis=0)
    loose = {i for i in common if np.median(variance[:, i]) >= (LOOSE * max(size[i], 1e-12)) ** 2}
    common = [i for i in common if i not in loose]
    if loose and common:
        # Held where they are: free, they would carry others that only together are known along.
        step, cov = _answered(asked, [i for i in range(f) if i not in loose], factors)
        variance = np.einsum("bii->bi", cov)
    keep = enough[:, common].all(axis=1)
    if keep.sum() < fewest or not common:
        return None
    at = np.ix_(keep, common, common)
    middles = when[keep] - when[keep].mean()
    owner = np.searchsorted(data.starts, cut.starts[:-1], side="right") - 1
    beside = 0.0 if fit.added is None else np.diag(fit.added)
    own = (variance / np.square(factors) + beside)[np.ix_(keep, common)]
    return Steps(middles, step[np.ix_(keep, common)], cov[at], own, owner[keep], common)


def _answered(
    asked: list[tuple[Array, Array]], free: list[int], factors: Array
) -> tuple[Array, Array]:
    """Return the steps of parts and their covariances, of the coordinates that are free."""
    steps, covs = np.zeros((len(asked), factors.size)), np.zeros((len(asked), *[factors.size] * 2))
    scale = np.outer(factors, factors)
    for b, (information, score) in enumerate(asked):
        inverse = _bounded_inverse(information[np.ix_(free, free)])
        steps[b, free] = inverse @ score[free]
        covs[b][np.ix_(free, free)] = inverse * scale[np.ix_(free, free)]
    return steps, covs


def _without_beginning(normal: Array, gradient: Array, f: int) -> tuple[Array, Array]:
    """Return a part's information and score of ``f`` coordinates, its own beginning eliminated.

    What that takes all of a coordinate's is known to rounding, and tells nothing.
    """
    own = inverse_of(normal[f:, f:])
    left = normal[:f, :f] - normal[:f, f:] @ own @ normal[f:, :f]
    score = gradient[:f] - normal[:f, f:] @ own @ gradient[f:]
    gone = np.diag(left) < ROUNDING * np.diag(normal)[:f]
    left[gone], left[:, gone], score[gone] = 0.0, 0.0, 0.0
    return left, score


def _bounded_inverse(information: Array) -> Array:
    """Return a covariance; what a part knows but for rounding is bounded, not negative."""
    unit = np.sqrt(np.maximum(np.diag(information), 1e-200))
    values, vectors = np.linalg.eigh(information / np.outer(unit, unit))
    values = np.maximum(values, ROUNDING * values[-1])
    return np.asarray((vectors / values) @ vectors.T / np.outer(unit, unit))


def _edges(data: Experiments, parts: int) -> list[int]:
    """Return where to cut: each segment that is not short in two parts at least."""
    edges: list[int] = []
    for begin, end in pairwise(map(int, data.starts)):
        size = end - begin
        if parts > WHOLE and size > data.size // (3 * parts):
            count = max(2, round(parts * size / data.size))
            edges += [begin + size * k // count for k in range(1, count)]
    return edges


def _parted(data: Experiments, fit: Fit, parts: int) -> Experiments:
    """Return the experiments cut into parts that begin as the fitted motor passes there."""
    starts = np.array(sorted({*map(int, data.starts), *_edges(data, parts)}), dtype=np.int64)
    owner = np.searchsorted(data.starts, starts[:-1], side="right") - 1
    first = np.empty(starts.size - 1, dtype=np.int64)
    initial = np.zeros((starts.size - 1, 5))
    predicted = simulate(data, fit, gain=True)
    output, current = data.output.copy(), data.current.copy()
    window = fit.z.window * (data.kind in (MEAN_SPEED, LATE_SPEED))
    reach = 2 * fit.z.current_lag * (sensor_of(fit.structure) == "averaged")
    for n, (begin, g) in enumerate(zip(starts[:-1], owner, strict=True)):
        a = int(data.hold_start[g])
        last = int(data.hold_start[g + 1]) if g + 2 < data.starts.size else data.hold_end.size
        first[n] = a + np.searchsorted(data.hold_end[a:last], data.time[begin] - 1e-12)
        if begin == data.starts[g]:
            initial[n] = fit.initial[g]
            continue
        # A mean that reaches back into the part before is not of this one's motion.
        own = data.time[begin : starts[n + 1]] - data.time[begin]
        output[begin : begin + int(np.searchsorted(own, window))] = np.nan
        if current.size:
            current[begin : begin + int(np.searchsorted(own, reach))] = np.nan
        voltage = data.hold_value[min(int(first[n]), last - 1)]
        initial[n] = (
            voltage - fit.z.load,
            predicted[begin, 0],
            data.output[begin],
            fit.initial[g, 3],
            0.0,
        )
        if data.kind != ANGLE or not np.isfinite(data.output[begin]):
            initial[n, 2] = predicted[begin, 1] if data.kind == ANGLE else 0.0
        if data.kind.low_passed:
            initial[n, 2] = predicted[begin, 1] - predicted[begin, 0]
    return replace(data, starts=starts, hold_start=np.append(first, data.hold_start[-1]),
                   initial=initial, output=output, current=current)  # fmt: skip
