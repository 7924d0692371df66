"""Least squares on the innovations: passes, Levenberg-Marquardt steps, noise, covariance.

Derivation: docs/derivations.md, sections 6 to 9.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident import models, recursion
from smp_motor_ident.experiments import Experiments
from smp_motor_ident.kalman import steady_gain
from smp_motor_ident.models import Structure, to_internal

Array = NDArray[np.float64]

PLAUSIBLE = np.array([1e-2, 1e-2, 1e-2, 0.25, 1e-4, 1e-4, 1e-4, 1e-2, 1e-4, 1e-2, 1e-2])
"""Inverse squares of how far each coordinate z could be from any value at all."""
STALL = 4, 0.02  # passes that together gain less deviance than this end a descent
FREE = 0.1  # damping (relative to the diagonal) below which a step counts as undamped
BLOCKS = 60  # runs of samples whose scores are summed, for the covariance of coloured residuals


@dataclass(frozen=True)
class Prior:
    """A statement of the user, ``row z = value`` within ``std``, linear around the estimate."""

    name: str
    value: float
    std: float


@dataclass(frozen=True, eq=False)
class Pass:
    """What one run over the data gave."""

    objective: float
    normal: Array
    gradient: Array
    local_step: Array
    local_gain: Array
    spread: Array
    scores: Array


@dataclass(frozen=True, eq=False)
class Fit:
    """A structure fitted to experiments.

    Attributes
    ----------
    structure : Structure
        What was free.
    z : ndarray, shape (11,)
        Coordinates.
    initial : ndarray, shape (g, 4)
        q, w, angle, load of each segment.
    noise : ndarray, shape (2, 2)
        Covariance of the innovations of (output, current).
    ratio : float
        Intensity of the torque noise over the output's noise variance.
    objective : float
        Weighted sum of squares.
    deviance : float
        -2 log likelihood, up to a constant of the data.
    information : ndarray, shape (f, f)
        Normal matrix of the free coordinates, initial states eliminated.
    scores : ndarray, shape (blocks, f)
        Scores summed over runs of samples.
    passes : int
        Runs over the data that it took.
    converged : bool
        Whether the last step was small.
    samples, kind : int
        Of the data.
    widen : ndarray, shape (f,), optional
        Factors on the standard deviations, see `quantisation.widened`.
    blur : ndarray, shape (f, f), optional
        Covariance from instants that are not known exactly, see `quantisation.blurred`.
    """

    structure: Structure
    z: Array
    initial: Array
    noise: Array
    ratio: float
    gain: Array
    objective: float
    deviance: float
    information: Array
    scores: Array
    passes: int
    converged: bool
    samples: int
    kind: int
    widen: Array | None = None
    blur: Array | None = None

    def covariance(self) -> Array:
        """Return the covariance of the free coordinates, shape (f, f).

        The inverse information, widened coordinate by coordinate where the scores of
        whole runs of samples scatter more than white residuals would let them.
        """
        # Every coordinate lies within some e-folds or volts of any motor's: without that a
        # direction that the data leave open would count as known.
        information = self.information + np.diag(PLAUSIBLE[list(self.structure.free())])
        scale = np.sqrt(np.diag(information))
        values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
        vectors = vectors / scale[:, None]
        cov: Array = (vectors / np.maximum(values, 1e-15)) @ vectors.T
        n = len(self.scores)
        if n > 2 * cov.shape[0]:
            moved = (self.scores - self.scores.mean(axis=0)) @ cov
            sandwich = moved.T @ moved * (n / (n - 1))
            widen = np.sqrt(np.maximum(1.0, np.diag(sandwich) / np.maximum(np.diag(cov), 1e-300)))
            cov = cov * np.outer(widen, widen)
        if self.widen is not None:
            cov = cov * np.outer(self.widen, self.widen)
        if self.blur is not None:
            cov = cov + self.blur
        return cov


def _run(
    data: Experiments,
    structure: Structure,
    z: Array,
    initial: Array,
    gain: Array,
    noise: Array,
    huber: float,
    predicted: Array | None = None,
    local: tuple[int, ...] | None = None,
    free: bool = True,
    blocks: int = BLOCKS,
) -> tuple[Array, Array, Array, Array, Array, NDArray[np.int64]]:
    par, internal = to_internal(z, structure.order)
    matrix = structure.matrix() if free else np.zeros((11, 0))
    slope = np.ascontiguousarray(internal @ matrix)
    n_slope = sum(1 for i in structure.free() if i <= models.TE) if free else 0
    kinds = np.array(_local(data, structure) if local is None else local, dtype=np.int64)
    p = matrix.shape[1] + len(kinds)
    segments = len(data.starts) - 1
    length = max(1, -(-data.size // blocks))
    rows = data.size // length + 2 * segments + 2
    block_scores = np.empty((rows, p))
    block_segment = np.empty(rows, dtype=np.int64)
    ring = np.zeros((0, 0))
    kind = data.kind
    if kind == recursion.MEAN_SPEED:
        depth = 4 + int(np.ceil(par[recursion.WINDOW] / _shortest(data)))
        ring = np.zeros((min(depth, data.size + 1), 3 + 2 * p))
    normal = np.empty((segments, p, p))
    gradient = np.empty((segments, p))
    cost = np.empty(segments)
    spread = np.empty(6)
    if predicted is None and _uneventful(data, structure, z, gain, huber):
        used = recursion.run_linear(
            data.time,
            data.starts,
            data.section_value,
            data.output,
            kind == recursion.ANGLE,
            par,
            slope,
            n_slope,
            initial,
            kinds,
            1 / math.sqrt(noise[0, 0]),
            normal,
            gradient,
            cost,
            spread,
            length,
            block_scores,
            block_segment,
        )
        return normal, gradient, cost, spread, block_scores[:used], block_segment[:used]
    used = recursion.run(
        data.time,
        data.starts,
        data.section_end,
        data.section_value,
        data.section_start,
        data.output,
        data.current,
        kind,
        structure.friction != "none",
        par,
        slope,
        n_slope,
        initial,
        kinds,
        gain,
        whitening(noise),
        huber,
        normal,
        gradient,
        cost,
        spread,
        length,
        block_scores,
        block_segment,
        ring,
        np.zeros((0, 3)) if predicted is None else predicted,
    )
    return normal, gradient, cost, spread, block_scores[:used], block_segment[:used]


def _uneventful(
    data: Experiments, structure: Structure, z: Array, gain: Array, huber: float
) -> bool:
    """Tell whether `recursion.run_linear` does: nothing happens between the samples."""
    return bool(
        structure.friction == "none"
        and not structure.delay
        and z[models.DELAY] == 0.0
        and data.kind != recursion.MEAN_SPEED
        and not data.current.size
        and not np.isfinite(huber)
        and not gain.any()
        and data.section_end.ctypes.data == data.time.ctypes.data
    )


def _shortest(data: Experiments) -> float:
    steps = np.diff(data.time)
    return float(steps[steps > 0].min())


def _local(data: Experiments, structure: Structure) -> tuple[int, ...]:
    order1 = structure.order == 1
    angle = (2,) if data.kind == recursion.ANGLE else ()
    return ((1,) if order1 else (0, 1)) + angle + ((3,) if structure.own_load else ())


def whitening(noise: Array) -> Array:
    """Return the whitening rows of `recursion.run` for a 2 x 2 noise covariance.

    Parameters
    ----------
    noise : ndarray, shape (2, 2)
        Covariance of (output, current).

    Returns
    -------
    ndarray, shape (2, 3)
        Inverse Cholesky factor; in the third column, of each output alone.
    """
    w = np.zeros((2, 3))
    w[:, :2] = np.linalg.inv(np.linalg.cholesky(noise))
    w[:, 2] = 1 / np.sqrt(np.diag(noise))
    return w


def _pass(
    data: Experiments,
    structure: Structure,
    z: Array,
    initial: Array,
    start: Array,
    gain: Array,
    noise: Array,
    huber: float,
    priors: Sequence[tuple[Array, float]],
) -> Pass:
    """Run, add what is known beforehand, and eliminate the initial states."""
    normal, gradient, cost, spread, scores, owner = _run(
        data, structure, z, initial, gain, noise, huber
    )
    f = structure.matrix().shape[1]
    local = _local(data, structure)
    total = float(cost.sum())
    # A wide prior on the initial states keeps a motor at rest, whose speed the data do not
    # touch, solvable; a hundredth of a sample's information at most.
    for j, kind in enumerate(local):
        precision = 1e-2 * np.maximum(1e-12, normal[:, f + j, f + j] / data.size) + 1e-9
        off = initial[:, kind] - start[:, kind]
        total += float((precision * off**2).sum())
        gradient[:, f + j] -= precision * off
        normal[:, f + j, f + j] += precision
    n_common = normal[:, :f, :f].sum(axis=0)
    g_common = gradient[:, :f].sum(axis=0)
    for row, miss in priors:
        n_common += np.outer(row, row)
        g_common += row * miss
        total += miss * miss
    sums = total + n_common.sum() + normal.sum() + gradient.sum()
    if not np.isfinite(sums):
        empty = np.zeros((f, f))
        return Pass(
            np.inf,
            empty,
            empty[:0].sum(axis=0),
            local_step=np.zeros((len(normal), len(local))),
            local_gain=np.zeros((len(normal), len(local), f)),
            spread=np.full(6, np.nan),
            scores=np.zeros((0, f)),
        )
    n_local, g_local = normal[:, f:, f:], gradient[:, f:]
    cross = normal[:, f:, :f]
    scale = np.sqrt(np.einsum("gii->gi", n_local))
    scaled = n_local / scale[:, :, None] / scale[:, None, :]
    inverse = (
        np.linalg.inv(scaled + 1e-12 * np.eye(len(local))) / scale[:, :, None] / scale[:, None, :]
    )
    local_step = np.einsum("gij,gj->gi", inverse, g_local)
    local_gain = np.einsum("gij,gjk->gik", inverse, cross)
    n_common -= np.einsum("gik,gil->kl", cross, local_gain)
    g_common -= np.einsum("gik,gi->k", cross, local_step)
    scores_common = scores[:, :f] - np.einsum("bi,bik->bk", scores[:, f:], local_gain[owner])
    return Pass(total, n_common, g_common, local_step, local_gain, spread, scores_common)


def kalman_gain(
    z: Array, order: int, kind: int, step: float, ratio: float, current_noise: float
) -> tuple[Array, Array]:
    """Return the steady innovation gain of the sliding motor under torque noise.

    Parameters
    ----------
    z : ndarray, shape (11,)
        Coordinates.
    order, kind : int
        Of the structure and of the output.
    step : float
        Sampling interval [s].
    ratio : float
        Intensity of white noise on the acceleration over the output's noise variance.
    current_noise : float
        Variance of the current's noise over that of the output; 0 without current.

    Returns
    -------
    gain : ndarray, shape (3, 2)
        From (output, current) to (q, w, angle).
    innovation : ndarray, shape (2, 2)
        Covariance of the innovations over the output's noise variance.
    """
    gain = np.zeros((3, 2))
    innovation = np.diag([1.0, current_noise if current_noise > 0 else 1.0])
    if ratio <= 0 or kind != recursion.ANGLE:
        return gain, innovation
    par, _ = to_internal(z, order)
    found, spread = steady_gain(par[0], par[1], par[2], par[3], par[7], step, ratio, current_noise)
    if not np.all(np.isfinite(found)):
        return gain, innovation
    return found, spread


def solve(  # noqa: C901 - the loop of a fit, its branches are its ends
    data: Experiments,
    structure: Structure,
    z: Array,
    initial: Array,
    noise: Array,
    ratio: float = 0.0,
    huber: float = np.inf,
    priors: Sequence[Prior] = (),
    iterations: int = 40,
    tolerance: float = 1e-2,
    lower: Array | None = None,
    upper: Array | None = None,
) -> Fit:
    """Minimise the innovations' sum of squares from a start, noise covariance included.

    Levenberg-Marquardt in z with the initial states eliminated; the noise covariance is
    re-estimated from the residuals until it stays (concentrated likelihood).

    Parameters
    ----------
    data : Experiments
        Prepared records.
    structure : Structure
        What is free.
    z, initial, noise : ndarray
        Start: coordinates, initial states, covariance of the output and current residuals.
    ratio : float
        Torque noise over output noise, see `kalman_gain`.
    huber : float
        Bound of the robust loss in standard deviations.
    priors : sequence of Prior
        What the user knows of physical parameters.
    iterations : int
        Most passes over the data.
    tolerance : float
        Ends when a step is below this fraction of every standard deviation.
    lower, upper : ndarray, shape (11,), optional
        Bounds of z.

    Returns
    -------
    Fit
        With ``converged`` False where the passes did not suffice.
    """
    matrix = structure.matrix()
    z = structure.complete(z)
    initial = initial.copy()
    start = initial.copy()
    lower = _bounds(-np.inf) if lower is None else lower
    upper = np.full(11, np.inf) if upper is None else upper
    has_current = data.current.size > 0
    damping, passes, converged = 1e-3, 0, False
    recent: list[float] = []
    gain: Array = np.zeros((3, 2))
    here: Pass | None = None
    for outer in range(12):
        gain, noise = _gain(data, structure, z, ratio, noise, has_current)
        prior = _linearise(priors, z, matrix)
        here = _pass(data, structure, z, initial, start, gain, noise, huber, prior)
        passes += 1
        converged = False
        recent.clear()
        if not np.isfinite(here.objective):
            break
        while passes < iterations:
            step, frozen = _step(here, damping, matrix, z, lower, upper)
            trial = structure.complete(np.clip(z + matrix @ step, lower, upper))
            _project(trial, structure)
            moved = initial.copy()
            change = here.local_step - np.einsum("gik,k->gi", here.local_gain, step)
            for j, kind in enumerate(_local(data, structure)):
                moved[:, kind] += change[:, j]
            new = _pass(
                data,
                structure,
                trial,
                moved,
                start,
                gain,
                noise,
                huber,
                _linearise(priors, trial, matrix),
            )
            passes += 1
            # A step may be small because it is damped: only a nearly free one tells the end.
            small = step.size > 0 and _relative_step(here, step, frozen) < tolerance
            small = small and damping < FREE
            gained = max(here.objective - new.objective, 0.0) if new.objective < np.inf else 0.0
            if new.objective <= here.objective:
                recent.append(gained * data.size / max(here.objective, 1e-300))
            if len(recent) >= STALL[0] and sum(recent[-STALL[0] :]) < STALL[1]:
                converged = _undamped(here, matrix, z, lower, upper)
                break
            if new.objective <= here.objective * (1 + 1e-12):
                z, initial, here = trial, moved, new
                damping = max(damping * 0.1, 1e-9)
                if small or (gained < 1e-9 * here.objective and damping < FREE):
                    converged = True
                    break
                if outer == 0 and gained < 1e-3 * here.objective and not small:
                    break
            else:
                if small:
                    converged = True
                    break
                damping = max(damping, 1e-6) * 8
                if damping > 1e6:  # a kink: no step leads down, small or large
                    converged = _undamped(here, matrix, z, lower, upper)
                    break
        fresh = _noise(here.spread, noise, has_current)
        same = np.abs(np.log(np.diag(fresh) / np.diag(noise))).max() < 2e-2
        only_scale = not has_current and not np.isfinite(huber)
        if (
            passes >= iterations
            or not np.isfinite(here.objective)
            or (converged and (same or (only_scale and ratio == 0)))
        ):
            break
        noise = fresh
    assert here is not None
    if not np.isfinite(here.objective):
        return Fit(
            structure,
            z,
            initial,
            noise,
            ratio,
            gain,
            np.inf,
            np.inf,
            here.normal,
            here.scores,
            passes,
            False,
            data.size,
            data.kind,
        )
    final = _noise(here.spread, noise, has_current)
    grow = noise[0, 0] / final[0, 0]
    information, scores = here.normal, here.scores
    if not has_current:
        information, scores = information * grow, scores * grow
    return Fit(
        structure,
        z,
        initial,
        final,
        ratio,
        gain,
        here.objective,
        deviance(here.spread),
        information,
        scores,
        passes,
        converged,
        data.size,
        data.kind,
    )


def _bounds(low: float) -> Array:
    lower = np.full(11, low)
    lower[[models.VC_PLUS, models.VC_MINUS, models.DELAY]] = 0.0
    lower[models.WINDOW] = 1e-9
    return lower


def _gain(
    data: Experiments, structure: Structure, z: Array, ratio: float, noise: Array, current: bool
) -> tuple[Array, Array]:
    if ratio <= 0:
        return np.zeros((3, 2)), noise
    relative = noise[1, 1] / noise[0, 0] if current else 0.0
    gain, innovation = kalman_gain(z, structure.order, data.kind, data.step, ratio, relative)
    for _ in range(3):  # noise holds innovations; the ratio of the sensors' own is wanted
        if not current:
            break
        relative = (noise[1, 1] / innovation[1, 1] * relative) / (noise[0, 0] / innovation[0, 0])
        gain, innovation = kalman_gain(z, structure.order, data.kind, data.step, ratio, relative)
    return gain, noise


def _linearise(priors: Sequence[Prior], z: Array, matrix: Array) -> list[tuple[Array, float]]:
    if not priors:
        return []
    values, gradients = models.physical(z)
    return [
        (gradients[p.name] @ matrix / p.std, (p.value - values[p.name]) / p.std) for p in priors
    ]


def _step(
    here: Pass, damping: float, matrix: Array, z: Array, lower: Array, upper: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the damped Gauss-Newton step; columns pushed against a bound stay."""
    n, g = here.normal, here.gradient
    if len(g) == 0:
        return np.zeros(0), np.zeros(0, dtype=bool)
    scale = np.sqrt(np.maximum(np.diag(n), 1e-300))
    frozen = np.zeros(len(g), dtype=bool)
    step = np.zeros(len(g))
    for _ in range(len(g)):
        keep = ~frozen
        a = n[np.ix_(keep, keep)] / np.outer(scale[keep], scale[keep])
        a += damping * np.eye(a.shape[0]) + 1e-14 * np.eye(a.shape[0])
        step[:] = 0.0
        step[keep] = np.linalg.lstsq(a, g[keep] / scale[keep], rcond=None)[0] / scale[keep]
        move = matrix @ step
        stuck = ((z <= lower) & (move < 0)) | ((z >= upper) & (move > 0))
        more = (np.abs(matrix[stuck]).sum(axis=0) > 0) & keep
        if not more.any():
            break
        frozen |= more
    longest = float(np.max(np.abs(matrix @ step)[:4]))
    return (step * (1.5 / longest) if longest > 1.5 else step), frozen


