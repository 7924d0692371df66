"""Around one descent: data to look at first, the noise guessed, where to begin."""

from dataclasses import replace

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.estimation.fit import Fit, Options, solve
from smp_motor_ident.estimation.memory import remembered
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.measurement import Measurement
from smp_motor_ident.model.structures import Structure

ROUGHLY = 0.3  # standard deviations of where a descent ends: its deviance is known to a tenth
SCREENING_SAMPLES = 12_000  # samples on which candidates and noise levels are compared


def screening_subset(data: Experiments) -> Experiments:
    """Return the part on which models are compared, or all where that is little more."""

    def cut() -> Experiments:
        part = data.data_window(SCREENING_SAMPLES * data.step)
        return part if data.size > 3 * part.size else data

    return remembered(data, "subset", 1, (), cut)


def noise_ratio_of(bandwidth: float, step: float, kind: Measurement) -> float:
    """Return the process-to-measurement noise ratio that gives the innovations a bandwidth."""
    return float(bandwidth ** (2 + 2 * kind.integrals) * step)


def bandwidth(z: Coordinates, data: Experiments) -> float:
    """Return the motor's own bandwidth, as far as the sampling shows it."""
    return min(float(np.exp(z.ln_a0 - z.ln_a1)), 0.2 / data.step)


def first_noise(data: Experiments) -> Array:
    """Return a first guess of the residuals' covariance, from resolution and scatter."""
    y = data.output[:SCREENING_SAMPLES]
    v0 = max(data.quantum**2 / 12, 1e-12 * _variance(y, 0), 1e-4 * _variance(y, 4) / 70, 1e-18)
    v1 = 1.0
    if data.current.size:
        i = data.current[:SCREENING_SAMPLES]
        v1 = max(_variance(i, 2) / 6 * 0.1, 1e-8 * _variance(i, 0), 1e-12)
    return np.diag([v0, v1])


def _variance(x: Array, order: int) -> float:
    """Return the variance of differences; across lost samples where there are no others."""
    d = np.diff(x, n=order)
    there = d[np.isfinite(d)]
    if there.size < 8:
        there = np.diff(x[np.isfinite(x)], n=order)
    return float(np.var(there)) if there.size else 0.0


def initial_of(data: Experiments, fit: Fit) -> Array:
    """Return a fit's initial states for more data; those it lacks from the measurements."""
    initial = data.initial.copy()
    n = min(len(initial), len(fit.initial))
    initial[:n] = fit.initial[:n]
    return initial


def refine(
    data: Experiments,
    structure: Structure,
    near: Fit,
    z: Coordinates,
    options: Options,
    tolerance: float = 1e-2,
    known: Fit | None = None,
) -> Fit:
    """Fit a structure from another's answer on the same data."""
    start = near.at(z, initial_of(data, near))
    fit = solve(data, structure, start, options, 30, tolerance, known)
    return fit if fit is known else at_rest(data, structure, fit, options, tolerance, known)


def at_rest(
    data: Experiments,
    structure: Structure,
    fit: Fit,
    options: Options,
    tolerance: float = 1e-2,
    known: Fit | None = None,
) -> Fit:
    """Try whether segments that begin slowly began at rest: friction makes that a kink."""
    if structure.friction == "none":
        return fit
    first = np.abs(fit.initial[:, 1])
    slow = (first > 0) & (first < 0.05 * fit.z.dc_gain * np.abs(data.hold_value).max())
    if not slow.any():
        return fit
    initial = fit.initial.copy()
    initial[slow, :2] = 0.0
    other = solve(data, structure, fit.at(fit.z, initial), options, 12, tolerance, known)
    return other if other.deviance < fit.deviance else fit


def restate(data: Experiments, structure: Structure, fit: Fit, options: Options) -> Fit:
    """Return a fit's coordinates as the answer of a structure in which more is free."""
    once = solve(data, structure, fit, options, 1)
    return replace(once, z=fit.z, initial=fit.initial, converged=fit.converged)
