"""Whether the numbers hang on which part of the motion one looks at.

Where a model is right, estimates of the same data that weigh them otherwise differ by chance
alone.  The data are weighed towards the higher and the lower half of a condition u (the size of
the voltage or of the speed, the direction, the acceleration, driving or braking, the output or
the current); with sensitivities S, residuals e and W = 1 + r u the other estimate is off by

    d = (S' W S)^-1 S' W e,

whose covariance under a right model follows from sums of scores over blocks of samples.  A
coordinate that moves by more than that is known no better than it moves.

References
----------
J. Hausman, Specification tests in econometrics, Econometrica 46 (1978), 1251; H. White, Maximum
likelihood estimation of misspecified models, Econometrica 50 (1982), 1, section 4.
"""

import numpy as np
from scipy.special import fdtrc

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.effect_regression import Regression
from smp_motor_ident.diagnosis.limits import CONDITION_LEVEL, CONDITION_WEIGHT
from smp_motor_ident.diagnosis.model_error import regression
from smp_motor_ident.estimation.descent import refine
from smp_motor_ident.estimation.fit import Fit, Options
from smp_motor_ident.estimation.prediction import inverse
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.coordinates import STANDS_FOR


def dependent(fit: Fit, errors: Regression | None) -> tuple[Fit, list[Finding]]:
    """Return the fit with its covariance widened by what the conditions move, and say which."""
    if errors is None:
        return fit, []
    size = errors.n_free
    level = CONDITION_LEVEL.value / max(2 * size * len(errors.conditions), 1)
    own, e = errors.own, errors.residual
    normal, score = own.T @ own, own.T @ e
    unweighted = inverse(normal, 1e-12)[:, :size]
    added, said = np.zeros((size, size)), {}
    for name, condition in errors.conditions.items():
        tilted = own * (CONDITION_WEIGHT.value * condition)[:, None]
        tilt, score_tilt = own.T @ tilted, tilted.T @ e
        moves = []
        for sign in (1.0, -1.0):
            other = inverse(normal + sign * tilt, 1e-12)[:, :size]
            move = other.T @ (score + sign * score_tilt)
            # Of the residuals in the move of each coordinate.
            rows = ((other - unweighted).T @ own.T + sign * (other.T @ tilted.T)).T
            moves.append(np.where(_by_chance(errors, rows, move) < level, move, 0.0))
        far = max(moves, key=lambda d: float(np.abs(d).max()))
        if far.any():
            added += np.outer(far, far)
            names = (n for n, d in zip(fit.structure.free, far, strict=True) if d)
            said[name] = ", ".join(STANDS_FOR.get(n, n) for n in names)
    if not said:
        return fit, []
    message = "the numbers hang on the part of the motion that one looks at (" + "; ".join(said)
    return fit.wider(added), [
        Finding(
            "conditions",
            "note",
            message + "): the model is not all of the motor, and the intervals cover the parts",
            dict(said),
            "record as the motor will run: those speeds, voltages and directions",
        )
    ]


def rubbing_std(data: Experiments, fit: Fit, gear: float, least: float, options: Options) -> float:
    """Return how well the friction [V] is known that a fit leaves out, at least so well."""
    structure = fit.structure.with_(friction="symmetric")
    rubs = refine(data, structure, fit, structure.complete(fit.z), options)
    wide, _ = dependent(rubs, regression(data, rubs, gear, False))
    at = structure.free.index("vc_plus")
    return max(least, float(np.sqrt(wide.covariance()[at, at])))


def _by_chance(errors: Regression, rows: Array, move: Array) -> Array:
    """Return how likely chance moves the coordinates so far; rows: of the residuals in that."""
    known, e = errors.known, errors.residual
    white = float(e @ e) / max(np.count_nonzero(known) - errors.own.shape[1], 1)
    share = errors.by_block(np.square(rows) * known[:, None])
    sums = errors.by_block(rows * e[:, None])
    whole = np.maximum(share.sum(axis=0), 1e-300)
    stretches = 1 / np.maximum(np.square(share / whole).sum(axis=0), 1e-300)
    blocks = len(sums)
    variance = np.maximum(np.square(sums).sum(axis=0) * blocks / (blocks - 1), white * whole)
    ratio = np.square(move) / np.maximum(variance, 1e-300)
    return np.asarray(fdtrc(1, np.maximum(stretches - 1, 1.0), ratio))
