"""The rule of choice: richer only where the data reject the simpler, with the reason in words."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri, fdtrc

from smp_motor_ident.diagnosis.limits import (
    LOOSE_ADDITION,
    PRIOR_ODDS,
    RELEVANT_BIAS,
    SECOND_LAG,
    SUBSET_HOPELESS,
    SURE_GAIN,
)
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.fitted import long_run
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.structures import Structure


@dataclass(frozen=True, eq=False)
class FittedCandidate:
    """A fitted candidate structure and what was decided about it."""

    fit: Fit
    reason: str = ""
    whole: bool = True  # fitted to all data, not to a subset
    # What it was fitted to, if not the data of the choice: a part of them, or under another hold
    on: Experiments | None = None
    hold: str = ""  # the other hold, in words
    behind: str = ""  # an effect beside the motor, in words
    numbers: int = 0  # that describe it

    @property
    def label(self) -> str:
        """Name of the structure with what was added to it."""
        hold = f", command {self.hold}" if self.hold else ""
        return self.fit.structure.label + hold + (f", behind {self.behind}" if self.behind else "")

    @property
    def bic(self) -> float:
        """Bayesian information criterion."""
        return bic(self.fit) + self.numbers * float(np.log(self.fit.samples))

    def contains(self, other: "FittedCandidate") -> bool:
        """Tell whether another, fitted to all data, is this one with fewer free coordinates."""
        free = set(self.fit.structure.free)
        settled = other.whole and other.fit.converged and other.fit.kind == self.fit.kind
        return settled and set(other.fit.structure.free) < free


def bic(fit: Fit) -> float:
    """Return the Bayesian information criterion: deviance + parameters x ln(samples)."""
    return fit.deviance + fit.structure.size * float(np.log(fit.samples))


def sandwich_factor(fit: Fit) -> float:
    """Return by how much the scores scatter more than white residuals would let them."""
    return max(1.0, float(np.median(fit.sandwich_factors())))


def evidence(simple: Fit, rich: Fit, coordinate: str) -> float:
    """Return the gain of a number that errors may imitate in a coordinate, as a chi-square's.

    Errors that outlast a run of samples leave few independent ones, as many as the runs times what
    these sum up to over what all of a record does; with those that remain the gain is Snedecor's F.
    """
    i, at = (fit.structure.free.index(coordinate) for fit in (simple, rich))
    left = float(rich.factors(long_run)[at])
    gained = max(simple.deviance - rich.deviance, 0.0) / left
    pieces = len(simple.scores) * float(simple.sandwich_factors()[i] / simple.factors(long_run)[i])
    freedom = pieces - simple.structure.size - 1
    if left <= 1:  # white
        return gained
    return float(chdtri(1, fdtrc(1, freedom, gained * freedom / pieces))) if freedom > 0 else 0.0


@dataclass(frozen=True)
class SelectionPolicy:
    """When one candidate structure takes the place of another; all in deviance.

    References
    ----------
    White, Econometrica 50 (1982), 1, section 3 (the test under a sandwich covariance);
    Rao and Scott, Ann. Statist. 12 (1984), 46 (such sums, and correcting by one factor).
    """

    prior_odds: float = PRIOR_ODDS.value  # against each parameter more, beside ln(samples)
    second_lag: float = SECOND_LAG.value  # by which a second lag may fit worse than a delay
    sure_gain: float = SURE_GAIN.value  # of the price, of what did not settle or is hardly known
    hopeless: float = SUBSET_HOPELESS.value  # behind the best on a subset, that goes no further
    loose: float = LOOSE_ADDITION.value  # of its value, or in e-folds: hardly known

    def price(self, parameters: int, samples: int) -> float:
        """Return by how much so many parameters more must lower the deviance."""
        return parameters * (float(np.log(samples)) + self.prior_odds)

    def worth_a_fit(self, data: Experiments, best: Fit, richer: Structure) -> bool:
        """Tell from the score whether a fit of more is worth its passes."""
        if not best.converged:
            return True
        gain, _, _ = prediction.predicted_decrease(data, best, richer)
        price = (richer.size - best.structure.size) * float(np.log(best.samples))
        return not gain < 0.5 * price * sandwich_factor(best)

    def more_shows(self, data: Experiments, best: Fit, on_part: Fit, rich: Fit) -> bool:
        """Tell whether a richer fit of a part of the data is worth one of all of them.

        It is not where it gains next to nothing on the part, and the score of all data neither: to
        first order a speed averaged over a window is one that comes late by half of it.
        """
        s = rich.structure
        late = s.with_(window=False, delay=True) if rich.kind != best.kind else s
        if best.noise_ratio > 0 or not set(best.structure.free) < set(late.free):
            return True
        if on_part.deviance - rich.deviance > self.price(1, rich.samples) or not rich.converged:
            return True
        return self.worth_a_fit(data, best, late)

    def rejects_on_subset(self, fit: Fit, least: float) -> bool:
        """Tell whether a part of the data rejects a candidate by far, the least deviance known."""
        return fit.deviance > least + self.hopeless * sandwich_factor(fit)

    def preferred(self, best: Fit, other: Fit) -> tuple[bool, str]:
        """Decide whether a candidate of as many parameters or more takes the place of the best."""
        if other.structure.size > best.structure.size:
            return self.needed(best, other)
        # Every motor has a second lag, few have a delay, and few filters are slower than the
        # motor: alike, the likelier is believed.
        odds = other.structure.order - best.structure.order
        odds += slowly_filtered(best) - slowly_filtered(other)
        better = other.deviance < best.deviance + self.second_lag * sandwich_factor(other) * odds
        return better, f"fits {'better' if better else 'worse'} than {best.structure.label}"

    def likelier(self, other: FittedCandidate, best: FittedCandidate) -> bool:
        """Decide between candidates under different holds, of which neither contains the other."""
        lag = other.fit.structure.order - best.fit.structure.order
        return other.bic < best.bic + self.second_lag * sandwich_factor(other.fit) * lag

    def replaces(self, best: Fit, other: Fit) -> tuple[bool, str]:
        """Decide whether a candidate of any number of parameters takes the place of the best."""
        if other.structure.size >= best.structure.size:
            return self.preferred(best, other)
        verdict, reason = self.preferred(other, best)
        return not verdict, reason

    def preferred_but_for_descent(self, best: FittedCandidate, other: FittedCandidate) -> bool:
        """Decide whether what explains more would take the place of the best, had it settled."""
        settled = replace(other.fit, converged=True)
        if settled.deviance >= best.fit.deviance:
            return False
        smaller = settled.structure.size < best.fit.structure.size
        return smaller or self.preferred(best.fit, settled)[0]

    def simplest_left(self, best: FittedCandidate, candidates: list[FittedCandidate]) -> Fit:
        """Return the choice, or what it contains where the data ask for no more.

        The choice has been held against the one before it, which need not be the better of those.
        """
        inner = [r for r in candidates if best.contains(r)]
        return min([best, *inner], key=lambda r: r.bic).fit

    def needed(self, simple: Fit, rich: Fit) -> tuple[bool, str]:
        """Decide whether the data reject the simpler of two models."""
        gained = (simple.deviance - rich.deviance) / float(rich.sandwich_factors().max())
        price = self.price(rich.structure.size - simple.structure.size, simple.samples)
        price += self.second_lag * _delayed_instead(simple, rich)
        than = f"(gain {gained:.0f}, price {price:.0f})"
        if not rich.converged and gained < self.sure_gain * price:
            return False, "did not converge"
        if gained <= price:
            return False, f"no better than {simple.structure.label} {than}"
        hardly = self._hardly_known(simple, rich)
        if hardly and gained < self.sure_gain * price:
            return False, f"its {hardly} is not identifiable from these data"
        return True, f"{simple.structure.label} is rejected {than}"

    def _hardly_known(self, simple: Fit, rich: Fit) -> str:
        cov, free = rich.covariance(), rich.structure.free
        for name in set(free) - set(simple.structure.free):
            std = float(np.sqrt(cov[free.index(name), free.index(name)]))
            if name in ("delay", "window", "current_lag") and std > self.loose * rich.z.value(name):
                return name
            if name == "ln_a2" and std > self.loose:
                return "second time constant"
        return ""


def slowly_filtered(fit: Fit) -> bool:
    """Tell whether a speed's filter is slower than the motor, which few are."""
    return fit.structure.low_pass and 0.5 * fit.z.window > fit.z.time_constant


def _delayed_instead(simple: Fit, rich: Fit) -> bool:
    """Tell whether a delay takes the place of a second lag, of which nothing that matters is left.

    That is a motor of the first order with a delay, whatever else is free.
    """
    s, t = simple.structure, rich.structure
    if s.order != 2 or t.order != 2 or s.current or s.delay or not t.delay:
        return False
    return rich.z.second_lag < RELEVANT_BIAS.value * rich.z.time_constant


POLICY = SelectionPolicy()
"""The policy of every estimate."""


def in_turn(candidates: list[FittedCandidate]) -> list[FittedCandidate]:
    """Return the choice, then those that are no richer; whose descent did not settle come last."""
    most = candidates[-1].fit.structure.size
    others = [r for r in candidates[:-1] if r.whole and not r.hold and r.fit.structure.size <= most]
    others.sort(key=lambda r: (not r.fit.converged, r.bic))
    return [candidates[-1], *others]
