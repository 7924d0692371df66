"""How well a few transients tell what they alone tell: a sandwich over their pieces.

Where all that is known of a coordinate comes from few runs of samples, the scores of these runs are
nothing at the optimum, whatever the model lacks, and so is a sandwich of them.  It is taken over
pieces of equal leverage, however short, instead, and their errors count by that leverage more.
Derivation: docs/derivations.md, section 9.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.special import chdtri

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.limits import CONDITION_LEVEL, FEW_TRANSIENTS
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.fitted import long_run
from smp_motor_ident.estimation.profile import one_level
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.noise import whitening
from smp_motor_ident.likelihood.passes import answers, own_columns
from smp_motor_ident.model.coordinates import PLAUSIBLE

PIECES = 24
ENDED = 1e-2  # standard deviations at which a descent ends
MOST = 1_000_000  # samples whose sensitivities are held in memory at once


def widened_by_pieces(data: Experiments, fit: Fit) -> Fit:
    """Return the fit with its covariance widened to that of errors of pieces, if few runs tell it.

    References
    ----------
    Bell and McCaffrey, Survey Methodology 28 (2002), 169 (errors of clusters, by their leverage).
    """
    if data.current.size or fit.gain.any() or not fit.structure.free or data.size > MOST:
        return fit
    if not np.any(_runs(fit) < FEW_TRANSIENTS.value):
        return fit
    if "vc_plus" in fit.structure.free and one_level(data, fit):
        return _beside_friction(data, fit)
    moves = _moves(data, fit)
    pieces = len(moves)
    if pieces <= 2 * moves.shape[1]:
        return fit
    # In standard deviations, along directions that are independent of each other.
    deviation = np.sqrt(np.diag(fit.conditional()))
    values, vectors = np.linalg.eigh(fit.conditional() / np.outer(deviation, deviation))
    half = deviation[:, None] * vectors * np.sqrt(np.maximum(values, 1e-12))
    scaled = moves @ np.linalg.inv(half).T
    along = np.linalg.eigh(scaled.T @ scaled)[1]
    ratio = long_run(scaled @ along) * (pieces - 1) / pieces
    ratio[ratio < chdtri(pieces - 1, CONDITION_LEVEL.value) / (pieces - 1)] = 1.0
    more = half @ along * np.sqrt(np.maximum(ratio - 1.0, 0.0))
    return fit.wider(more @ more.T)


def _beside_friction(data: Experiments, fit: Fit) -> Fit:
    """Return the fit widened as one of known friction: of one level its profile follows that."""
    keep = np.array([n != "vc_plus" for n in fit.structure.free])
    fixed = {**fit.structure.fixed, "vc_plus": fit.z.vc_plus}
    known = replace(
        fit,
        structure=fit.structure.with_(fixed=fixed),
        information=fit.information[np.ix_(keep, keep)],
        scores=fit.scores[:, keep],
        widen=None if fit.widen is None else fit.widen[keep],
        added=None,
    )
    added = np.zeros((keep.size, keep.size))
    more = widened_by_pieces(data, known).added
    added[np.ix_(keep, keep)] = 0.0 if more is None else more
    return fit.wider(added)


def _runs(fit: Fit) -> Array:
    """Return over how many runs of samples the score of each coordinate is spread, shape (f,)."""
    square = np.square(fit.scores)
    spread = np.square(square.sum(axis=0))
    return np.asarray(spread / np.maximum(np.square(square).sum(axis=0), 1e-300))


def _moves(data: Experiments, fit: Fit) -> Array:
    """Return how the errors of each piece move the free coordinates, shape (pieces, f).

    Of errors that were as large everywhere, what a piece leaves of its own is less by its leverage:
    they count by the root of that more, where they are more than where a descent happened to end.
    """
    none = np.zeros((0, 0)), np.zeros((0, 0, 0))
    moved = answers(data, fit.structure, fit.z, fit.initial, fit.noise_model(), none, 1, True)
    rows = whitening(fit.noise)[0, 0] * moved[:, 0]
    error = whitening(fit.noise)[0, 0] * (data.output - prediction.simulate(data, fit)[:, 1])
    error[np.isnan(error)] = 0.0
    size, own = len(fit.structure.free), list(own_columns(data, fit.structure))
    parts = np.array([rows[a:b].T @ rows[a:b] for a, b in pairwise(data.starts)])
    parts[:, size:, size:] += data.known_initial[:, own, None] * np.eye(len(own))
    inner = prediction.inverse(parts[:, size:, size:]) @ parts[:, size:, :size]
    seen = parts[:, :size, :size] - parts[:, :size, size:] @ inner
    # As in the covariance: a piece moves a coordinate that no data tell within any motor's.
    whole = seen.sum(axis=0) + np.diag(fit.structure.of_free(PLAUSIBLE))
    alike = rows[:, :size] @ prediction.root_of_inverse(whole)
    leverage = np.cumsum(np.einsum("nf,nf->n", alike, alike))
    shares = np.linspace(0.0, leverage[-1], PIECES + 1)[:-1]
    cuts = np.union1d(np.searchsorted(leverage, shares), data.starts)
    normal = parts.copy()
    normal[:, :size, :size] += whole - seen
    normal = normal[np.searchsorted(data.starts, cuts[:-1], side="right") - 1]
    root = prediction.root_of_inverse(normal)
    piece = np.array([rows[a:b].T @ rows[a:b] for a, b in pairwise(cuts)])
    gradient = np.array([rows[a:b].T @ error[a:b] for a, b in pairwise(cuts)])[:, :, None]
    taken, along = np.linalg.eigh(np.swapaxes(root, 1, 2) @ piece @ root)
    taken = np.clip(taken, 1e-12, 1.0)
    left = np.where(1 - taken > ENDED**2, 1 - taken, 1.0)
    turned = root @ along
    more = turned * ((1 / np.sqrt(left) - 1) / taken)[:, None, :]
    gradient += piece @ more @ (np.swapaxes(turned, 1, 2) @ gradient)
    return np.asarray((root @ (np.swapaxes(root, 1, 2) @ gradient))[:, :size, 0])
