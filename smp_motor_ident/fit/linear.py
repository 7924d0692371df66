# SPDX-License-Identifier: Apache-2.0
"""Whitened residuals of a chain on data, and their derivatives.

Derivatives are differences between lanes of one simulation.  The initial state of every segment is
eliminated.  Derivation: docs/derivations.md, sections 5 and 6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.chain.chain import Chain, Constraint, respond
from smp_motor_ident.chain.component import Scales
from smp_motor_ident.chain.quantities import jacobian
from smp_motor_ident.fit.data import Data
from smp_motor_ident.fit.noise import Noise

INITIAL_STATE_PRIOR_STD = 2.0  # of q and speed, relative to the largest of the recording


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
    local: Array  # shape (3, m): derivatives by the initial states
    inverse: Array  # shape (segments, 3, 3): of their normal matrix, with their prior
    normal: Array  # shape (p, p): normal matrix of the parameters
    simulated: tuple[Array, ...]  # every output, shape (n,)
    derivatives: tuple[Array, ...]  # of every output before whitening, shape (p + 3, known rows)
    exact: bool  # whether they are of these values, not of values nearby

    @cached_property
    def cost(self) -> float:
        """Sum of squares."""
        return float(self.residual @ self.residual)

    @cached_property
    def gradient(self) -> Array:
        """Half the decrease of the sum of squares per parameter step, shape (p,)."""
        return np.asarray(self.columns.T @ self.residual)


def invert(normal: Array) -> Array:
    """Invert a normal matrix; directions without information get a very large variance."""
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
    states = 0 if data.starts_at_rest.all() else 2
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
    outputs = _simulate_lanes(chain, values, data, scales, initial, own)
    derivatives = []
    for k, predicted in enumerate(outputs):
        lines = np.zeros((p + 3, data.known[k].size))
        seen = _select_measured(data, k, predicted)
        np.subtract(seen[1:], seen[0], out=lines[: count - 1])
        lines[: count - 1] /= difference[: count - 1, None]
        lines[p + 2] = 1.0 if data.is_angle and k == 0 else 0.0
        derivatives.append(lines)
    simulated = tuple(predicted[0].copy() for predicted in outputs)
    return whiten(data, chain, scales, initial, noise, simulated, tuple(derivatives), True)


def whiten(
    data: Data, chain: Chain, scales: Scales, initial: Array, noise: Sequence[Noise],
    simulated: tuple[Array, ...], derivatives: tuple[Array, ...], exact: bool,
) -> Linear:  # fmt: skip
    """Return the residuals and derivatives of a simulation under a noise model."""
    residuals, rows, _ = build_prior_rows(chain, scales)
    m, p = data.row.size, len(chain.free)
    whole = np.zeros((p + 4, m + residuals.size))
    whole[0, m:], whole[1 : p + 1, m:] = residuals, rows.T
    first = 0
    for k, lines in enumerate(derivatives):
        part = whole[:, first : first + data.known[k].size]
        part[:1] = _whiten_residual(data, k, noise[k], simulated[k])
        part[1:] = noise[k].whiten(lines, _select_runs(data, k, noise[k]))
        first += data.known[k].size
    if np.isfinite(data.huber):
        whole[:, :m] *= _compute_huber_weights(whole[0, :m], data.huber)
    g = data.rows.segment.size - 1
    solved, inverse = np.zeros((g, 3, p + 1)), np.zeros((g, 3, 3))
    pull = _compute_state_prior_gradient(scales, initial)
    prior = np.diag(_compute_state_prior_weights(scales))
    for k, ends in enumerate(data.bounds):
        inner = np.zeros((3, p + 4))
        for first, last in ends:
            inner += whole[p + 1 :, first:last] @ whole[:, first:last].T
        inner[:, 0] -= pull[k]
        free = slice(2, 3) if data.starts_at_rest[k] else slice(0, 3)
        small = (inner[:, p + 1 :] + prior)[free, free]
        size = np.diag(small)
        scale = np.sqrt(np.where(size > 0, size, 1.0))
        small = small / np.outer(scale, scale) + 1e-12 * np.eye(scale.size)
        inverse[k, free, free] = np.linalg.inv(small) / np.outer(scale, scale)
        solved[k] = inverse[k] @ inner[:, : p + 1]
        for first, last in ends:
            whole[: p + 1, first:last] -= solved[k].T @ whole[p + 1 :, first:last]
    columns = whole[1 : p + 1]
    return Linear(
        whole[0], columns.T, data.row, data.output, residuals.size, solved[:, :, 0],
        solved[:, :, 1:], whole[p + 1 :, :m], inverse, columns @ columns.T, simulated, derivatives,
        exact,
    )  # fmt: skip


def reuse_derivatives(
    data: Data, chain: Chain, scales: Scales, initial: Array, noise: Sequence[Noise], like: Linear
) -> Linear:
    """Return the residuals of a chain with the derivatives of another near it."""
    simulated = _simulate(data, chain, scales, initial)
    residual, solved = _eliminate_states(data, scales, initial, noise, simulated, like)
    prior = build_prior_rows(chain, scales)[0]
    return replace(
        like, residual=np.concatenate([residual, prior]), local_step=solved, simulated=simulated,
        exact=False,
    )  # fmt: skip


def compute_residual(
    data: Data, chain: Chain, scales: Scales, initial: Array, noise: Sequence[Noise], like: Linear
) -> Array | None:
    """Return the whitened residual of a chain, None if not finite.  Shape (m,).

    Initial states are fitted by the derivatives of another.
    """
    simulated = _simulate(data, chain, scales, initial)
    found, _ = _eliminate_states(data, scales, initial, noise, simulated, like)
    return found if np.isfinite(found).all() else None


def update_initial_states(initial: Array, linear: Linear, step: Array) -> Array:
    """Return the initial states that fit best after a step of the parameters."""
    out = initial.copy()
    out[:, :3] += linear.local_step - linear.local_gain @ step
    return out


def build_prior_rows(chain: Chain, scales: Scales) -> tuple[Array, Array, tuple[str, ...]]:
    """Return residuals, rows and names of the components' priors."""
    names = [p.name for p in chain.free]
    residuals, rows, causes = [], [], []
    for component in chain.components:
        for weights, mean, deviation in component.list_priors(scales):
            if any(n in names for n in weights):
                at = sum(w * chain.values[n] for n, w in weights.items())
                residuals.append((mean - at) / deviation)
                rows.append([weights.get(n, 0.0) / deviation for n in names])
                causes.append(next(iter(weights)))
    for constraint in chain.constraints:
        row, off, size = _linearise_constraint(chain, constraint)
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


