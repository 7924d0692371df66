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

    The last rows of ``residual`` and ``columns`` are of the motor's prior.
    """

    data: Data
    slopes: Array  # shape (p + 3, m): derivatives by parameters and states of segments
    gram: Array  # shape (segments, p + 3, p + 3): inner products of ``slopes``
    inverse: Array  # shape (segments, 3, 3): of the states' normal matrix, with their prior
    local_gain: Array  # shape (segments, 3, p): decrease of the states per parameter step
    normal: Array  # shape (p, p): normal matrix of the parameters
    prior_columns: Array  # shape (priors, p)
    derivatives: tuple[Array, ...]  # of every output before whitening, shape (p + 3, known rows)
    misfit: Array  # shape (m,): residuals at the initial states of the simulation
    prior_residual: Array  # shape (priors,)
    local_step: Array  # shape (segments, 3): of the initial states at a step of zero
    cost: float  # sum of squares
    gradient: Array  # shape (p,): half its decrease per parameter step
    simulated: tuple[Array, ...]  # every output, shape (n,)
    exact: bool  # whether derivatives are of these values, not of values nearby

    @cached_property
    def residual(self) -> Array:
        """Residuals at the best initial states, shape (m + priors,)."""
        rest = self.misfit[None].copy()
        self._eliminate_states(rest, self.local_step[:, :, None])
        return np.concatenate([rest[0], self.prior_residual])

    @cached_property
    def columns(self) -> Array:
        """Derivatives at the best initial states, shape (m + priors, p)."""
        p = self.normal.shape[0]
        whole = np.empty((p, self.misfit.size + self.prior_residual.size))
        whole[:, self.misfit.size :] = self.prior_columns.T
        rest = whole[:, : self.misfit.size]
        rest[:] = self.slopes[:p]
        self._eliminate_states(rest, self.local_gain)
        return whole.T

    def fit_states(self, misfit: Array, pull: Array) -> Array:
        """Return the residuals at the best initial states of another misfit, shape (m,)."""
        p, rest = self.normal.shape[0], misfit[None].copy()
        inner = self._project(misfit)[:, p:] - pull
        self._eliminate_states(rest, self.inverse @ inner[:, :, None])
        return np.asarray(rest[0])

    def with_misfit(
        self, misfit: Array, pull: Array, prior: Array, simulated: tuple[Array, ...], exact: bool
    ) -> Linear:
        """Return the residuals of another simulation with these derivatives.

        ``pull``, shape (segments, 3): gradient of the priors of the initial states.
        """
        p, inner = self.normal.shape[0], self._project(misfit)
        step = (self.inverse @ (inner[:, p:] - pull)[:, :, None])[:, :, 0]
        left = inner - (self.gram[:, :, p:] @ step[:, :, None])[:, :, 0]
        cost = misfit @ misfit - (step * (inner + left)[:, p:]).sum() + prior @ prior
        gradient = left[:, :p].sum(axis=0) - np.einsum("gsp,gs->p", self.local_gain, left[:, p:])
        return replace(
            self, misfit=misfit, prior_residual=prior, local_step=step, cost=float(cost),
            gradient=gradient + self.prior_columns.T @ prior, simulated=simulated, exact=exact,
        )  # fmt: skip

    def _project(self, misfit: Array) -> Array:
        """Return the inner products of slopes and misfit, shape (segments, p + 3)."""
        return np.array(
            [
                sum(self.slopes[:, first:last] @ misfit[first:last] for first, last in ends)
                for ends in self.data.bounds
            ]
        )

    def _eliminate_states(self, lines: Array, steps: Array) -> None:
        """Subtract the change by steps of the initial states, shape (segments, 3, lines)."""
        local = self.slopes[-3:]
        for step, ends in zip(steps, self.data.bounds, strict=True):
            for first, last in ends:
                lines[:, first:last] -= step.T @ local[:, first:last]


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
    simulated, derivatives = differentiate(data, chain, scales, initial)
    return whiten(data, chain, scales, initial, noise, simulated, derivatives, True)


def differentiate(
    data: Data, chain: Chain, scales: Scales, initial: Array
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Return the outputs of a chain and their derivatives by parameters and initial states."""
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
        lines[: count - 1] *= 1 / difference[: count - 1, None]
        lines[p + 2] = 1.0 if data.is_angle and k == 0 else 0.0
        derivatives.append(lines)
    return tuple(predicted[0].copy() for predicted in outputs), tuple(derivatives)


