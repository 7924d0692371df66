"""How far counts that are not exact can mislead an estimate.

Quantisation is not noise: where the motion repeats, so does its error, and more samples do
not average it away.  The fitted motor is replayed with the counter's zero at random places;
the Gauss-Newton step from each replay is the estimate's error on this very motion.
Derivation: docs/derivations.md, section 9.
"""

from dataclasses import replace

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.measurement import ANGLE, MEAN_SPEED

REPLAYS = 8, 32  # fewest and most
MOST = 500_000  # samples in all replays
COUNTED = 2.0**45  # counts that a double holds to a hundredth
REACH = 2.0  # standard deviations to which motions near the estimate are replayed


def widened(data: Experiments, fit: Fit, seed: int = 0) -> Fit:
    """Return the fit with its covariance widened where quantisation repeats."""
    if data.quantum == 0 or fit.noise_ratio > 0 or not fit.structure.free:
        return fit
    own = data.quantum**2 / 12
    if fit.noise[0, 0] > 3 * own or (data.kind != ANGLE and _counted(data, fit)):
        return fit
    cov = fit.covariance()
    counted, metered = (np.diag(share) for share in _shares(data, fit))
    expected = np.maximum(metered + counted, 1e-300)
    rng = np.random.default_rng(seed)
    excess, (influence, slope) = np.ones(len(cov)), prediction.influence(data, fit)
    # How the counter errs hangs on the motion itself, known as well as the estimate tells:
    # a first round shows how well that is, the second takes it from there.
    for _ in range(2):
        spread = REACH**2 * cov * np.sqrt(np.outer(excess, excess))
        errors = _counting_errors(data, fit, own, slope @ _half(spread), rng) @ influence
        # Only what the counter does is replayed; what the current's noise does is known.
        second = metered + np.square(errors).sum(axis=0) / max(len(errors), 1)
        excess = np.maximum(second / np.maximum(expected, np.diag(cov)), excess)
    return replace(fit, widen=np.sqrt(excess))


def _counted(data: Experiments, fit: Fit) -> bool:
    """Tell whether a speed in steps is a difference of counts, which is right on average.

    Neighbours then share a count: their errors correlate by -1/2, those of a rounded speed by 0 or
    more.
    """
    if data.kind == MEAN_SPEED:
        return True
    error = data.output - prediction.simulate(data, fit)[:, 1]
    error = error[np.isfinite(error)]
    return bool(error[1:] @ error[:-1] < -0.25 * (error @ error))


def _shares(data: Experiments, fit: Fit) -> tuple[Array, Array]:
    """Return the covariances that independent errors of counter and current would make."""
    whole = prediction.information(data, fit)
    inverse = prediction.inverse(whole)
    if not data.current.size:
        return inverse, np.zeros_like(inverse)
    lost = replace(data, current=np.full(data.size, np.nan))
    counter = prediction.information(lost, fit)
    return inverse @ counter @ inverse, inverse @ (whole - counter) @ inverse


def _half(spread: Array) -> Array:
    """Return a matrix that makes draws of this covariance from draws of unit variance."""
    values, vectors = np.linalg.eigh(spread)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _counting_errors(
    data: Experiments, fit: Fit, own: float, moves: Array, rng: np.random.Generator
) -> Array:
    """Return what rounding adds to the output of motions near the fit's, shape (replays, n).

    A counter's zero may be anywhere, a speed's is known; an angle's offset is free besides.
    """
    noise = np.sqrt(max(fit.noise[0, 0] - own, 0.0))
    there = prediction.simulate(data, fit)[:, 1]
    errors = []
    for _ in range(int(np.clip(MOST // data.size, *REPLAYS))):
        true = there + moves @ rng.standard_normal(moves.shape[1])
        if not np.abs(true).max() < COUNTED * data.quantum:
            continue  # no motor: a coordinate that the data leave open went out of all bounds
        counted = data.kind == ANGLE
        shown = true + noise * rng.standard_normal(data.size)
        shown += rng.uniform(-0.5, 0.5) * data.quantum * counted
        wrong = np.rint(shown / data.quantum) * data.quantum - true
        errors.append(wrong - wrong.mean() * counted)
    return np.array(errors).reshape(-1, data.size)
