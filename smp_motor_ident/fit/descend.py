# SPDX-License-Identifier: Apache-2.0
"""Weighted least squares of a chain on data, from given values.

Levenberg-Marquardt on residuals whitened by the noise of every output; derivatives are differences
between lanes of one simulation.  The initial state of every segment is eliminated.
Derivation: docs/derivations.md, sections 5 and 6.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.chain.chain import Chain, Constraint, respond
from smp_motor_ident.chain.component import Scales
from smp_motor_ident.chain.quantities import jacobian
from smp_motor_ident.fit.data import Data
from smp_motor_ident.fit.noise import MAX_ORDER, Noise, fit_noise

FARTHEST = 1.5  # e-folds that a logarithm moves in one step
MAX_STEPS = 30
CONVERGED = 1e-2  # of the deviance: a tenth of a standard deviation
MOST_DAMPING = 100.0
PRIOR_STATE = 2.0  # of q and speed at the beginning of a segment, in the largest of the recording


@dataclass(frozen=True, eq=False)
class Linear:
    """Residuals and derivatives of a chain at its values, whitened; segments' states eliminated.

    The last ``priors`` rows are of the motor's prior.
    """

    residual: Array  # shape (m + priors,)
    columns: Array  # shape (m + priors, p)
    row: Integers  # shape (m,): row of the record
    output: Integers  # shape (m,): place of the output
    priors: int
    local_step: Array  # shape (segments, 3): of the initial states at a step of zero
    local_gain: Array  # shape (segments, 3, p): its decrease per parameter step
    simulated: tuple[Array, ...]  # every output, shape (n,)
    local: Array  # shape (3, m): derivatives by the initial states
    inverse: Array  # shape (segments, 3, 3): of their normal matrix, with their prior

    @cached_property
    def cost(self) -> float:
        """Sum of squares."""
        return float(self.residual @ self.residual)

    @cached_property
    def normal(self) -> Array:
        """Normal matrix, shape (p, p)."""
        return np.asarray(self.columns.T @ self.columns)


@dataclass(frozen=True, eq=False)
class Fit:
    """A chain that was fitted to data."""

    chain: Chain
    scales: Scales
    initial: Array  # shape (segments, 4)
    noise: tuple[Noise, ...]  # of every output
    linear: Linear
    deviance: float  # -2 log likelihood, up to a constant of the data

    @cached_property
    def priors(self) -> tuple[str, ...]:
        """Causes of the last rows of ``linear``."""
        return _prior(self.chain, self.scales)[2]

    @property
    def motion(self) -> Array:
        """The simulated motion, shape (n,)."""
        return self.linear.simulated[0]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that were estimated."""
        return tuple(p.name for p in self.chain.free)

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the estimated parameters under their noise model, shape (p, p)."""
        return invert(self.linear.normal)


def invert(normal: Array) -> Array:
    """Return the inverse of a normal matrix; without information the variance is very large."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-13)) @ vectors.T
    return np.asarray(inverse / np.outer(scale, scale))


def linearise(
    data: Data, chain: Chain, scales: Scales, initial: Array, noise: Sequence[Noise]
) -> Linear:
    """Return whitened residuals and derivatives of a chain."""
    free = chain.free
    p = len(free)
    # The base, each parameter, then q and w of the segments unless all begin at rest.
    states = 0 if data.stood.all() else 2
    count = p + 1 + states
    values = {q.name: np.full(count, chain.values[q.name]) for q in chain.parameters}
    difference = np.empty(p + 2)
    for j, parameter in enumerate(free):
        d = parameter.difference(scales)
        if chain.values[parameter.name] + d > parameter.bounds(scales)[1]:
            d = -d
        if parameter.name == "delay":
            d = abs(d)
        difference[j] = d
        values[parameter.name][j + 1] += d
    own = np.zeros((4, count))
    difference[p:] = 1e-6 * scales.volts, 1e-6 * scales.speed
    for j in range(states):
        own[j, p + 1 + j] = difference[p + j]
    outputs = _outputs(chain, values, data, scales, initial, own)
    parts = []
    for k, (measured, predicted) in enumerate(zip(data.outputs, outputs, strict=True)):
        known = data.known[k]
        lines = np.zeros((p + 4, known.size))
        lines[0] = measured[known] - predicted[0, known]
        np.subtract(predicted[1:, known], predicted[0, known], out=lines[1:count])
        lines[1:count] /= difference[: count - 1, None]
        lines[p + 3] = 1.0 if data.is_angle and k == 0 else 0.0
        parts.append(noise[k].whiten(lines, _runs(data, k, noise[k])))
    residuals, rows, _ = _prior(chain, scales)
    priors = np.zeros((p + 4, residuals.size))
    priors[0], priors[1 : p + 1] = residuals, rows.T
    simulated = tuple(predicted[0].copy() for predicted in outputs)
    return _eliminate(data, parts, priors, scales, initial, simulated)


