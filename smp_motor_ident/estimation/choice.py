"""The rule of choice: richer only where the data reject the simpler, with the reason in words."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from smp_motor_ident.diagnosis.limits import PRIOR_ODDS, SECOND_LAG, SURE_GAIN
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model import structures as models
from smp_motor_ident.model.structures import Structure


@dataclass(frozen=True, eq=False)
class FittedCandidate:
    """A fitted candidate structure and what was decided about it."""

    fit: Fit
    reason: str = ""
    whole: bool = True
    on: Experiments | None = None  # the part of the data that it was fitted to, if not all

    @property
    def label(self) -> str:
        """Name of the structure with what was added to it."""
        return label(self.fit.structure)

    @property
    def bic(self) -> float:
        """Bayesian information criterion: deviance + parameters x ln(samples)."""
        return self.fit.deviance + size(self.fit.structure) * float(np.log(self.fit.samples))


def label(structure: Structure) -> str:
    """Return a structure's name in words."""
    added = [
        word
        for flag, word in (
            (structure.friction == "none", "no friction"),
            (structure.friction == "asymmetric", "asymmetric friction"),
            (structure.load, "load"),
            (structure.delay, "delay"),
            (structure.window, "averaged speed"),
            (structure.current_sensor == "averaged", "averaged current"),
            (structure.current_sensor == "low_passed", "low-passed current"),
            (structure.offset, "current offset"),
            (structure.held == "after", "command held after its row"),
            (structure.held == "interpolated", "command interpolated"),
        )
        if flag
    ]
    return structure.name + (" with " + ", ".join(added) if added else "")


def size(structure: Structure) -> int:
    """Return the number of parameters that a structure is charged for.

    Loops hold a command, which a log has before its row or after it: one that runs straight from
    row to row is an addition, as a parameter is.
    """
    free = structure.free()
    shape = models.TE in free and not structure.current
    return len(free) - shape + (structure.held == "interpolated")


def sandwich_factor(fit: Fit) -> float:
    """Return by how much the scores scatter more than white residuals would let them."""
    return max(1.0, float(np.median(fit.sandwich_factors())))


def worth_a_fit(data: Experiments, best: Fit, richer: Structure) -> bool:
    """Tell from the score whether a fit of more is worth its passes."""
    if not best.converged:
        return True
    gain, _, _ = prediction.predicted_decrease(data, best, richer)
    price = (size(richer) - size(best.structure)) * float(np.log(best.samples))
    return not gain < 0.5 * price * sandwich_factor(best)


def more_shows(data: Experiments, best: Fit, on_part: Fit, rich: Fit) -> bool:
    """Tell whether a richer fit of a part of the data is worth one of all of them.

    It is not where it gains next to nothing on the part, and the score of all data neither: to
    first order a speed averaged over a window is one that comes late by half of it.
    """
    s = rich.structure
    late = s.with_(window=False, delay=True) if rich.kind != best.kind else s
    if best.noise_ratio > 0 or not set(best.structure.free()) < set(late.free()):
        return True
    price = float(np.log(rich.samples)) + PRIOR_ODDS.value
    if on_part.deviance - rich.deviance > price or not rich.converged:
        return True
    return worth_a_fit(data, best, late)


def preferred(best: Fit, other: Fit) -> tuple[bool, str]:
    """Decide whether a candidate of as many parameters or more takes the place of the best."""
    if size(other.structure) > size(best.structure):
        return needed(best, other)
    # Every motor has a second lag, few have a delay: alike, the lag is believed.
    lag = other.structure.order > best.structure.order
    better = other.deviance < best.deviance + SECOND_LAG.value * sandwich_factor(other) * lag
    return better, f"fits {'better' if better else 'worse'} than {label(best.structure)}"


def preferred_but_for_descent(best: FittedCandidate, other: FittedCandidate) -> bool:
    """Decide whether a candidate would take the place of the best, had its fit settled."""
    settled = replace(other.fit, converged=True)
    if size(settled.structure) < size(best.fit.structure):
        return settled.deviance < best.fit.deviance
    return preferred(best.fit, settled)[0]


def simplest_left(best: FittedCandidate, candidates: list[FittedCandidate]) -> Fit:
    """Return the choice, or what it contains where the data ask for no more.

    The choice has been held against the one before it, which need not be the better of those.
    """
    free = set(best.fit.structure.free())
    inner = [
        r
        for r in candidates
        if r.whole and r.fit.converged and r.fit.kind == best.fit.kind
        and set(r.fit.structure.free()) < free
    ]  # fmt: skip
    return min([best, *inner], key=lambda r: r.bic).fit


def needed(simple: Fit, rich: Fit) -> tuple[bool, str]:
    """Decide whether the data reject the simpler of two models.

    References
    ----------
    White, Econometrica 50 (1982), 1, section 3 (the test under a sandwich covariance);
    Rao and Scott, Ann. Statist. 12 (1984), 46 (such sums, and correcting by one factor).
    """
    more = size(rich.structure) - size(simple.structure)
    gained = (simple.deviance - rich.deviance) / float(rich.sandwich_factors().max())
    price = more * (float(np.log(simple.samples)) + PRIOR_ODDS.value)
    if not rich.converged and gained < SURE_GAIN.value * price:
        return False, "did not converge"
    if gained <= price:
        return (
            False,
            f"no better than {label(simple.structure)} (gain {gained:.0f}, price {price:.0f})",
        )
    loose = _loose(simple, rich)
    if loose and gained < SURE_GAIN.value * price:
        return False, f"its {loose} is not identifiable from these data"
    return True, f"{label(simple.structure)} is rejected (gain {gained:.0f}, price {price:.0f})"


def _loose(simple: Fit, rich: Fit) -> str:
    cov = rich.covariance()
    free = rich.structure.free()
    for i in set(free) - set(simple.structure.free()):
        name = models.Z_NAMES[i]
        std = float(np.sqrt(cov[free.index(i), free.index(i)]))
        if name in ("delay", "window", "current_lag") and std > 0.4 * rich.z[i]:
            return name
        if name == "ln_a2" and std > 0.4:
            return "second time constant"
    return ""
