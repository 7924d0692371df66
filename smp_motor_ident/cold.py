"""From a cold start to the right minimum: rank candidates, grow the horizon, find the noise.

Derivation: docs/derivations.md, sections 8 and 10.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident import fit as fitting
from smp_motor_ident import models, start
from smp_motor_ident import recursion as rc
from smp_motor_ident.experiments import Experiments
from smp_motor_ident.fit import Fit, Prior, solve
from smp_motor_ident.models import Structure

Array = NDArray[np.float64]
Progress = Callable[[str], None]

FLOOR = 1.3  # residual variance over that of quantisation, below which there is no more
PRICE = 12.0  # deviance that torque noise must explain before it is believed
HEAD = 12_000  # samples on which candidates and noise levels are compared


@dataclass(frozen=True)
class Options:
    """What the user asked of a fit.

    Attributes
    ----------
    huber : float
        Bound of the robust loss [standard deviations]; infinite for least squares.
    priors : tuple of Prior
        Physical parameters that are known.
    lower, upper : ndarray, shape (11,), optional
        Bounds of z.
    """

    huber: float = np.inf
    priors: tuple[Prior, ...] = ()
    lower: Array | None = None
    upper: Array | None = None


def head(data: Experiments) -> Experiments:
    """Return the part on which models are compared, or all where that is little more.

    Parameters
    ----------
    data : Experiments
        Prepared records.

    Returns
    -------
    Experiments
        Of `HEAD` samples or so; ``data`` itself where it has less than three times as many.
    """
    part = data.head(HEAD * data.step)
    return part if data.size > 3 * part.size else data


def ratio_of(bandwidth: float, step: float, kind: int) -> float:
    """Return the torque-noise ratio at which the innovations follow with a bandwidth.

    Parameters
    ----------
    bandwidth : float
        [rad/s].
    step : float
        Sampling interval [s].
    kind : int
        Of the output.

    Returns
    -------
    float
        For `fit.kalman_gain`.
    """
    return bandwidth ** (4 if kind == rc.ANGLE else 2) * step


def first_noise(data: Experiments) -> Array:
    """Return a first guess of the residuals' covariance, from resolution and scatter.

    Parameters
    ----------
    data : Experiments
        Prepared records.

    Returns
    -------
    ndarray, shape (2, 2)
        Diagonal: variances of output and current.
    """
    y = data.output[:HEAD]
    rough = np.nanvar(np.diff(y, n=4)) / 70 if y.size > 8 else np.nanvar(y)
    v0 = max(data.quantum**2 / 12, 1e-12 * np.nanvar(y), 1e-4 * rough, 1e-18)
    v1 = 1.0
    if data.current.size:
        i = data.current[:HEAD]
        v1 = max(np.nanvar(np.diff(i, n=2)) / 6 * 0.1, 1e-8 * np.nanvar(i), 1e-12)
    return np.diag([float(v0), float(v1)])


def candidates(data: Experiments, structure: Structure) -> list[Array]:
    """Return starting coordinates for a structure, from linear regressions.

    Parameters
    ----------
    data : Experiments
        Prepared records.
    structure : Structure
        What will be fitted.

    Returns
    -------
    list of ndarray, shape (11,)
        Unranked.
    """
    found = start.current_candidates(data) if structure.current else []
    if not found:
        frictions = (False,) if structure.friction == "none" else (True, False)
        found = start.speed_candidates(data, structure.order, frictions=frictions)
    if not found and structure.order == 2:
        for z in start.speed_candidates(data, 1):
            z[models.A2] = 2 * z[models.A1] - z[models.A0] - np.log(20)
            z[models.TE] = z[models.A2] - z[models.A1]
            found.append(z)
    for z in found:
        if structure.window:
            z[models.WINDOW] = 1.02 * data.step
    return found


def _bandwidth(z: Array, data: Experiments) -> float:
    return float(min(np.exp(z[models.A0] - z[models.A1]), 0.2 / data.step))


def cold_fit(
    data: Experiments,
    structure: Structure,
    options: Options,
    extra: Sequence[Array] = (),
    keep: int = 3,
    own: bool = True,
) -> Fit | None:
    """Fit a structure without any guess.

    Parameters
    ----------
    data : Experiments
        Prepared records.
    structure : Structure
        What is free.
    options : Options
        Loss and prior knowledge.
    extra : sequence of ndarray, shape (11,)
        Further starts, such as a simpler structure's answer.
    keep : int
        How many of the ranked candidates are refined.
    own : bool
        Whether the regressions' candidates join ``extra``.

    Returns
    -------
    Fit or None
        None where no candidate could be simulated.
    """
    head = data.head(min(8.0, HEAD * data.step))
    starts = [
        structure.complete(z) for z in [*extra, *(candidates(data, structure) if own else [])]
    ]
    starts = [z for z in starts if np.all(np.isfinite(z))]
    if not starts:
        return None
    ranked = sorted(starts, key=lambda z: _score(head, structure, z))
    best: Fit | None = None
    tried: list[Array] = []
    if models.TE in structure.free() and not structure.current:
        ranked = [shaped for z in _distinct(ranked, data.step, 2) for shaped in _shapes(z)]
        keep = len(ranked)
    for z in ranked:
        if any(_alike(z, other, data.step) for other in tried):
            continue
        tried.append(z)
        ratio = ratio_of(_bandwidth(z, head), head.step, head.kind)
        one = _solve(head, structure, z, head.initial, first_noise(head), ratio, options, 25, 0.1)
        again = best is not None and abs(one.deviance - best.deviance) < 0.1
        if best is None or one.deviance < best.deviance:
            best = one
        if (again or structure.friction == "none") and one.converged:
            break  # two starts agree, or the surface is smooth
        if len(tried) == keep:
            break
    assert best is not None
    return grow(data, structure, best, options)


def _distinct(ranked: Sequence[Array], step: float, keep: int) -> list[Array]:
    out: list[Array] = []
    for z in ranked:
        if len(out) < keep and not any(_alike(z, other, step) for other in out):
            out.append(z)
    return out


def _shapes(z: Array) -> list[Array]:
    """Return the same response with L/R at several of the values that it leaves open."""
    out = []
    for factor in (1.02, 1.5, 2.5):
        shaped = z.copy()
        shaped[models.TE] = z[models.A2] - z[models.A1] + np.log(factor)
        par, _ = models.to_internal(shaped, 2)
        if factor < 1.1 or par[2] > 0.05 * np.exp(z[models.A0]):
            out.append(shaped)
    return out


def _alike(z: Array, other: Array, step: float) -> bool:
    d = np.abs(z - other)
    late = max(d[models.DELAY], d[models.WINDOW]) / step
    return bool(d[:5].max() < 0.05 and late < 0.5)


def refine(data: Experiments, structure: Structure, near: Fit, z: Array, options: Options) -> Fit:
    """Fit a structure from another's answer on the same data.

    Parameters
    ----------
    data : Experiments
        Prepared records.
    structure : Structure
        What is free now.
    near : Fit
        The other's answer.
    z : ndarray, shape (11,)
        Coordinates to start from.
    options : Options
        Loss and prior knowledge.

    Returns
    -------
    Fit
        With the noise ratio of ``near``.
    """
    return _solve(data, structure, z, initial_of(data, near), near.noise, near.ratio, options, 30)


def restate(data: Experiments, structure: Structure, fit: Fit, options: Options) -> Fit:
    """Return a fit's coordinates as the answer of a structure in which more is free.

    Parameters
    ----------
    data : Experiments
        What was fitted.
    structure : Structure
        What is free in the answer.
    fit : Fit
        With some of it held.
    options : Options
        Loss and prior knowledge.

    Returns
    -------
    Fit
        The same coordinates, with the information on all that is free.
    """
    once = _solve(data, structure, fit.z, fit.initial, fit.noise, fit.ratio, options, 1)
    return replace(once, z=fit.z, initial=fit.initial, converged=fit.converged)


def _score(head: Experiments, structure: Structure, z: Array) -> float:
    """Return the deviance of a candidate on the innovations (robust against drift)."""
    ratio = ratio_of(_bandwidth(z, head), head.step, head.kind)
    noise = first_noise(head)
    relative = noise[1, 1] / noise[0, 0] if head.current.size else 0.0
    gain, _ = fitting.kalman_gain(z, structure.order, head.kind, head.step, ratio, relative)
    spread = fitting.run_spread(head, structure, z, gain, noise)
    value = fitting.deviance(spread)
    return value if np.isfinite(value) else np.inf


def _solve(
    data: Experiments,
    structure: Structure,
    z: Array,
    initial: Array,
    noise: Array,
    ratio: float,
    options: Options,
    iterations: int,
    tolerance: float = 1e-2,
) -> Fit:
    return solve(
        data,
        structure,
        z,
        initial,
        noise,
        ratio,
        options.huber,
        options.priors,
        iterations,
        tolerance,
        lower=options.lower,
        upper=options.upper,
    )


def grow(data: Experiments, structure: Structure, first: Fit, options: Options) -> Fit:
    """Find the noise ratio on a growing horizon, then fit all data.

    Parameters
    ----------
    data : Experiments
        Prepared records.
    structure : Structure
        What is free.
    first : Fit
        On the head of the data, with a high ratio.
    options : Options
        Loss and prior knowledge.

    Returns
    -------
    Fit
        On all data.
    """
    part = data.head(min(HEAD * data.step, 60.0))
    best = _find_ratio(part, structure, first, options)
    best = _along_friction(part, structure, best, options)
    return extend(data, structure, best, options)


def extend(data: Experiments, structure: Structure, best: Fit, options: Options) -> Fit:
    """Carry a fit of the head on to all data, on a growing horizon.

    Parameters
    ----------
    data : Experiments
        Prepared records.
    structure : Structure
        What is free.
    best : Fit
        On the head of the data.
    options : Options
        Loss and prior knowledge.

    Returns
    -------
    Fit
        On all data.
    """
    part = data.head(min(HEAD * data.step, 60.0))
    if best.samples == data.size:
        return best
    horizon = part.size * 4 if structure.friction != "none" else data.size
    while horizon < data.size and best.ratio == 0:
        longer = data.head(horizon * data.step)
        best = _solve(
            longer, structure, best.z, initial_of(longer, best), best.noise, best.ratio, options, 8
        )
        horizon *= 6
    return _solve(
        data, structure, best.z, initial_of(data, best), best.noise, best.ratio, options, 25
    )


def _along_friction(part: Experiments, structure: Structure, best: Fit, options: Options) -> Fit:
    """Try other shares of friction and gain that turn the motor as fast at full voltage.

    Without current the two trade against each other along a long curved valley.
    """
    if structure.current or models.VC_PLUS not in structure.free():
        return best
    full = float(np.abs(part.section_value).max())
    for share in (0.01, 0.025, 0.06):
        z = best.z.copy()
        z[models.VC_PLUS] = share * full
        z[models.A0] += np.log((full - share * full) / max(full - best.z[models.VC_PLUS], 1e-9))
        other = _solve(part, structure, structure.complete(z), best.initial, best.noise,
                       best.ratio, options, 30)  # fmt: skip
        if other.deviance < best.deviance - 1:
            best = other
    if best.converged or structure.friction != "symmetric":
        return best
    return _scan_friction(part, structure, best, options, full)


def _scan_friction(
    part: Experiments, structure: Structure, best: Fit, options: Options, full: float
) -> Fit:
    """Search friction by the profile of the deviance: the others are fitted at each value.

    Where the motor sticks often, the joint surface has a kink at every start and stop, and a
    descent along the valley ends at one of them; across the valley it does not.
    """
    profile: dict[float, Fit] = {}

    def at(level: float) -> Fit:
        if level not in profile:
            near = min(profile.values(), key=lambda f: abs(_level(f) - level), default=best)
            z = near.z.copy()
            z[models.A0] += np.log((full - level) / max(full - _level(near), 1e-9))
            fixed = structure.with_(held={**structure.held, "vc_plus": level})
            profile[level] = _solve(part, fixed, fixed.complete(z), near.initial, near.noise,
                                    best.ratio, options, 12, 0.1)  # fmt: skip
        return profile[level]

    grid = sorted({_level(best), *(full * np.array([0.003, 0.008, 0.016, 0.025, 0.04, 0.08]))})
    for level in grid:
        at(level)
    for _ in range(8):
        levels = sorted(profile)
        i = levels.index(min(levels, key=lambda x: profile[x].deviance))
        low, high = levels[max(i - 1, 0)], levels[min(i + 1, len(levels) - 1)]
        at(0.5 * (low + levels[i]) if levels[i] - low > high - levels[i] else
           0.5 * (high + levels[i]))  # fmt: skip
    least = min(profile.values(), key=lambda f: f.deviance)
    if least.deviance >= best.deviance - 1:
        return best
    return _solve(part, structure, least.z, least.initial, least.noise, best.ratio, options, 30)


def _level(fit: Fit) -> float:
    return float(fit.z[models.VC_PLUS])


def initial_of(data: Experiments, fit: Fit) -> Array:
    """Return a fit's initial states for more data; those it lacks from the measurements.

    Parameters
    ----------
    data : Experiments
        With as many segments as the fit has, or more.
    fit : Fit
        Of a part of them.

    Returns
    -------
    ndarray, shape (g, 4)
        As in `fit.Fit`.
    """
    initial = data.initial.copy()
    n = min(len(initial), len(fit.initial))
    initial[:n] = fit.initial[:n]
    return initial


def _find_ratio(part: Experiments, structure: Structure, first: Fit, options: Options) -> Fit:
    """Walk from following to free run; keep the likeliest ratio of torque noise."""
    # A speed output survives torque noise in free run, and free run has no bias where the
    # model is not the motor; the innovations form is for angles, which drift.
    if part.kind != rc.ANGLE:
        return _at_rest(
            part,
            structure,
            _solve(
                part, structure, first.z, initial_of(part, first), first.noise, 0.0, options, 30
            ),
            options,
        )
    # Residuals no larger than the counter's own resolution leave nothing for torque noise.
    at_once = _at_rest(part, structure, _solve(part, structure, first.z, initial_of(part, first),
                       first.noise, 0.0, options, 30), options)  # fmt: skip
    if at_once.converged and at_once.noise[0, 0] < FLOOR * part.quantum**2 / 12:
        return at_once
    band = _bandwidth(first.z, part)
    path: list[tuple[float, Fit]] = []
    here = first
    for factor in (1.0, 0.3, 0.1, 0.03, 0.01, 0.0):
        ratio = ratio_of(band * factor, part.step, part.kind)
        here = _at_rest(
            part,
            structure,
            _solve(part, structure, here.z, initial_of(part, here), here.noise, ratio, options, 20),
            options,
        )
        path.append((factor, here))
        worst = here.deviance - min(f.deviance for _, f in path)
        if factor > 0 and worst > (60 if here.converged else 2000):
            break
    factor, best = min(path, key=lambda item: item[1].deviance)
    free_run = path[-1][1]
    if at_once.deviance < free_run.deviance or free_run.ratio > 0:
        free_run = at_once
    if factor == 0.0 or free_run.deviance < best.deviance + PRICE:
        return free_run
    for finer in (1.8, 1 / 1.8):
        while True:
            ratio = ratio_of(band * factor * finer, part.step, part.kind)
            here = _solve(part, structure, best.z, best.initial, best.noise, ratio, options, 12)
            if here.deviance >= best.deviance - 0.5:
                break
            best, factor = here, factor * finer
            if factor > 30:
                break
    return best


def _at_rest(data: Experiments, structure: Structure, fit: Fit, options: Options) -> Fit:
    """Try whether segments that begin slowly began at rest: friction makes that a kink."""
    if structure.friction == "none":
        return fit
    first = np.abs(fit.initial[:, 1])
    slow = (first > 0) & (
        first < 0.05 * np.exp(-fit.z[models.A0]) * np.abs(data.section_value).max()
    )
    if not slow.any():
        return fit
    initial = fit.initial.copy()
    initial[slow, 1] = 0.0
    other = _solve(data, structure, fit.z, initial, fit.noise, fit.ratio, options, 12)
    return other if other.deviance < fit.deviance else fit
