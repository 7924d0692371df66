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

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.diagnosis.limits import CONDITION_LEVEL, CONDITION_WEIGHT
from smp_motor_ident.diagnosis.model_error import Regression
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.prediction import inverse
from smp_motor_ident.finding import Finding
from smp_motor_ident.model.coordinates import STANDS_FOR


def dependent(fit: Fit, errors: Regression | None) -> tuple[Fit, list[Finding]]:
    """Return the fit with its covariance widened by what the conditions move, and say which."""
    if errors is None:
        return fit, []
    size = errors.n_free
    level = CONDITION_LEVEL.value / max(2 * size * len(errors.conditions), 1)
    normal = errors.own.T @ errors.own
    unweighted = inverse(normal, 1e-12)[:, :size]
    added, said = np.zeros((size, size)), {}
    for name, condition in errors.conditions.items():
        tilted = errors.own * (CONDITION_WEIGHT.value * condition)[:, None]
        moves = []
        for sign in (1.0, -1.0):
            other = inverse(normal + sign * (errors.own.T @ tilted), 1e-12)[:, :size]
            move, p_value = _moved(errors, errors.own + sign * tilted, other, unweighted)
            moves.append(np.where(p_value < level, move, 0.0))
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


def _moved(
    errors: Regression, weighted: Array, other: Array, unweighted: Array
) -> tuple[Array, Array]:
    """Return by how much other weights move the coordinates, and how likely chance does that."""
    own, e = errors.own, errors.residual
    # Of the residuals in the move of each coordinate.
    rows = weighted @ other - own @ unweighted
    seen = e != 0.0  # rows without a measurement are zero
    white = float(e @ e) / max(int(seen.sum()) - own.shape[1], 1)
    share = _by_block(np.square(rows) * seen[:, None], errors.block)
    sums = _by_block(rows * e[:, None], errors.block)
    whole = np.maximum(share.sum(axis=0), 1e-300)
    stretches = 1 / np.maximum(np.square(share / whole).sum(axis=0), 1e-300)
    blocks = len(sums)
    variance = np.maximum(np.square(sums).sum(axis=0) * blocks / (blocks - 1), white * whole)
    move = other.T @ (weighted.T @ e)
    ratio = np.square(move) / np.maximum(variance, 1e-300)
    return move, np.asarray(fdtrc(1, np.maximum(stretches - 1, 1.0), ratio))


def _by_block(x: Array, block: Integers) -> Array:
    """Return the sums of columns over the rows of each block."""
    begins = np.flatnonzero(np.diff(block, prepend=-1))
    sums = np.zeros((int(block.max()) + 1, x.shape[1]))
    np.add.at(sums, block[begins], np.add.reduceat(x, begins))
    return sums
