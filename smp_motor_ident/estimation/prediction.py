"""What a fitted motor says about data: predictions, information, steps, states of other data.

Derivation: docs/derivations.md, sections 6 to 9.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.estimation.fit import Fit, solve
from smp_motor_ident.estimation.memory import remembered
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.noise import NO_GAIN, NoiseModel, whitening
from smp_motor_ident.likelihood.passes import Pass, answers, evaluate, gather, own_columns
from smp_motor_ident.likelihood.sensitivities import LANES
from smp_motor_ident.model.structures import Structure

RANK = 1e-13  # of the largest eigenvalue, below which one is rounding
PASSES = 8  # normal equations that are kept of each data


def simulate(data: Experiments, fit: Fit, gain: bool = False) -> Array:
    """Return speed, output and current as the fitted motor predicts them; not to be changed."""
    question = (fit.structure, fit.z, fit.initial, fit.gain if gain and fit.gain.any() else NO_GAIN)
    return remembered(data, "run", 1, question, lambda: once(data, fit, gain))


def once(data: Experiments, fit: Fit, gain: bool = False) -> Array:
    """Return the same of a motor that nobody else asks for."""
    predicted = np.empty((data.size, 3 if data.current.size else 2))
    noise = NoiseModel(fit.noise, fit.gain if gain else NO_GAIN)
    gather(data, fit.structure, fit.z, fit.initial, noise, predicted, differentiate=False)
    predicted.flags.writeable = False
    return predicted


def voltage_at_samples(data: Experiments) -> Array:
    """Return the voltage at the samples' instants, segment by segment."""
    if data.plain:
        return data.hold_value[: data.size]  # a window of the data keeps the whole input
    out = np.empty(data.size)
    for g, (a, b) in enumerate(zip(data.starts[:-1], data.starts[1:])):
        first = int(data.hold_start[g])
        last = int(data.hold_start[g + 1]) if g + 2 < len(data.starts) else len(data.hold_end)
        at = np.searchsorted(data.hold_end[first:last], data.time[a:b] - 1e-9)
        out[a:b] = data.hold_value[first + np.minimum(at, last - first - 1)]
    return out


def again(data: Experiments, structure: Structure, fit: Fit) -> Pass:
    """Return normal equations of experiments at a fit, with the coordinates of a structure.

    One pass serves for all that may be asked beside it, too.
    """
    more = _beside(data, structure)

    def run() -> Pass:
        z, noise = more.complete(fit.z), fit.noise_model()
        return evaluate(data, more, z, fit.initial, fit.initial, noise)

    question = (more, fit.z, fit.initial, fit.noise, fit.gain)
    here = remembered(data, "pass", PASSES, question, run)
    # How each of its coordinates moves those of the pass.
    move = np.linalg.lstsq(more.matrix, structure.matrix, rcond=None)[0]
    return replace(
        here,
        normal=move.T @ here.normal @ move,
        gradient=here.gradient @ move,
        local_gain=here.local_gain @ move,
        scores=here.scores @ move,
    )


def _beside(data: Experiments, structure: Structure) -> Structure:
    """Return a structure with all free that is asked for beside a fit, if a pass has the room."""
    free = structure.friction == "none" or "vc_plus" in structure.free
    more = structure.with_(
        load=not structure.own_load,
        delay=structure.delay or "delay" not in structure.fixed,
        friction="asymmetric" if free else structure.friction,
        **({"offset": True} if structure.current else {}),
    )
    room = len(more.free) + len(own_columns(data, more)) <= LANES
    return more if room else structure


def _scale_of(normal: Array) -> Array:
    """Return what each coordinate of a normal matrix is divided by to be of unit information.

    Infinite where nothing is known of it, but for rounding.
    """
    known = np.diagonal(normal, axis1=-2, axis2=-1)
    return np.asarray(np.sqrt(np.where(known > 1e-200, known, np.inf)))


def inverse(normal: Array, rcond: float = RANK) -> Array:
    """Return the pseudo-inverse of a normal matrix, whatever the units of its coordinates.

    Coordinates of which nothing is known, but for rounding, are zero in it.
    """
    root = root_of_inverse(normal, rcond)
    return np.asarray(root @ np.swapaxes(root, -1, -2))


def root_of_inverse(normal: Array, rcond: float = RANK) -> Array:
    """Return a root of the same, shape (..., p, p): it times its transpose."""
    scale = _scale_of(normal)[..., None]
    values, vectors = np.linalg.eigh(normal / scale / np.swapaxes(scale, -1, -2))
    known = values > rcond * values[..., -1:]
    return np.asarray(vectors / np.sqrt(np.where(known, values, np.inf))[..., None, :] / scale)


def information(data: Experiments, fit: Fit) -> Array:
    """Return the Fisher information that experiments would give about a fit's coordinates."""
    return again(data, fit.structure, fit).normal


def positive_part(matrix: Array, scale: Array) -> Array:
    """Return the nearest covariance, in the units of another."""
    unit = np.sqrt(np.maximum(np.diag(scale), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(unit, unit))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(unit, unit))


def influence(data: Experiments, fit: Fit, of: int = 0) -> tuple[Array, Array]:
    """Return how an error of one in an output moves the coordinates, and they that output, (n, f).

    Output 0 is the motion, 1 the current.  The motion stays the one that the fit predicts, so the
    Gauss-Newton step is a sum over the samples.
    """
    here, free = again(data, fit.structure, fit), len(fit.structure.free)
    none = np.zeros((0, 0)), np.zeros((0, 0, 0))
    moved = answers(data, fit.structure, fit.z, fit.initial, fit.noise_model(), none, 1, True)
    weight = whitening(fit.noise)
    score = weight[0, 0] * weight[0, of] * moved[:, 0]
    if data.current.size:
        both = np.isfinite(data.current)[:, None]
        apart = weight[1, 0] * moved[:, 0] + weight[1, 1] * moved[:, 1]
        score = score + both * weight[1, of] * apart
    for g, (a, b) in enumerate(pairwise(data.starts)):  # the initial states follow
        score[a:b, :free] -= score[a:b, free:] @ here.local_gain[g]
    return score[:, :free] @ inverse(here.normal), moved[:, of, :free]


def predicted_decrease(
    data: Experiments, fit: Fit, richer: Structure
) -> tuple[float, Array, Array]:
    """Return what freeing more would gain, by the score: one pass in place of a fit."""
    here = again(data, richer, fit)
    covariance = inverse(here.normal)
    step = covariance @ here.gradient
    return float(here.gradient @ step), step, covariance


def settle(data: Experiments, fit: Fit, iterations: int = 12) -> Fit:
    """Fit only the initial states and constant loads of other data (free run)."""
    free = fit.structure.free
    fixed = {**fit.structure.fixed, **{n: fit.z.value(n) for n in (*free, "ln_te", "vc_minus")}}
    structure = fit.structure.with_(fixed=fixed, own_load=True)
    done = solve(data, structure, fit.at(fit.z, data.initial, 0.0), iterations=iterations)
    return replace(done, structure=fit.structure, z=fit.z)
