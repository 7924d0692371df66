# SPDX-License-Identifier: Apache-2.0
"""Weighted least squares of a chain on data, from given values: Levenberg-Marquardt.

Derivatives are reused while steps gain as predicted, so that most steps simulate one motor.
Derivation: docs/derivations.md, section 6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.chain.chain import Chain, Constraint
from smp_motor_ident.chain.component import Scales
from smp_motor_ident.fit.data import Data
from smp_motor_ident.fit.linear import (
    Linear,
    build_prior_rows,
    compute_residual,
    differentiate,
    invert,
    linearise,
    reuse_derivatives,
    update_initial_states,
    whiten,
)
from smp_motor_ident.fit.noise import MAX_ORDER, Noise, fit_noise

MAX_LOG_STEP = 1.5  # of a logarithm
MAX_STEPS = 30
DEVIANCE_TOLERANCE = 1e-2  # a tenth of a standard deviation
NEGLIGIBLE_GAIN = 0.1  # predicted gain over the tolerance, below which a step is not taken
MAX_DAMPING = 100.0
MAX_REUSE_GAIN_ERROR = 0.5  # relative error of the predicted gain up to which they are reused
COST_ROUGHNESS = 3.0  # tolerances by which events and rounding make the cost uneven
MAX_DERIVATIVE_DISTANCE = 0.1  # of a logarithm, up to which derivatives are reused


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
    def prior_causes(self) -> tuple[str, ...]:
        """Causes of the last rows of ``linear``."""
        return build_prior_rows(self.chain, self.scales)[2]

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

    def with_noise(self, data: Data, noise: Sequence[Noise]) -> Fit:
        """Return the fit at the same values under another noise model."""
        old = self.linear
        linear = whiten(
            data, self.chain, self.scales, self.initial, noise, old.simulated, old.derivatives,
            old.exact,
        )  # fmt: skip
        return replace(
            self, noise=tuple(noise), linear=linear, deviance=_compute_deviance(data, linear, noise)
        )

    def descend(
        self, data: Data, tolerance: float = DEVIANCE_TOLERANCE, max_steps: int = MAX_STEPS
    ) -> Fit:
        """Return the fit at the nearest minimum, see `descend`."""
        start = self.chain, self.scales, self.initial, self.noise
        return descend(data, *start, max_steps, tolerance, self.linear)

    def residual(self, data: Data, chain: Chain) -> Array | None:
        """Return the whitened residual of another chain, None if not finite; shape (m,)."""
        return compute_residual(data, chain, self.scales, self.initial, self.noise, self.linear)


def descend(
    data: Data, chain: Chain, scales: Scales, initial: Array, noise: Sequence[Noise],
    max_steps: int = MAX_STEPS, tolerance: float = DEVIANCE_TOLERANCE, linear: Linear | None = None,
) -> Fit:  # fmt: skip
    """Return the chain at the nearest minimum of the whitened sum of squares.

    It ends where a step changes the deviance by no more than ``tolerance``.  ``linear``: residuals
    at these values, and derivatives from values nearby.
    """
    at, start = chain, initial.copy()
    if linear is None:
        linear = linearise(data, at, scales, start, noise)
    if not at.free:
        start = update_initial_states(start, linear, np.zeros(0))
        linear = linearise(data, at, scales, start, noise)
    moved, damping = 0.0, 1e-4  # of a logarithm since derivatives were taken
    for _ in range(max_steps if at.free else 0):
        step = _compute_step(linear, at, scales, damping)
        trial, taken = _apply_step(at, scales, step)
        expected = float(taken @ (2 * linear.gradient - linear.normal @ taken))
        least = tolerance * min(linear.cost / linear.data.row.size, 1.0)
        if not np.isfinite(step).all() or 0 <= expected < NEGLIGIBLE_GAIN * least:
            break
        fold = _find_longest_log_step(at, taken)
        place = data, trial, scales, update_initial_states(start, linear, taken), noise
        near = expected >= 0 and moved + fold < MAX_DERIVATIVE_DISTANCE
        following = _simulate_step(place, linear, near)
        gained = linear.cost - following.cost
        if _is_lower(following, linear):
            at, start, linear = trial, place[3], following
            moved = 0.0 if linear.exact else moved + fold
            damping = max(damping / 10, 1e-12)
            if expected < least and gained < least:
                break
            if linear.exact or abs(gained - expected) < MAX_REUSE_GAIN_ERROR * expected:
                continue
        elif linear.exact:
            damping = max(damping * 10, 1e-2)
            # A step that a bound cut short may promise a loss; a shorter one does not.
            if damping > MAX_DAMPING or 0 <= expected < COST_ROUGHNESS * least:
                break
            continue
        elif expected < least:
            break
        linear, moved = linearise(data, at, scales, start, noise), 0.0
    return Fit(at, scales, start, tuple(noise), linear, _compute_deviance(data, linear, noise))


def _simulate_step(
    place: tuple[Data, Chain, Scales, Array, Sequence[Noise]], linear: Linear, near: bool
) -> Linear:
    """Return residuals after a step, with new derivatives where reused ones do not suffice."""
    data, chain = place[:2]
    if near and not chain.constraints and not np.isfinite(data.huber):
        following = reuse_derivatives(*place, linear)
        if _is_lower(following, linear):
            return following
    return linearise(*place)


def _is_lower(one: Linear, other: Linear) -> bool:
    """Tell whether a sum of squares is lower than another, or the same up to rounding."""
    return one.cost <= (1 + 1e-9) * other.cost


def _compute_deviance(data: Data, linear: Linear, noise: Sequence[Noise]) -> float:
    return linear.cost + sum(
        its.log_determinant(runs) for its, runs in zip(noise, data.runs, strict=True)
    )


def _compute_step(linear: Linear, chain: Chain, scales: Scales, damping: float) -> Array:
    """Return the damped Gauss-Newton step; parameters pushed against a bound stay."""
    gradient, normal = linear.gradient, linear.normal
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
    longest = _find_longest_log_step(chain, step)
    return step * (MAX_LOG_STEP / longest) if longest > MAX_LOG_STEP else step


def _find_longest_log_step(chain: Chain, step: Array) -> float:
    """Return the longest step of a logarithm."""
    every = zip(step, chain.free, strict=True)
    return max((abs(float(s)) for s, p in every if p.unit == "ln"), default=0.0)


def _apply_step(chain: Chain, scales: Scales, step: Array) -> tuple[Chain, Array]:
    """Return the chain after a step within the bounds, and the step that was taken."""
    limits = np.array([p.bounds(scales) for p in chain.free])
    begun = np.array([chain.values[p.name] for p in chain.free])
    ended = np.clip(begun + step, limits[:, 0], limits[:, 1])
    values = {p.name: float(x) for p, x in zip(chain.free, ended, strict=True)}
    return chain.with_values(values), ended - begun


def approach(
    data: Data, chain: Chain, scales: Scales, initial: Array, max_order: int = MAX_ORDER
) -> Fit:
    """Return the fit from distant values, under the noise of its residual.

    A misfit does not show the noise: it is white at first, of the speed where an angle is recorded.
    """
    noise = [Noise.white(float(np.nanstd(y)) or 1.0) for y in data.outputs]
    if data.is_angle:
        noise[0] = Noise.integrated(float(np.nanstd(data.speed)) * data.rows.step or 1.0)
    found = descend(data, chain, scales, initial, noise, max_steps=20, tolerance=1.0)
    return found.with_noise(data, fit_noises(data, found.linear.simulated, max_order))


def fit(
    data: Data,
    begun: Fit,
    rounds: int = 6,
    max_order: int = MAX_ORDER,
    tolerance: float = DEVIANCE_TOLERANCE,
) -> Fit:
    """Alternate between fitting the chain and the noise of every output."""
    found = begun.descend(data, 1.0, 8)
    least = max(10 * tolerance, 1.0)
    for _ in range(rounds):
        noise = fit_noises(data, found.linear.simulated, max_order)
        if _compute_noise_gain(data, found, noise) < least:
            return found.descend(data, tolerance)
        other = found.with_noise(data, noise).descend(data, tolerance)
        gained = _compute_bic(data, found) - _compute_bic(data, other)
        if gained > 0:
            found = other
        if gained < least:
            break
    return found


def refine(data: Data, found: Fit) -> Fit:
    """Return a fit, or a better one that begins at it under white noise.

    Coloured noise absorbs a misfit of the motion, and hides it.
    """
    if found.noise[0].order == 0:
        return found
    white = (Noise.white(float(np.nanstd(data.motion - found.motion))), *found.noise[1:])
    begun = found.with_noise(data, white).descend(data)
    other = fit(data, begun.with_noise(data, fit_noises(data, begun.linear.simulated)))
    return min(found, other, key=lambda f: _compute_bic(data, f))


def _compute_bic(data: Data, found: Fit) -> float:
    counts = zip(found.noise, data.known, strict=True)
    return found.deviance + sum(n.order * math.log(max(k.size, 2)) for n, k in counts)


def _compute_noise_gain(data: Data, found: Fit, noise: Sequence[Noise]) -> float:
    """Return how much another noise lowers the criterion at the same values."""
    gain = 0.0
    for k, known in enumerate(data.known):
        rest = (data.outputs[k] - found.linear.simulated[k])[known]
        for sign, its in ((1, found.noise[k]), (-1, noise[k])):
            gain += sign * (
                its.deviance(rest, data.runs[k]) + its.order * math.log(max(known.size, 2))
            )
    return gain


def constrain(data: Data, found: Fit, constraints: Sequence[Constraint]) -> Fit:
    """Return the fit under constraints, tightened step by step.

    A tight constraint makes a narrow valley, in which a descent from afar is slow.
    """
    for deviation in (0.3, 0.03, 3e-3, 3e-4, 1e-6):
        held = tuple(replace(c, deviation=deviation) for c in constraints)
        chain = replace(found.chain, constraints=held)
        found = descend(data, chain, found.scales, found.initial, found.noise)
    return fit(data, found)


def evaluate_on_rows(data: Data, found: Fit) -> Fit:
    """Evaluate a fit on other rows of its recording, at the same values and initial states."""
    chain, scales, initial = found.chain, found.scales, found.initial
    simulated, derivatives = differentiate(data, chain, scales, initial)
    noise = tuple(fit_noises(data, simulated))
    linear = whiten(data, chain, scales, initial, noise, simulated, derivatives, True)
    return replace(
        found, noise=noise, linear=linear, deviance=_compute_deviance(data, linear, noise)
    )


def _fix_all(chain: Chain) -> Chain:
    """Return a chain without free parameters."""
    return replace(chain, fixed=frozenset(p.name for p in chain.parameters), constraints=())


def simulate_freely(data: Data, chain: Chain, scales: Scales) -> Array:
    """Simulate the motion freely from fitted initial states."""
    chain = chain.without_slot("current sensor")
    fixed = _fix_all(chain)
    motion = replace(data, current=None)
    noise = [Noise.white(1e-3 * float(np.nanstd(data.motion)) or 1.0)]
    initial = data.initial
    for _ in range(4):
        linear = linearise(motion, fixed, scales, initial, noise)
        initial = update_initial_states(initial, linear, np.zeros(0))
    return linearise(motion, fixed, scales, initial, noise).simulated[0]


def fit_noises(data: Data, simulated: tuple[Array, ...], max_order: int = MAX_ORDER) -> list[Noise]:
    """Return the noise of every output by its residual."""
    every = zip(data.outputs, simulated, data.known, data.runs, strict=True)
    return [fit_noise((y - x)[known], runs, max_order) for y, x, known, runs in every]