def _undamped(here: Pass, matrix: Array, z: Array, lower: Array, upper: Array) -> bool:
    """Tell whether an undamped step would stay within half a standard deviation."""
    step, frozen = _step(here, 1e-9, matrix, z, lower, upper)
    return _relative_step(here, step, frozen) < 0.5


def _relative_step(here: Pass, step: Array, frozen: NDArray[np.bool_]) -> float:
    keep = ~frozen
    s = step[keep]
    size = float(s @ here.normal[np.ix_(keep, keep)] @ s)
    return math.sqrt(max(0.0, size))


def _project(z: Array, structure: Structure) -> None:
    """Keep K and (without current) b of one sign, in place."""
    if structure.order != 2 or models.TE not in structure.free():
        return
    if structure.current:
        return
    z[models.TE] = max(z[models.TE], z[models.A2] - z[models.A1])
    for _ in range(60):
        par, _ = to_internal(z, 2)
        if par[2] > 0.02 * np.exp(z[models.A0]):
            return
        z[models.TE] += 0.3 if z[models.TE] > z[models.A2] - z[models.A1] + 0.7 else -0.05


def _noise(spread: Array, noise: Array, current: bool) -> Array:
    fresh = noise.copy()
    fresh[0, 0] = max(spread[0] / max(spread[3], 1), 1e-24)
    if current:
        fresh[1, 1] = max(spread[1] / max(spread[4], 1), 1e-24)
        limit = 0.95 * np.sqrt(fresh[0, 0] * fresh[1, 1])
        fresh[0, 1] = fresh[1, 0] = np.clip(spread[2] / max(spread[5], 1), -limit, limit)
    return fresh


