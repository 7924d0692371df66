"""A current that its sensor averages or low-passes: asked for by a score, fitted from several starts.

Left out, the lag of the sensor is taken for that of the winding: L comes out too large.
Derivation: docs/derivations.md, section 12.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from smp_motor_ident.estimation import data_window, descent, prediction
from smp_motor_ident.estimation.choice import (
    FittedCandidate,
    label,
    preferred,
    sandwich_factor,
    size,
)
from smp_motor_ident.estimation.fit import Fit, Options
from smp_motor_ident.estimation.ridge import slower_winding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model import structures as models
from smp_motor_ident.model.structures import SENSORS, Structure

Array = models.Array

LITTLE = 0.05  # of a sample: a lag whose shape shows in nothing, for the score
SHARES = (0.3, 0.8)  # of the winding's lag that may be the sensor's
SAMPLES = (0.25, 0.5, 1.5)  # of lag at which a descent begins


def with_current_lag(
    data: Experiments,
    best: Fit,
    options: Options,
    candidates: list[FittedCandidate],
    say: Callable[[str], None],
) -> Fit:
    """Return the fit, or one with the lag of the current's sensor where the data ask for it."""
    if not best.structure.current or best.structure.lags or not _asked_for(data, best):
        return best
    for sensor in SENSORS[1:]:
        richer = best.structure.with_(current_sensor=sensor)
        if any(r.fit.structure == richer for r in candidates):
            continue
        say(f"trying {label(richer)}")
        plain = best if not best.structure.lags else with_lag(best, LITTLE * data.step)
        # What looks like torque noise may be this.
        near = [best] if best.noise_ratio == 0 else [best, replace(best, noise_ratio=0.0)]
        tried = [
            descent.refine(data, richer, n, z, options)
            for z in _starts(data, plain, richer)
            for n in near
        ]
        other = min(tried, key=lambda f: f.deviance)
        verdict, reason = preferred(best, other)
        if verdict and other.noise_ratio > 0:
            other = data_window.grow(data, richer, other, options)
        candidates.append(FittedCandidate(other, reason))
        best = other if verdict else best
    return best


def with_lag(fit: Fit, lag: float) -> Fit:
    """Return a fit at another lag of the current's sensor [s]."""
    z = fit.z.copy()
    z[models.CURRENT_LAG] = lag
    return replace(fit, z=z)


def _asked_for(data: Experiments, best: Fit) -> bool:
    """Tell from the score at next to no lag whether a fit with it is worth its passes."""
    if not best.converged:
        return True
    richer = best.structure.with_(current_sensor="averaged")
    near = with_lag(best, LITTLE * data.step)
    gain, _, _ = prediction.predicted_decrease(data, near, richer)
    return not gain < 0.5 * float(np.log(best.samples)) * sandwich_factor(best)


def _starts(data: Experiments, best: Fit, richer: Structure) -> list[Array]:
    """Return starts: lags of so many samples, and those that L/R has taken up."""
    te = float(np.exp(best.z[models.TE]))
    out = []
    for lag, left in [(s * data.step, te) for s in SAMPLES] + [(s * te, (1 - s) * te) for s in SHARES]:
        z = slower_winding(best.z, float(np.log(left)))
        z[models.CURRENT_LAG] = lag
        out.append(richer.complete(z))
    return out
