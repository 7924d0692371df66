"""What a fitted motor says about data: predictions, information, steps, states of other data.

Derivation: docs/derivations.md, sections 6 to 9.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.estimation.fit import Fit, solve
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.noise import NO_GAIN, NoiseModel
from smp_motor_ident.likelihood.passes import BLOCKS, Pass, evaluate, gather
from smp_motor_ident.model.structures import Structure

Array = NDArray[np.float64]


def simulate(data: Experiments, fit: Fit, gain: bool = False) -> Array:
    """Return speed, output and current as the fitted motor predicts them."""
    return _predict(data, fit, gain, 3 if data.current.size else 2)


def outputs(data: Experiments, fit: Fit, gain: bool = False) -> Array:
    """Return the output alone as the fitted motor predicts it."""
    return _predict(data, fit, gain, 1)[:, 0]


def _predict(data: Experiments, fit: Fit, gain: bool, columns: int) -> Array:
    predicted = np.empty((data.size, columns))
    noise = NoiseModel(fit.noise, fit.gain if gain else NO_GAIN)
    gather(data, fit.structure, fit.z, fit.initial, noise, predicted, differentiate=False)
    return predicted


def again(data: Experiments, structure: Structure, fit: Fit, blocks: int = BLOCKS) -> Pass:
    """Return normal equations of experiments at a fit, with the coordinates of a structure."""
    z, noise = structure.complete(fit.z), fit.noise_model()
    return evaluate(data, structure, z, fit.initial, fit.initial, noise, blocks=blocks)


def inverse(normal: Array, rcond: float = 1e-13) -> Array:
    """Return the pseudo-inverse of a normal matrix, whatever the units of its coordinates.

    Coordinates of which nothing is known, but for rounding, are zero in it.
    """
    known = np.diag(normal)
    scale = np.sqrt(np.where(known > 1e-200, known, np.inf))
    scaled = np.linalg.pinv(normal / np.outer(scale, scale), rcond=rcond, hermitian=True)
    return np.asarray(scaled / np.outer(scale, scale))


def information(data: Experiments, fit: Fit) -> Array:
    """Return the Fisher information that experiments would give about a fit's coordinates."""
    return again(data, fit.structure, fit).normal


def influence(data: Experiments, fit: Fit) -> Array:
    """Return how an error of one in each output moves the coordinates, shape (n, f).

    The motion stays the one that the fit predicts, so the Gauss-Newton step is a sum over the
    samples; an error of a tenth of the noise asks for it, which no robust loss weighs otherwise.
    """
    predicted = simulate(data, fit)
    error = 0.1 * float(np.sqrt(fit.noise[0, 0]))
    output = np.where(np.isnan(data.output), np.nan, predicted[:, 1] + error)
    current = data.current
    if current.size:
        current = np.where(np.isnan(current), np.nan, predicted[:, 2])
    there = replace(data, output=output, current=current)
    here = again(there, fit.structure, fit, blocks=data.size)
    return np.asarray(here.scores @ inverse(here.normal) / error)


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