def deviance(spread: Array) -> float:
    """Return -2 log likelihood up to a constant: N log det of the innovations' covariance.

    Parameters
    ----------
    spread : ndarray, shape (6,)
        Of `recursion.run`.

    Returns
    -------
    float
        Outputs taken together where both were there.
    """
    v0 = spread[0] / max(spread[3], 1)
    if spread[4] < 1:
        return float(spread[3] * np.log(max(v0, 1e-300)))
    v1 = spread[1] / spread[4]
    # The three are means over different samples where outputs were lost, and need not belong
    # to one covariance.
    limit = 0.95 * np.sqrt(v0 * v1)
    c = np.clip(spread[2] / max(spread[5], 1), -limit, limit)
    together = np.log(max(v0 * v1 - c * c, 1e-300))
    return float(
        spread[5] * together
        + (spread[3] - spread[5]) * np.log(max(v0, 1e-300))
        + (spread[4] - spread[5]) * np.log(max(v1, 1e-300))
    )


def run_spread(
    data: Experiments, structure: Structure, z: Array, gain: Array, noise: Array
) -> Array:
    """Return the sums of squared residuals of coordinates as they are.

    Parameters
    ----------
    data : Experiments
        Prepared records.
    structure : Structure
        Order and friction.
    z, gain, noise : ndarray
        Coordinates, innovation gain, covariance.

    Returns
    -------
    ndarray, shape (6,)
        As in `recursion.run`.
    """
    return _run(data, structure, z, data.initial, gain, noise, np.inf, local=(), free=False)[3]