def _outputs(
    chain: Chain, values: Mapping[str, Array], data: Data, scales: Scales, initial: Array,
    own: Array | None = None,
) -> list[Array]:  # fmt: skip
    """Return every output of a chain, shape (lanes, n)."""
    got = respond(chain, values, data.rows, scales, initial, own)
    return [got.motion.T] if got.current is None else [got.motion.T, got.current.T]


def _runs(data: Data, k: int, noise: Noise) -> Integers:
    return data.whole_runs[k] if noise.over_gaps else data.runs[k]


def residual(data: Data, chain: Chain, like: Fit) -> Array | None:
    """Return the whitened residual of a chain under the noise of a fit, None if not finite.

    Initial states are fitted by the derivatives of that fit.  Shape (m,).
    """
    values = {p.name: np.array([chain.values[p.name]]) for p in chain.parameters}
    outputs = _outputs(chain, values, data, like.scales, like.initial)
    parts = []
    for k, (measured, predicted) in enumerate(zip(data.outputs, outputs, strict=True)):
        known = data.known[k]
        rest = (measured[known] - predicted[0, known])[None]
        parts.append(like.noise[k].whiten(rest, _runs(data, k, like.noise[k]))[0])
    r: Array = np.concatenate(parts)
    if not np.isfinite(r).all():
        return None
    if np.isfinite(data.huber):
        r *= _weight(r, data.huber)
    linear = like.linear
    pull = _pull(like.scales, like.initial)
    for k, ends in enumerate(data.bounds):
        right = -pull[k]
        for first, last in ends:
            right = right + linear.local[:, first:last] @ r[first:last]
        solved = linear.inverse[k] @ right
        for first, last in ends:
            r[first:last] -= solved @ linear.local[:, first:last]
    return r


def _weight(residual: Array, huber: float) -> Array:
    """Return the square root of the weights of a robust loss."""
    return np.asarray(np.sqrt(np.minimum(1.0, huber / np.maximum(np.abs(residual), 1e-300))))


def _state_prior(scales: Scales) -> Array:
    """Return the weights of the priors of q, speed and angle at the beginning of a segment."""
    sizes = PRIOR_STATE * np.array([scales.volts, scales.speed, np.inf])
    return np.asarray(sizes**-2.0)


def _pull(scales: Scales, initial: Array) -> Array:
    """Return the gradient of the priors of the initial states, shape (segments, 3)."""
    return np.asarray(_state_prior(scales) * initial[:, :3])


def _prior(chain: Chain, scales: Scales) -> tuple[Array, Array, tuple[str, ...]]:
    """Return residuals, rows and names of the components' priors."""
    names = [p.name for p in chain.free]
    residuals, rows, causes = [], [], []
    for component in chain.components:
        for weights, mean, deviation in component.expected(scales):
            if any(n in names for n in weights):
                at = sum(w * chain.values[n] for n, w in weights.items())
                residuals.append((mean - at) / deviation)
                rows.append([weights.get(n, 0.0) / deviation for n in names])
                causes.append(next(iter(weights)))
    for constraint in chain.constraints:
        row, off, size = _constrained(chain, constraint)
        if size > 0:
            residuals.append(off / size)
            rows.append(list(row / size))
            causes.append(constraint.quantity)
    # A parameter without effect gets a standard deviation of ten times its size, and stays.
    for j, p in enumerate(chain.free):
        residuals.append(0.0)
        causes.append(p.name)
        rows.append([0.0] * len(names))
        rows[-1][j] = 0.1 / (max(p.typical, 1.0) * scales.of(p.unit))
    made = np.array(rows).reshape(len(rows), len(names))
    return np.array(residuals), made, tuple(causes)


def _constrained(chain: Chain, constraint: Constraint) -> tuple[Array, float, float]:
    """Return gradient, distance and deviation of a constraint; 0 for one that does not bind."""
    values, rows = jacobian(chain)
    if constraint.quantity not in values:
        return np.zeros(0), 0.0, 0.0
    at = values[constraint.quantity]
    to = min(max(at, constraint.low), constraint.high)
    if to == at and constraint.low < constraint.high:
        return np.zeros(0), 0.0, 0.0
    row = rows[list(values).index(constraint.quantity)]
    return row, to - at, constraint.deviation * max(abs(to), 1e-12)


