"""A motor is not the same from one minute to the next: the scatter between parts of a record.

Each part, with a beginning of its own, asks for a step ``d_b = N_b^-1 g_b`` of its own from the
common estimate.  Where these steps scatter or drift more than their covariances ``C_b`` let them
(chi-square for each coordinate), the motor changes: the excess ``S - mean C_b`` is a random
effect that the next recording has as well, and a drift is expected to go on as far again.

References
----------
DerSimonian and Laird, Controlled Clinical Trials 7 (1986), 177 (the excess by moments);
Higgins, Thompson and Spiegelhalter, J. R. Stat. Soc. A 172 (2009), 137 (interval of a new one).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtri, stdtrit

from smp_motor_ident.diagnosis.limits import HOMOGENEITY, SEGMENT_INFORMATION, SEGMENTS
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.fitted import NORMAL_95
from smp_motor_ident.estimation.prediction import inverse as inverse_of
from smp_motor_ident.estimation.prediction import simulate
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.passes import gather
from smp_motor_ident.model.coordinates import LOGARITHMS, PLAUSIBLE
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.model.structures import sensor_of

Array = NDArray[np.float64]

FEWEST = 4  # parts of which a scatter can be taken
ORDERED = 6  # parts of which a drift is distinguishable from scatter
LOOSE = 0.3  # e-folds, or of the value: a coordinate known worse from a part is left out
ROUNDING = 1e-12  # of the largest eigenvalue: what the sums of a part are exact to


def heterogeneous(data: Experiments, fit: Fit) -> tuple[Fit, dict[str, float]]:
    """Return the fit with its covariance widened by how the motor changes."""
    found = _steps(data, fit)
    if found is None:
        return fit, {}
    middle, step, cov, free = found
    parts, size = step.shape
    # Nothing of what stands at its bound in every part.
    expected = np.maximum(np.einsum("bii->i", cov) / parts, 1e-300)
    square = float(np.square(middle).sum())
    scatter = np.square(step - step.mean(axis=0)).sum(axis=0)
    drift = np.square(middle @ step) / square
    own = (scatter - drift) / (parts - 2)  # a drift is judged by its own scatter as well
    each = HOMOGENEITY.value / (3 * size)  # Bonferroni: three tests of each coordinate
    changed = (
        (scatter / expected > chdtri(parts - 1, each))
        | (drift / expected > chdtri(1, each))
        | (drift / np.maximum(own, 1e-300) > fdtri(1, parts - 2, 1 - each))
    )
    if not changed.any():
        return fit, {}
    ordered = len(data.starts) - 1 < FEWEST and parts >= ORDERED  # records are not a sequence
    between, freedom = _between(middle, step, cov.mean(axis=0), ordered)
    between = between * (stdtrit(freedom, 0.975) / NORMAL_95) ** 2
    added = np.zeros((len(fit.structure.free),) * 2)
    added[np.ix_(free, free)] = between
    std = np.sqrt(np.diag(between))
    names = [fit.structure.free[i] for i in free]
    widened = added + (0.0 if fit.added is None else fit.added)
    return replace(fit, added=widened), dict(zip(names, map(float, std), strict=True))


def _between(middle: Array, step: Array, noise: Array, ordered: bool) -> tuple[Array, int]:
    """Return the covariance of the next recording's motor around this one's."""
    parts = len(step)
    if not ordered:
        return _positive(np.cov(step.T).reshape(noise.shape) - noise, noise), parts - 1
    x = np.column_stack([np.ones(parts), middle])
    answer = np.linalg.lstsq(x, step, rcond=None)[0]
    rest = step - x @ answer
    scatter = np.atleast_2d(rest.T @ rest / (parts - 2))
    drift = np.outer(answer[1], answer[1]) - scatter / np.square(middle).sum()
    return _positive(scatter - noise, noise) + _positive(drift, noise), parts - 2


def _positive(matrix: Array, scale: Array) -> Array:
    """Return the nearest covariance, in the units of another."""
    unit = np.sqrt(np.maximum(np.diag(scale), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(unit, unit))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(unit, unit))


def _steps(data: Experiments, fit: Fit) -> tuple[Array, Array, Array, list[int]] | None:
    """Return time (of the whole, 0 in the middle), step and covariance of each part."""
    structure, f = fit.structure, len(fit.structure.free)
    cut = _parted(data, fit, int(SEGMENTS.value))
    sums = gather(cut, structure, fit.z, cut.initial, fit.noise_model())
    common = [i for i, c in enumerate(structure.free) if c != "ln_te"]
    factors = np.sqrt(_fast_factors(fit))
    plausible = np.diag(structure.of_free(PLAUSIBLE))
    middle, steps, covs = [], [], []
    for b, (normal, gradient) in enumerate(zip(sums.normal, sums.gradient, strict=True)):
        left, score = _without_beginning(normal, gradient, f)
        inverse = _bounded_inverse(left + plausible)
        middle.append(0.5 * (cut.starts[b] + cut.starts[b + 1]) / data.size)
        steps.append(inverse @ score)
        covs.append(inverse * np.outer(factors, factors))
    step, cov, when = np.array(steps), np.array(covs), np.array(middle)
    variance = np.einsum("bii->bi", cov)
    size = [1.0 if n in LOGARITHMS else abs(fit.z.value(n)) for n in structure.free]
    known = 1 / np.maximum(variance, 1e-300)
    enough = known >= SEGMENT_INFORMATION.value * known.mean(axis=0)
    common = [i for i in common
              if np.median(variance[:, i]) < (LOOSE * max(size[i], 1e-12)) ** 2]  # fmt: skip
    keep = enough[:, common].all(axis=1)
    if keep.sum() < FEWEST or not common:
        return None
    at = np.ix_(keep, common, common)
    return when[keep] - when[keep].mean(), step[np.ix_(keep, common)], cov[at], common


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


def _fast_factors(fit: Fit) -> Array:
    """Return the sandwich factors of residuals that hang together for less than a part.

    Differences between neighbouring blocks (von Neumann) leave out what drifts.
    """
    cov = fit.white()
    n = len(fit.scores)
    if n <= 2 * cov.shape[0]:
        return np.ones(cov.shape[0])
    moved = np.diff(fit.scores, axis=0) @ cov
    sandwich = 0.5 * np.square(moved).sum(axis=0) * (n / (n - 1))
    return np.asarray(np.maximum(1.0, sandwich / np.maximum(np.diag(cov), 1e-300)))


def _parted(data: Experiments, fit: Fit, parts: int) -> Experiments:
    """Return the experiments cut into parts that begin as the fitted motor passes there."""
    edges = np.linspace(0, data.size, parts + 1).astype(np.int64)
    near = [int(e) for e in edges[1:-1] if np.abs(data.starts - e).min() > data.size // (3 * parts)]
    starts = np.array(sorted({*map(int, data.starts), *near}), dtype=np.int64)
    owner = np.searchsorted(data.starts, starts[:-1], side="right") - 1
    first = np.empty(starts.size - 1, dtype=np.int64)
    initial = np.zeros((starts.size - 1, 5))
    predicted = simulate(data, fit, gain=True)
    current = data.current.copy()
    reach = 2 * fit.z.current_lag * (sensor_of(fit.structure) == "averaged")
    for n, (begin, g) in enumerate(zip(starts[:-1], owner, strict=True)):
        a = int(data.hold_start[g])
        last = int(data.hold_start[g + 1]) if g + 2 < data.starts.size else data.hold_end.size
        first[n] = a + np.searchsorted(data.hold_end[a:last], data.time[begin] - 1e-12)
        if begin == data.starts[g]:
            initial[n] = fit.initial[g]
            continue
        if current.size:  # of which a mean is that of the part before
            end = int(np.searchsorted(data.time[begin : starts[n + 1]], data.time[begin] + reach))
            current[begin : begin + end] = np.nan
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
    return replace(data, starts=starts, hold_start=np.append(first, data.hold_start[-1]),
                   initial=initial, current=current)  # fmt: skip