def simulate(data: Experiments, fit: Fit, gain: bool = False) -> Array:
    """Return speed, output and current as the fitted motor predicts them.

    Parameters
    ----------
    data : Experiments
        With as many segments as the fit has initial states.
    fit : Fit
        Coordinates, initial states.
    gain : bool
        Whether measurements correct the state (innovations) or not (free run).

    Returns
    -------
    ndarray, shape (n, 3)
        [rad/s], [output], [A].
    """
    predicted = np.empty((data.size, 3))
    used = fit.gain if gain else np.zeros((3, 2))
    _run(
        data,
        fit.structure,
        fit.z,
        fit.initial,
        used,
        fit.noise,
        np.inf,
        predicted,
        local=(),
        free=False,
    )
    return predicted


def information(data: Experiments, fit: Fit) -> Array:
    """Return the Fisher information that experiments would give about a fit's coordinates.

    Parameters
    ----------
    data : Experiments
        Their times and voltages; outputs may be zero.
    fit : Fit
        Coordinates and noise.

    Returns
    -------
    ndarray, shape (f, f)
        Initial states eliminated.
    """
    here = _pass(
        data, fit.structure, fit.z, fit.initial, fit.initial, fit.gain, fit.noise, np.inf, ()
    )
    return here.normal


def one_step(data: Experiments, fit: Fit) -> Array:
    """Return the Gauss-Newton step that other outputs on the same motion would ask for.

    Parameters
    ----------
    data : Experiments
        With the outputs replaced.
    fit : Fit
        Where it starts.

    Returns
    -------
    ndarray, shape (f,)
        Of the free coordinates.
    """
    here = _pass(
        data, fit.structure, fit.z, fit.initial, fit.initial, fit.gain, fit.noise, np.inf, ()
    )
    scale = np.sqrt(np.maximum(np.diag(here.normal), 1e-300))
    scaled = here.normal / np.outer(scale, scale)
    step = np.linalg.pinv(scaled, rcond=1e-13, hermitian=True) @ (here.gradient / scale) / scale
    return np.asarray(step)


