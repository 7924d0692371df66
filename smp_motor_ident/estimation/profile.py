"""Intervals of what is poorly told: the deviance is followed, its parabola not trusted.

At the end of an interval by the covariance the coordinate is held and all others are fitted
again; where the deviance has risen by less than the parabola says, the interval is too short.
Derivation: docs/derivations.md, section 9.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from smp_motor_ident.estimation.descent import Options, descend
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model import structures as models

Array = NDArray[np.float64]

SIGMAS = 1.96
RISE = float(chi2.ppf(0.95, 1))  # of the deviance at the end of a 95 % interval
FARTHEST = 3.0  # times wider at most: beyond, the data tell next to nothing
MANY = 50_000  # samples above which the parabola holds well enough
LOOSE = {models.A2: 0.1, models.DELAY: 0.1, models.WINDOW: 0.1, models.VC_PLUS: 0.1}
"""Coordinates that act other than linearly, and the relative uncertainty at which it shows."""


def profiled(data: Experiments, fit: Fit, options: Options) -> Fit:
    """Return the fit with its covariance widened where the deviance rises too slowly.

    Parameters
    ----------
    data : Experiments
        What was fitted.
    fit : Fit
        With its covariance.
    options : Options
        Loss and prior knowledge.

    Returns
    -------
    Fit
        Unchanged where nothing is poorly told, or the parabola holds.
    """
    if data.size > MANY or not fit.converged or np.isfinite(options.huber):
        return fit
    free = fit.structure.free()
    factors = np.ones(len(free)) if fit.widen is None else fit.widen.copy()
    std = np.sqrt(np.diag(fit.covariance()))
    white = np.sqrt(np.diag(_white(fit)))
    for i, coordinate in enumerate(free):
        size = 1.0 if coordinate == models.A2 else abs(fit.z[coordinate])
        if coordinate in LOOSE and LOOSE[coordinate] * size < std[i] < size:
            # Coloured residuals and repeating counts scale the deviance as they do variances.
            target = RISE * (std[i] / white[i]) ** 2
            factors[i] *= max(_side(data, fit, i, s * SIGMAS * std[i], target, options)
                              for s in (-1.0, 1.0))  # fmt: skip
    return replace(fit, widen=factors)


def _white(fit: Fit) -> Array:
    return replace(fit, scores=fit.scores[:0], widen=None, blur=None).covariance()


def _side(
    data: Experiments, fit: Fit, i: int, move: float, target: float, options: Options
) -> float:
    """Return by how much farther than ``move`` the interval reaches on this side."""
    coordinate = fit.structure.free()[i]
    name = models.Z_NAMES[coordinate]
    value = float(fit.z[coordinate] + move)
    if coordinate != models.A2 and value <= 0.0:
        return 1.0  # none of these is negative
    held = fit.structure.with_(held={**fit.structure.held, name: value})
    cov = _white(fit)
    z = fit.z + fit.structure.matrix() @ (cov[:, i] / cov[i, i] * move)
    other = descend(data, held, held.complete(z), fit.initial, fit.noise, fit.ratio, options,
                    8, 0.05)  # fmt: skip
    rise = other.deviance - fit.deviance
    if not np.isfinite(rise) or rise >= target:
        return 1.0
    return float(min(np.sqrt(target / max(rise, 1e-9)), FARTHEST))