def whiten(
    data: Data, chain: Chain, scales: Scales, initial: Array, noise: Sequence[Noise],
    simulated: tuple[Array, ...], derivatives: tuple[Array, ...], exact: bool,
) -> Linear:  # fmt: skip
    """Return the residuals and derivatives of a simulation under a noise model."""
    prior, rows, _ = build_prior_rows(chain, scales)
    p = len(chain.free)
    parts = [
        its.whiten(lines, _select_runs(data, k, its))
        for k, (its, lines) in enumerate(zip(noise, derivatives, strict=True))
    ]
    slopes = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
    misfit = _whiten_misfit(data, noise, simulated)
    if np.isfinite(data.huber):
        slopes *= _compute_huber_weights(misfit, data.huber)
        misfit *= _compute_huber_weights(misfit, data.huber)
    gram = np.array(
        [
            sum(slopes[:, first:last] @ slopes[:, first:last].T for first, last in ends)
            for ends in data.bounds
        ]
    )
    inverse = np.zeros((len(gram), 3, 3))
    weights = np.diag(_compute_state_prior_weights(scales))
    for k, inner in enumerate(gram):
        free = slice(2, 3) if data.starts_at_rest[k] else slice(0, 3)
        small = (inner[p:, p:] + weights)[free, free]
        size = np.diag(small)
        scale = np.sqrt(np.where(size > 0, size, 1.0))
        small = small / np.outer(scale, scale) + 1e-12 * np.eye(scale.size)
        inverse[k, free, free] = np.linalg.inv(small) / np.outer(scale, scale)
    gain = inverse @ gram[:, p:, :p]
    rest = np.concatenate([np.tile(np.eye(p), (len(gram), 1, 1)), -gain.swapaxes(1, 2)], axis=2)
    normal = (rest @ gram @ rest.swapaxes(1, 2)).sum(axis=0) + rows.T @ rows
    begun = Linear(
        data, slopes, gram, inverse, gain, normal, rows, derivatives, misfit, prior,
        np.zeros((len(gram), 3)), 0.0, np.zeros(p), simulated, exact,
    )  # fmt: skip
    pull = _compute_state_prior_gradient(scales, initial)
    return begun.with_misfit(misfit, pull, prior, simulated, exact)


def reuse_derivatives(
    data: Data, chain: Chain, scales: Scales, initial: Array, noise: Sequence[Noise], like: Linear
) -> Linear:
    """Return the residuals of a chain with the derivatives of another near it."""
    simulated = simulate_outputs(data, chain, scales, initial)
    pull = _compute_state_prior_gradient(scales, initial)
    prior = build_prior_rows(chain, scales)[0]
    return like.with_misfit(_whiten_misfit(data, noise, simulated), pull, prior, simulated, False)


def compute_residual(
    data: Data, chain: Chain, scales: Scales, initial: Array, noise: Sequence[Noise], like: Linear
) -> Array | None:
    """Return the whitened residual of a chain, None if not finite.  Shape (m,).

    Initial states are fitted by the derivatives of another.
    """
    misfit = _whiten_misfit(data, noise, simulate_outputs(data, chain, scales, initial))
    if np.isfinite(data.huber):
        misfit *= _compute_huber_weights(misfit, data.huber)
    found = like.fit_states(misfit, _compute_state_prior_gradient(scales, initial))
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


def simulate_outputs(data: Data, chain: Chain, scales: Scales, initial: Array) -> tuple[Array, ...]:
    """Return every output of a chain, shape (n,)."""
    values = {p.name: np.array([chain.values[p.name]]) for p in chain.parameters}
    return tuple(
        predicted[0] for predicted in _simulate_lanes(chain, values, data, scales, initial)
    )


def _whiten_misfit(data: Data, noise: Sequence[Noise], simulated: tuple[Array, ...]) -> Array:
    """Return the whitened residual of every measured value, shape (m,)."""
    parts = []
    for k, its in enumerate(noise):
        rest = _select_measured(data, k, (data.outputs[k] - simulated[k])[None])
        parts.append(its.whiten(rest, _select_runs(data, k, its))[0])
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _select_measured(data: Data, k: int, lines: Array) -> Array:
    """Return the measured rows of lines of an output, shape (c, n)."""
    known = data.known[k]
    return lines if known.size == lines.shape[1] else lines[:, known]


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
