"""How far counts and instants that are not exact can mislead an estimate.

Quantisation is not noise: where the motion repeats, so does its error, and more samples do
not average it away.  The fitted motor is replayed with the counter's zero at random places;
one Gauss-Newton step from each replay tells the estimate's error on this very motion.
Derivation: docs/derivations.md, section 9.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from smp_motor_ident import models, replay
from smp_motor_ident import recursion as rc
from smp_motor_ident.experiments import Experiments
from smp_motor_ident.fit import Fit

Array = NDArray[np.float64]

MANY = 50_000  # samples above which fewer replays are run


def widened(data: Experiments, fit: Fit, seed: int = 0) -> Fit:
    """Return the fit with its covariance widened where quantisation repeats.

    Parameters
    ----------
    data : Experiments
        What was fitted.
    fit : Fit
        With the covariance of independent errors.
    seed : int
        Of the counter's random zeros.

    Returns
    -------
    Fit
        Unchanged where noise dithers the counter or the replays agree with the covariance.
    """
    if data.kind != rc.ANGLE or data.quantum == 0 or fit.ratio > 0:
        return fit
    own = data.quantum**2 / 12
    if fit.noise[0, 0] > 3 * own or not fit.structure.free():
        return fit
    rng = np.random.default_rng(seed)
    predicted = replay.simulate(data, fit)
    noise = np.sqrt(max(fit.noise[0, 0] - own, 0.0))
    cov = fit.covariance()
    replays = 24 if data.size < MANY else 8
    errors = []
    for _ in range(replays):
        current = data.current
        if current.size:
            scatter = np.sqrt(fit.noise[1, 1]) * rng.standard_normal(data.size)
            current = np.where(np.isnan(current), np.nan, predicted[:, 2] + scatter)
        angle = predicted[:, 1] + rng.uniform(0, data.quantum)
        angle += noise * rng.standard_normal(data.size)
        counts = np.floor(angle / data.quantum) * data.quantum
        counts -= (counts - predicted[:, 1]).mean()
        counts[np.isnan(data.output)] = np.nan
        again = replace(data, output=counts, current=current)
        errors.append(replay.one_step(again, fit))
    second = np.mean(np.square(errors), axis=0)
    excess = second / np.maximum(np.diag(cov), 1e-300)
    # Below the 95 % point the replays do not contradict the covariance.
    widen = np.where(excess > chi2.ppf(0.95, replays) / replays, np.sqrt(excess), 1.0)
    return replace(fit, widen=widen)


def blurred(data: Experiments, fit: Fit, instant: float) -> Fit:
    """Return the fit with its covariance widened by what the input's instants leave open.

    Parameters
    ----------
    data : Experiments
        What was fitted.
    fit : Fit
        Without delay among its coordinates.
    instant : float
        Standard deviation of a common error of the input's instants [s].

    Returns
    -------
    Fit
        With the covariance of the estimate's answer to such an error added: ``G instant^2 G'``
        where ``G = N^-1 N_delay``.
    """
    structure = fit.structure
    if instant <= 0 or structure.delay or "delay" in structure.held or not structure.free():
        return fit
    both = replay.information(data, replace(fit, structure=structure.with_(delay=True)))
    keep = [i for i, c in enumerate(structure.with_(delay=True).free()) if c != models.DELAY]
    late = structure.with_(delay=True).free().index(models.DELAY)
    own = both[np.ix_(keep, keep)]
    scale = np.sqrt(np.maximum(np.diag(own), 1e-300))
    inverse = np.linalg.pinv(own / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    answer = inverse @ (both[keep, late] / scale) / scale
    return replace(fit, blur=instant**2 * np.outer(answer, answer))
