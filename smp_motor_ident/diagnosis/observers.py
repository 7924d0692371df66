"""Whether the numbers hang on how closely the observer follows: a test of torque noise.

Where a load fluctuates as the fit says, the innovations e of its observer are white, and those
of a slower one are ``f = H e`` with a filter H that is known.  With the sensitivities S and T of
both, the slower one moves the estimate by

    d = (T'T)^-1 T' f = R' e,   R = H' T (T'T)^-1 - S (S'S)^-1,

by chance alone, with the variances ``diag(R'R)``.  What is deterministic and only looks like a
load that fluctuates moves it by more, as a slower observer forgives less; so does friction
between which and the noise no filter of this kind can tell.  A coordinate is known no better
than it moves.

References
----------
J. Hausman, Specification tests in econometrics, Econometrica 46 (1978), 1251; L. Ljung, System
Identification, 2nd ed. (1999), section 8.5, on the bias that a noise model distributes.
"""

from dataclasses import replace

import numpy as np
from scipy.special import erfc

from smp_motor_control.arrays import Array, Flags
from smp_motor_ident._compile import compiled
from smp_motor_ident.diagnosis.limits import CONDITION_LEVEL
from smp_motor_ident.diagnosis.model_error import measured, own_responses, predicted
from smp_motor_ident.estimation import shape_constraint
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.prediction import inverse
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.noise import gain_for, transition, whitening
from smp_motor_ident.model.coordinates import STANDS_FOR

SLOWER = (0.5, 0.25, 0.1)
"""Bandwidths of the other observers, of the fitted one's."""

LEAST = 0.5
"""Of a coordinate's deviation: to that a descent ends in its minimum, and a line is one."""


def slower(data: Experiments, fit: Fit) -> tuple[Fit, list[Finding]]:
    """Return the fit with its covariance widened by what slower observers move, and say which."""
    move = moved_by_slower(data, fit)
    if not move.any():
        return fit, []
    names = (n for n, d in zip(fit.structure.free, move, strict=True) if d)
    said = ", ".join(STANDS_FOR.get(n, n) for n in names)
    return fit.along(move), [
        Finding(
            "torque_noise_frequency",
            "note",
            "what looks like a load that fluctuates leads to other numbers where one follows the "
            f"motor more slowly ({said}): the intervals cover them",
            {"quantities": said},
            "record at the motor's terminals, without load, and sample faster: it may be no load",
        )
    ]


def moved_by_slower(data: Experiments, fit: Fit) -> Array:
    """Return how far slower observers move the free coordinates beyond chance, shape (f,)."""
    structure = fit.structure
    farthest: Array = np.zeros(len(structure.free))
    ways = _ways(fit)
    size = ways.shape[1]
    if not size or not np.any(fit.gain != 0.0):
        return farthest
    level = CONDITION_LEVEL.value / (size * len(SLOWER))
    innovations, own = _linearised(data, fit, ways)
    here = np.einsum("tor,rf->tof", own, _estimator(own, size))
    step = np.einsum("tof,to->f", here, innovations)  # what is left of it at an edge
    own_deviation = np.sqrt(np.square(here).sum(axis=(0, 1)))
    for share in SLOWER:
        gain = gain_for(
            structure, fit.z, data.kind, data.step, fit.noise_ratio * share**4, fit.noise,
            bool(data.current.size),
        )  # fmt: skip
        errors, responses = _linearised(data, replace(fit, gain=gain), ways)
        weights = np.einsum("tor,rf->tof", responses, _estimator(responses, size))
        move = np.einsum("tof,to->f", weights, errors) - step
        rows = _on_innovations(data, fit, gain, weights) - here
        deviation = np.sqrt(np.square(rows).sum(axis=(0, 1)) + np.square(LEAST * own_deviation))
        surprise = np.abs(np.einsum("tof,to->f", rows, innovations))
        surprise /= np.where(deviation > 0, deviation, 1.0)  # what no row shows does not surprise
        move = ways @ np.where(erfc(surprise / np.sqrt(2)) > level, 0.0, move)
        farthest = np.where(np.abs(move) > np.abs(farthest), move, farthest)
    return farthest


def _ways(fit: Fit) -> Array:
    """Return the directions in which coordinates can move, shape (f, k).

    An L/R that friction alone shows follows the others along the edge at which it ended, or stays.
    """
    structure = fit.structure
    every = np.eye(len(structure.free))
    if not shape_constraint.applies(structure):
        return every
    share = shape_constraint.at_edge(fit.z)
    along = None if share is None else shape_constraint.tied(structure, fit.z, share)
    return np.delete(every, structure.free.index("ln_te"), axis=1) if along is None else along[0]


def _linearised(data: Experiments, fit: Fit, ways: Array) -> tuple[Array, Array]:
    """Return innovations, shape (n, o), and sensitivities, shape (n, o, p), by their noise."""
    base, values = predicted(data, fit), measured(data)
    known = np.isfinite(values)
    outputs = values.shape[1]
    white = whitening(fit.noise)[:outputs, :outputs]
    errors = np.where(known, values - base, 0.0) @ white.T
    columns = own_responses(data, fit)
    free = len(ways)
    columns = np.concatenate([columns[:, :, :free] @ ways, columns[:, :, free:]], axis=-1)
    return errors, white @ np.where(known[:, :, None], columns, 0.0)


def _estimator(responses: Array, free: int) -> Array:
    """Return the columns of ``(T'T)^-1`` that give the free coordinates."""
    flat = responses.reshape(-1, responses.shape[-1])
    return inverse(flat.T @ flat, 1e-12)[:, :free]


def _on_innovations(data: Experiments, fit: Fit, gain: Array, weights: Array) -> Array:
    """Return ``H' weights``: what weights of a slower observer's errors are on the innovations."""
    outputs = weights.shape[1]
    output = np.zeros((outputs, 3))
    output[0, 2] = 1.0
    if outputs == 2:
        output[1, 0] = np.exp(-fit.z.ln_r)
    step = transition(fit.structure, fit.z, data.step)
    difference = step @ (gain - fit.gain)[:, :outputs]
    closed = step @ (np.eye(3) - gain[:, :outputs] @ output)
    white = whitening(fit.noise)[:outputs, :outputs]
    ends = np.zeros(data.size, dtype=np.bool_)
    ends[np.asarray(data.starts[1:]) - 1] = True
    raw = _backwards(white.T @ weights, ends, closed, difference, output)
    return np.asarray(np.linalg.solve(white.T, raw))


@compiled
def _backwards(
    weights: Array, ends: Flags, closed: Array, difference: Array, output: Array
) -> Array:
    """Run the adjoint of ``d+ = closed d + difference e, f = e - output d`` in each segment."""
    out = weights.copy()
    adjoint = np.zeros((3, weights.shape[2]))
    last = adjoint.copy()
    for t in range(weights.shape[0] - 1, -1, -1):
        if ends[t]:
            adjoint[:] = 0.0
        for c in range(weights.shape[2]):
            for o in range(weights.shape[1]):
                for i in range(3):
                    out[t, o, c] += difference[i, o] * adjoint[i, c]
            for j in range(3):
                total = 0.0
                for i in range(3):
                    total += closed[i, j] * adjoint[i, c]
                for o in range(weights.shape[1]):
                    total -= output[o, j] * weights[t, o, c]
                last[j, c] = total
        adjoint, last = last, adjoint
    return out