def promise(data: Experiments, fit: Fit, richer: Structure) -> tuple[float, Array, Array]:
    """Return what freeing more would gain, by the score: one pass in place of a fit.

    Parameters
    ----------
    data : Experiments
        What was fitted.
    fit : Fit
        Converged.
    richer : Structure
        In which more is free.

    Returns
    -------
    gain : float
        Deviance, to second order.
    step : ndarray, shape (f,)
        Undamped step of the free coordinates.
    covariance : ndarray, shape (f, f)
        Of white residuals.
    """
    z = richer.complete(fit.z)
    here = _pass(data, richer, z, fit.initial, fit.initial, fit.gain, fit.noise, np.inf, ())
    scale = np.sqrt(np.maximum(np.diag(here.normal), 1e-300))
    inverse = np.linalg.pinv(here.normal / np.outer(scale, scale), rcond=1e-13, hermitian=True)
    covariance = inverse / np.outer(scale, scale)
    step = covariance @ here.gradient
    return float(here.gradient @ step), step, covariance


def settle(data: Experiments, fit: Fit, iterations: int = 12) -> Fit:
    """Fit only the initial states and constant loads of other data (free run).

    Parameters
    ----------
    data : Experiments
        Such as held-out records.
    fit : Fit
        The motor.
    iterations : int
        Most passes.

    Returns
    -------
    Fit
        With the initial states and loads of ``data``; the motor is as it was.
    """
    free = fit.structure.free()
    held = {**fit.structure.held, **{models.Z_NAMES[i]: float(fit.z[i]) for i in free}}
    if models.TE not in free and "ln_te" not in held:
        held["ln_te"] = float(fit.z[models.TE])
    if fit.structure.friction == "symmetric":
        held["vc_minus"] = float(fit.z[models.VC_MINUS])
    structure = fit.structure.with_(held=held, own_load=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        done = solve(data, structure, fit.z, data.initial, fit.noise, iterations=iterations)
    return replace(done, structure=fit.structure, z=fit.z)
