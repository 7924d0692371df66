"""Consider covariance: the uncertainty of what is fixed though not known exactly, handed on.

A delay or a friction that the model leaves out is not known to be nothing.  The estimate's
answer to it, ``G = N^-1 N_beside``, carries its variance to all that is reported.
Derivation: docs/derivations.md, section 9.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model import structures as models
from smp_motor_ident.model.structures import Structure

Array = NDArray[np.float64]


def consider_timing(data: Experiments, fit: Fit, instant: float) -> Fit:
    """Return the fit with its covariance widened by what the input's instants leave open."""
    structure = fit.structure
    if instant <= 0 or structure.delay or "delay" in structure.fixed or not structure.free():
        return fit
    answer, _ = _answer(data, fit, structure.with_(delay=True), models.DELAY)
    return _wider(fit, answer, instant**2)


def consider_friction(data: Experiments, fit: Fit) -> tuple[Fit, float]:
    """Return the fit with its covariance widened by a friction that was left out."""
    structure = fit.structure
    if structure.friction != "none" or not structure.free():
        return fit, 0.0
    answer, left = _answer(data, fit, structure.with_(friction="symmetric"), models.VC_PLUS)
    variance = float(np.max(fit.sandwich_factors())) / max(left, 1e-12)
    return _wider(fit, answer, variance), float(np.sqrt(variance))


def _answer(data: Experiments, fit: Fit, richer: Structure, coordinate: int) -> tuple[Array, float]:
    """Return how the fit answers to one more coordinate, and the information left on that."""
    both = prediction.information(data, replace(fit, structure=richer))
    keep = [i for i, c in enumerate(richer.free()) if c != coordinate]
    late = richer.free().index(coordinate)
    answer = prediction.inverse(both[np.ix_(keep, keep)], 1e-12) @ both[keep, late]
    return answer, float(both[late, late] - both[late, keep] @ answer)


def _wider(fit: Fit, answer: Array, variance: float) -> Fit:
    more = np.asarray(variance * np.outer(answer, answer), dtype=np.float64)
    return replace(fit, added=more + (0.0 if fit.added is None else fit.added))
