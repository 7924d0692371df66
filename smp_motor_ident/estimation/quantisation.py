"""How far counts and currents that are not exact can mislead an estimate.

Quantisation is not noise: where the motion repeats, so does its error, and more samples do
not average it away.  The fitted motor is replayed, with a counter's zero at random places;
the Gauss-Newton step from each replay is the estimate's error on this very motion.
Derivation: docs/derivations.md, section 9.
"""

from dataclasses import replace

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.limits import SIGN_SURE
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.measurement import ANGLE, MEAN_SPEED

REPLAYS = 8, 32  # fewest and most
MOST = 500_000  # samples in all replays
MOSTLY = 3.0  # times rounding's variance, beyond which an error is another's
COUNTED = 2.0**45  # counts that a double holds to a hundredth
REACH = 2.0  # standard deviations to which motions near the estimate are replayed


def widened(data: Experiments, fit: Fit, seed: int = 0) -> Fit:
    """Return the fit with its covariance widened where quantisation repeats."""
    if fit.noise_ratio > 0 or not fit.structure.free:
        return fit
    motion, current = _steps(data, fit)
    if not (motion or current):
        return fit
    shares, rng = _shares(data, fit), np.random.default_rng(seed)
    wide = fit
    if current:  # of which quantities are differences that coordinates by themselves hardly show
        half, carried = _half(REACH**2 * fit.covariance()), prediction.influence(data, fit, 1)
        errors = _errors(data, fit, 1, current, carried, half, rng)
        excess = errors.T @ errors / max(len(errors), 1) - shares[1]
        wide = wide.wider(prediction.positive_part(excess, shares[1]))
    if not motion:
        return wide
    cov, counted, metered = fit.covariance(), *(np.diag(share) for share in shares)
    expected = np.maximum(metered + counted, 1e-300)
    ratio, carried = np.ones(len(cov)), prediction.influence(data, fit)
    # How the counter errs hangs on the motion itself, known as well as the estimate tells:
    # a first round shows how well that is, the second takes it from there.
    for _ in range(2):
        half = _half(REACH**2 * cov * np.sqrt(np.outer(ratio, ratio)))
        errors = _errors(data, fit, 0, motion, carried, half, rng)
        # Only what the counter does is replayed; what the current's noise does is known.
        second = metered + np.square(errors).sum(axis=0) / max(len(errors), 1)
        ratio = np.maximum(second / np.maximum(expected, np.diag(cov)), ratio)
    return replace(wide, widen=np.sqrt(ratio))


def _steps(data: Experiments, fit: Fit) -> tuple[float, float]:
    """Return the steps of motion and current, 0 where other errors are larger, or it is a mean."""
    motion, current = data.quantum, data.current_quantum
    if fit.noise[0, 0] > MOSTLY * motion**2 / 12 or (data.kind != ANGLE and _counted(data, fit)):
        motion = 0.0
    if fit.noise[1, 1] > MOSTLY * current**2 / 12:
        current = 0.0
    return motion, current


def _counted(data: Experiments, fit: Fit) -> bool:
    """Tell whether a speed in steps is a difference of counts, which is right on average.

    Neighbours then share a count: at c counts and a share f of another a sample their errors
    correlate by -f / (1 - f), f up to a half, those of a rounded speed by 0 or more.
    """
    if data.kind == MEAN_SPEED:
        return True
    error = data.output - prediction.simulate(data, fit)[:, 1]
    error = error[np.isfinite(error)]
    return bool(error[1:] @ error[:-1] < -SIGN_SURE.value / error.size**0.5 * (error @ error))


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


def _errors(
    data: Experiments,
    fit: Fit,
    of: int,
    step: float,
    carried: tuple[Array, Array],
    spread: Array,
    rng: np.random.Generator,
) -> Array:
    """Return what rounding an output does to the estimate, for motions near it, (replays, f)."""
    influence, slope = carried
    return _replayed(data, fit, of, step, slope @ spread, rng) @ influence


def _replayed(
    data: Experiments, fit: Fit, of: int, step: float, moves: Array, rng: np.random.Generator
) -> Array:
    """Return the errors of a rounded output, for motions near the fitted one, (replays, n).

    Where a zero is free, a counter's or a current's of unknown offset, it may be anywhere.
    """
    noise = np.sqrt(max(fit.noise[of, of] - step**2 / 12, 0.0))
    there = prediction.simulate(data, fit)[:, 1 + of]
    measured = np.isfinite(data.current) if of else np.isfinite(data.output)
    anywhere = "current_offset" in fit.structure.free if of else data.kind == ANGLE
    errors = []
    for _ in range(int(np.clip(MOST // data.size, *REPLAYS))):
        true = there + moves @ rng.standard_normal(moves.shape[1])
        if not np.abs(true).max() < COUNTED * step:
            continue  # no motor: a coordinate that the data leave open went out of all bounds
        shown = true + noise * rng.standard_normal(data.size)
        shown += rng.uniform(-0.5, 0.5) * step * anywhere
        wrong = np.rint(shown / step) * step - true
        errors.append((wrong - wrong.mean() * anywhere) * measured)
    return np.array(errors).reshape(-1, data.size)


def rounded(data: Experiments, fit: Fit, seed: int = 0) -> Array:
    """Return the errors of a rounded motion near the fitted one, (replays, n); none if not so."""
    step, _ = _steps(data, fit)
    if fit.noise_ratio > 0 or not step:
        return np.zeros((0, data.size))
    slope = prediction.influence(data, fit)[1]
    moves = slope @ _half(REACH**2 * fit.covariance())
    return _replayed(data, fit, 0, step, moves, np.random.default_rng(seed))
