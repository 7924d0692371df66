"""A fit as it ended: coordinates, information, noise, and the covariance that follows.

Derivation: docs/derivations.md, section 9.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.likelihood.noise import NoiseModel
from smp_motor_ident.model.coordinates import PLAUSIBLE, Coordinates, direction
from smp_motor_ident.model.measurement import Measurement
from smp_motor_ident.model.structures import Structure
from smp_motor_ident.result import NORMAL_95

ROUNDING = 1e-13
"""Share of the information in which sums over thousands of samples are exact."""


def long_run(sums: Array) -> Array:
    """Return the variance of the total of sums over successive runs of samples, shape (f,).

    Runs that are shorter than the errors' memory go on in the next: positive correlations count
    with Bartlett's weights, as far as a first-order autoregression of the sums asks for.

    References
    ----------
    D. Andrews, Econometrica 59 (1991), 817, equations 5.3, 6.2 and 6.4.
    """
    n = len(sums)
    squares = np.maximum(np.square(sums).sum(axis=0), 1e-300)
    share = np.clip((sums[1:] * sums[:-1]).sum(axis=0) / squares, 0.0, 0.97)
    width = 1.1447 * np.cbrt(4 * np.square(share / (1 - np.square(share))) * n)
    total = np.ones_like(squares)
    for k in range(1, min(n - 1, int(np.max(width, initial=0.0)) + 1)):
        weight = np.maximum(1 - k / np.maximum(width, 1e-9), 0.0)
        total += 2 * weight * (sums[k:] * sums[:-k]).sum(axis=0) / squares
    return np.asarray(squares * np.maximum(total, 1.0))


@dataclass(frozen=True)
class Prior:
    """A statement of the user, ``row z = value`` within ``std``, linear around the estimate."""

    name: str
    value: float
    std: float


@dataclass(frozen=True, eq=False)
class Profile:
    """A coordinate followed to both ends of its 95 % interval, all others fitted again."""

    coordinate: str
    # The whole motor at the lower and the upper end
    ends: tuple[Coordinates, Coordinates]


@dataclass(frozen=True)
class Options:
    """What the user asked of a fit."""

    # Bound of the robust loss [standard deviations]; infinite for least squares
    huber: float = np.inf
    priors: tuple[Prior, ...] = ()  # physical parameters that are known


@dataclass(frozen=True, eq=False)
class Start:
    """Where a descent begins: a motor, how it moved at first, and the noise that is believed."""

    z: Coordinates
    initial: Array  # shape (g, 5): q, w, angle, load, earlier current of each segment
    noise: Array  # shape (2, 2): covariance of the innovations of (output, current)
    noise_ratio: float = 0.0  # intensity of the torque noise over the output's noise variance

    def at(
        self, z: Coordinates, initial: Array | None = None, noise_ratio: float | None = None
    ) -> "Start":
        """Return the same start at other coordinates."""
        return Start(
            z,
            self.initial if initial is None else initial,
            self.noise,
            self.noise_ratio if noise_ratio is None else noise_ratio,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit(Start):
    """A structure fitted to experiments, which other descents may start from."""

    structure: Structure  # what was free
    gain: Array  # shape (3, 2): innovation gain
    objective: float  # weighted sum of squares
    deviance: float  # -2 log likelihood, up to a constant of the data
    # shape (f, f): normal matrix of the free coordinates, initial states eliminated
    information: Array
    scores: Array  # shape (blocks, f): scores summed over runs of samples
    passes: int  # runs over the data that it took
    converged: bool  # whether the last step was small
    # samples, kind: of the data
    samples: int
    kind: Measurement
    # shape (f,): factors on the standard deviations, see `quantisation.widened`
    widen: Array | None = None
    # shape (f, f): covariance of what the likelihood does not see: `consider`, `segments`
    added: Array | None = None
    # Coordinates whose interval was followed, not extrapolated, see `profile`
    profiles: tuple[Profile, ...] = ()

    def wider(self, added: Array) -> "Fit":
        """Return the fit with a covariance added that the likelihood does not see."""
        return replace(self, added=added if self.added is None else self.added + added)

    def along(self, move: Array) -> "Fit":
        """Return the fit with its covariance widened by a move of the free coordinates."""
        return self.wider(np.outer(move, move).astype(np.float64))

    def log_ratio(self) -> tuple[float, float]:
        """Return ``ln(a2 a0 / a1^2)``, above `RINGS` of a motor that rings, and its deviation."""
        row = direction(ln_a0=1.0, ln_a1=-2.0, ln_a2=1.0)
        free = row @ self.structure.matrix
        return float(row @ self.z.array), float(np.sqrt(free @ self.covariance() @ free))

    def noise_model(self) -> NoiseModel:
        """Return how the residuals weigh."""
        return NoiseModel(self.noise, self.gain)

    def covariance(self) -> Array:
        """Return the covariance of the free coordinates, shape (f, f).

        The inverse information, widened coordinate by coordinate where the scores of
        whole runs of samples scatter more than white residuals would let them; along a
        profile, what that found.
        """
        cov = self.conditional()
        for profile in self.profiles:
            moves = [end.array - self.z.array for end in profile.ends]
            far = max(moves, key=lambda move: float(np.abs(move).max()))
            secant = self.structure.of_free(far) / NORMAL_95
            cov = cov + np.outer(secant, secant)
        return cov

    def conditional(self) -> Array:
        """Return the covariance with the profiled coordinates fixed, and what is added, (f, f)."""
        return self._conditional

    @cached_property
    def _conditional(self) -> Array:
        cov = self.white()
        widen = np.sqrt(self.factors(long_run))
        cov = cov * np.outer(widen, widen)
        if self.widen is not None:
            cov = cov * np.outer(self.widen, self.widen)
        for profile in self.profiles:
            i = self.structure.free.index(profile.coordinate)
            cov = cov - np.outer(cov[:, i], cov[i]) / max(float(cov[i, i]), 1e-300)
        cov = cov if self.added is None else cov + self.added
        cov.flags.writeable = False
        return cov

    def sandwich_factors(self) -> Array:
        """Return by how much each variance is larger than of white residuals, shape (f,).

        For choices between structures: an error that outlasts a run of samples is in all of them.
        """
        return self.factors(lambda sums: np.square(sums).sum(axis=0))

    def factors(self, variance: Callable[[Array], Array]) -> Array:
        """Return by how much a variance of sums of scores exceeds that of white residuals."""
        cov = self.white()
        n = len(self.scores)
        if n <= 2 * cov.shape[0]:
            return np.ones(cov.shape[0])
        moved = (self.scores - self.scores.mean(axis=0)) @ cov
        sandwich = variance(moved) * (n / (n - 1))
        return np.asarray(np.maximum(1.0, sandwich / np.maximum(np.diag(cov), 1e-300)))

    def white(self) -> Array:
        """Return the covariance of white residuals, shape (f, f)."""
        return self._white

    @cached_property
    def _white(self) -> Array:
        # Every coordinate lies within some e-folds or volts of any motor's: without that a
        # direction that the data leave open would count as known.
        plausible = np.diag(self.structure.of_free(PLAUSIBLE))
        information = self.information + plausible
        scale = np.sqrt(np.diag(information))
        values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
        vectors = vectors / scale[:, None]
        # What rounding leaves of a direction's information is no information.
        alone = np.einsum("ij,ik,kj->j", vectors, plausible, vectors)
        cov: Array = (vectors / np.where(values > ROUNDING, values, alone)) @ vectors.T
        cov.flags.writeable = False
        return cov