def _linearise_constraint(chain: Chain, constraint: Constraint) -> tuple[Array, float, float]:
    """Return gradient, distance and deviation of a constraint; zeros if it is satisfied."""
    values, rows = jacobian(chain)
    if constraint.quantity not in values:
        return np.zeros(0), 0.0, 0.0
    at = values[constraint.quantity]
    to = min(max(at, constraint.low), constraint.high)
    if to == at and constraint.low < constraint.high:
        return np.zeros(0), 0.0, 0.0
    row = rows[list(values).index(constraint.quantity)]
    return row, to - at, constraint.deviation * max(abs(to), 1e-12)


def _simulate_lanes(
    chain: Chain, values: Mapping[str, Array], data: Data, scales: Scales, initial: Array,
    own: Array | None = None,
) -> list[Array]:  # fmt: skip
    """Return every output of a chain, shape (lanes, n)."""
    got = respond(chain, values, data.rows, scales, initial, own)
    return [got.motion.T] if got.current is None else [got.motion.T, got.current.T]


def _simulate(data: Data, chain: Chain, scales: Scales, initial: Array) -> tuple[Array, ...]:
    """Return every output of a chain, shape (n,)."""
    values = {p.name: np.array([chain.values[p.name]]) for p in chain.parameters}
    return tuple(
        predicted[0] for predicted in _simulate_lanes(chain, values, data, scales, initial)
    )


def _whiten_residual(data: Data, k: int, noise: Noise, simulated: Array) -> Array:
    """Return the whitened residual of an output, shape (1, known rows)."""
    rest = _select_measured(data, k, (data.outputs[k] - simulated)[None])
    return noise.whiten(rest, _select_runs(data, k, noise))


def _select_measured(data: Data, k: int, lines: Array) -> Array:
    """Return the measured rows of lines of an output, shape (c, n)."""
    known = data.known[k]
    return lines if known.size == lines.shape[1] else lines[:, known]


def _eliminate_states(
    data: Data, scales: Scales, initial: Array, noise: Sequence[Noise],
    simulated: tuple[Array, ...], like: Linear,
) -> tuple[Array, Array]:  # fmt: skip
    """Eliminate the initial states from a residual, shape (m,); return it and their step."""
    every = zip(noise, simulated, strict=True)
    r = np.concatenate([_whiten_residual(data, k, *one)[0] for k, one in enumerate(every)])
    if np.isfinite(data.huber):
        r *= _compute_huber_weights(r, data.huber)
    pull = _compute_state_prior_gradient(scales, initial)
    solved = np.zeros((len(pull), 3))
    for k, ends in enumerate(data.bounds):
        right = -pull[k]
        for first, last in ends:
            right = right + like.local[:, first:last] @ r[first:last]
        solved[k] = like.inverse[k] @ right
        for first, last in ends:
            r[first:last] -= solved[k] @ like.local[:, first:last]
    return r, solved


def _select_runs(data: Data, k: int, noise: Noise) -> Integers:
    return data.whole_runs[k] if noise.over_gaps else data.runs[k]


def _compute_huber_weights(residual: Array, huber: float) -> Array:
    """Return the square root of the weights of a robust loss."""
    return np.asarray(np.sqrt(np.minimum(1.0, huber / np.maximum(np.abs(residual), 1e-300))))


def _compute_state_prior_weights(scales: Scales) -> Array:
    """Return the weights of the priors of q, speed and angle at the beginning of a segment."""
    sizes = INITIAL_STATE_PRIOR_STD * np.array([scales.volts, scales.speed, np.inf])
    return np.asarray(sizes**-2.0)


def _compute_state_prior_gradient(scales: Scales, initial: Array) -> Array:
    """Return the gradient of the priors of the initial states, shape (segments, 3)."""
    return np.asarray(_compute_state_prior_weights(scales) * initial[:, :3])