def _eliminate(
    data: Data, parts: Sequence[Array], priors: Array, scales: Scales, initial: Array,
    simulated: tuple[Array, ...],
) -> Linear:  # fmt: skip
    """Project the initial states of all segments out of residual and columns."""
    whole = np.concatenate([*parts, priors], axis=1)
    m, p = data.row.size, whole.shape[0] - 4
    if np.isfinite(data.huber):
        whole[:, :m] *= _weight(whole[0, :m], data.huber)
    g = data.rows.segment.size - 1
    solved, inverse = np.zeros((g, 3, p + 1)), np.zeros((g, 3, 3))
    pull = _pull(scales, initial)
    prior = np.diag(_state_prior(scales))
    for k, ends in enumerate(data.bounds):
        inner = np.zeros((3, p + 4))
        for first, last in ends:
            inner += whole[p + 1 :, first:last] @ whole[:, first:last].T
        inner[:, 0] -= pull[k]
        free = slice(2, 3) if data.stood[k] else slice(0, 3)
        small = (inner[:, p + 1 :] + prior)[free, free]
        size = np.diag(small)
        scale = np.sqrt(np.where(size > 0, size, 1.0))
        small = small / np.outer(scale, scale) + 1e-12 * np.eye(scale.size)
        inverse[k, free, free] = np.linalg.inv(small) / np.outer(scale, scale)
        solved[k] = inverse[k] @ inner[:, : p + 1]
        for first, last in ends:
            whole[: p + 1, first:last] -= solved[k].T @ whole[p + 1 :, first:last]
    return Linear(
        whole[0], whole[1 : p + 1].T, data.row, data.output, priors.shape[1], solved[:, :, 0],
        solved[:, :, 1:], simulated, whole[p + 1 :, :m], inverse,
    )  # fmt: skip


def descend(
    data: Data, chain: Chain, scales: Scales, initial: Array, noise: Sequence[Noise],
    most: int = MAX_STEPS, converged: float = CONVERGED,
) -> Fit:  # fmt: skip
    """Return the chain at the nearest minimum of the whitened sum of squares.

    It ends where a step changes the deviance by no more than ``converged``.
    """
    at, start = chain, initial.copy()
    linear = linearise(data, at, scales, start, noise)
    damping = 1e-4
    for _ in range(most):
        if not at.free:
            start = _settle_states(start, linear, np.zeros(0))
            linear = linearise(data, at, scales, start, noise)
            break
        step = _step(linear, at, scales, damping)
        if not np.isfinite(step).all():
            break
        values = _apply_step(at, scales, step)
        taken = np.array([values[p.name] - at.values[p.name] for p in at.free])
        expected = float(taken @ (2 * linear.columns.T @ linear.residual - linear.normal @ taken))
        trial = at.with_values(values)
        trial_start = _settle_states(start, linear, taken)
        following = linearise(data, trial, scales, trial_start, noise)
        gained = linear.cost - following.cost
        least = converged * min(linear.cost / linear.row.size, 1.0)
        if np.isfinite(following.cost) and gained >= -1e-9 * linear.cost:
            at, start, linear = trial, trial_start, following
            damping = max(damping / 10, 1e-12)
            if expected < least and gained < least:
                break
        else:
            damping = max(damping * 10, 1e-2)
            if damping > MOST_DAMPING or expected < least:
                break
    return Fit(at, scales, start, tuple(noise), linear, _deviance(data, linear, noise))


def _deviance(data: Data, linear: Linear, noise: Sequence[Noise]) -> float:
    return linear.cost + sum(
        its.log_determinant(runs) for its, runs in zip(noise, data.runs, strict=True)
    )


def _step(linear: Linear, chain: Chain, scales: Scales, damping: float) -> Array:
    """Return the damped Gauss-Newton step; parameters pushed against a bound stay."""
    gradient = linear.columns.T @ linear.residual
    normal = linear.normal
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inside = np.ones(scale.size, dtype=np.bool_)
    step = np.zeros(scale.size)
    for _ in range(scale.size):
        k = np.flatnonzero(inside)
        if not k.size:
            break
        a = normal[np.ix_(k, k)] / np.outer(scale[k], scale[k])
        a[np.diag_indices(k.size)] += damping + 1e-13
        step[:] = 0.0
        step[k] = np.linalg.solve(a, gradient[k] / scale[k]) / scale[k]
        pushed = False
        for j, p in enumerate(chain.free):
            low, high = p.bounds(scales)
            value = chain.values[p.name]
            if inside[j] and ((value <= low and step[j] < 0) or (value >= high and step[j] > 0)):
                inside[j] = False
                pushed = True
        if not pushed:
            break
    logs = [abs(s) for s, p in zip(step, chain.free, strict=True) if p.unit == "ln"]
    longest = max(logs, default=0.0)
    return step * (FARTHEST / longest) if longest > FARTHEST else step


def _apply_step(chain: Chain, scales: Scales, step: Array) -> dict[str, float]:
    """Return values after a step, within their bounds."""
    out = {}
    for s, p in zip(step, chain.free, strict=True):
        low, high = p.bounds(scales)
        out[p.name] = float(min(max(chain.values[p.name] + s, low), high))
    return out


def _settle_states(initial: Array, linear: Linear, step: Array) -> Array:
    out = initial.copy()
    out[:, :3] += linear.local_step - linear.local_gain @ step
    return out


def fit(
    data: Data, chain: Chain, scales: Scales, initial: Array, noise: Sequence[Noise] | None = None,
    rounds: int = 6, most: int = MAX_ORDER, converged: float = CONVERGED,
) -> Fit:  # fmt: skip
    """Return the chain and the noise of every output that explain data best from given values."""
    if noise is None:
        # A misfit tells no noise: a drifting angle is fitted by its speed.
        noise = [Noise.white(float(np.nanstd(y)) or 1.0) for y in data.outputs]
        if data.is_angle:
            noise[0] = Noise.integrated(float(np.nanstd(data.speed)) * data.rows.step or 1.0)
        found = descend(data, chain, scales, initial, noise, most=20, converged=1.0)
        chain, initial = found.chain, found.initial
        noise = fit_noises(data, found.linear, most)
    found = descend(data, chain, scales, initial, noise, most=8, converged=1.0)
    least = max(10 * converged, 1.0)
    for _ in range(rounds):
        noise = fit_noises(data, found.linear, most)
        other = descend(data, found.chain, scales, found.initial, noise, converged=converged)
        gained = _information_criterion(data, found) - _information_criterion(data, other)
        if gained > 0:
            found = other
        if gained < least:
            break
    return found


def refine(data: Data, found: Fit) -> Fit:
    """Return a fit, or that which begins at it under white noise, where it is better.

    Coloured noise takes up a misfit of the motion, and keeps it.
    """
    if found.noise[0].order == 0:
        return found
    white = (Noise.white(float(np.nanstd(data.motion - found.motion))), *found.noise[1:])
    begun = descend(data, found.chain, found.scales, found.initial, white)
    other = fit(data, begun.chain, begun.scales, begun.initial, fit_noises(data, begun.linear))
    return min(found, other, key=lambda f: _information_criterion(data, f))


def _information_criterion(data: Data, found: Fit) -> float:
    counts = zip(found.noise, data.known, strict=True)
    return found.deviance + sum(n.order * math.log(max(k.size, 2)) for n, k in counts)


def constrain(data: Data, found: Fit, constraints: Sequence[Constraint]) -> Fit:
    """Return the fit under constraints, which are tightened step by step.

    A tight one has a narrow valley, along which a descent from afar gets nowhere.
    """
    for deviation in (0.3, 0.03, 3e-3, 3e-4, 1e-6):
        held = tuple(replace(c, deviation=deviation) for c in constraints)
        chain = replace(found.chain, constraints=held)
        found = descend(data, chain, found.scales, found.initial, found.noise)
    return fit(data, found.chain, found.scales, found.initial, found.noise)


def refit(data: Data, found: Fit) -> Fit:
    """Return the fit to other rows of the recording of a fit, under the noise that they show."""
    begun, noise = _restart(data, found)
    return fit(data, found.chain, found.scales, begun.initial, noise)


def restate(data: Data, found: Fit) -> Fit:
    """Return a fit at the same values on other rows of its recording."""
    begun, noise = _restart(data, found)
    linear = linearise(data, found.chain, found.scales, begun.initial, noise)
    return replace(found, initial=begun.initial, noise=tuple(noise), linear=linear)


def _restart(data: Data, found: Fit) -> tuple[Fit, list[Noise]]:
    """Return the initial states, and the noise, of other rows of the recording of a fit."""
    still = replace(found.chain, fixed=frozenset(p.name for p in found.chain.parameters))
    white = [Noise.white(float(np.nanstd(y)) or 1.0) for y in data.outputs]
    begun = descend(data, still, found.scales, data.initial, white)
    return begun, fit_noises(data, begun.linear)


def settle(data: Data, chain: Chain, scales: Scales) -> Array:
    """Return the motion simulated freely, only the initial states fitted."""
    chain = chain.without_slot("current sensor")
    fixed = replace(chain, fixed=frozenset(p.name for p in chain.parameters), constraints=())
    motion = replace(data, current=None)
    noise = [Noise.white(1e-3 * float(np.nanstd(data.motion)) or 1.0)]
    initial = data.initial
    for _ in range(4):
        linear = linearise(motion, fixed, scales, initial, noise)
        initial = _settle_states(initial, linear, np.zeros(0))
    return linearise(motion, fixed, scales, initial, noise).simulated[0]


def fit_noises(data: Data, linear: Linear, most: int = MAX_ORDER) -> list[Noise]:
    """Return the noise of every output by its residual."""
    every = zip(data.outputs, linear.simulated, data.known, data.runs, strict=True)
    return [fit_noise((y - x)[known], runs, most) for y, x, known, runs in every]
