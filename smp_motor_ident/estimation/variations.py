"""What a chosen structure may be added to, and friction that it may lose: as the data ask."""

from collections.abc import Callable

import numpy as np

from smp_motor_ident.diagnosis.limits import LITTLE_FRICTION
from smp_motor_ident.estimation import data_window, descent, prediction
from smp_motor_ident.estimation.candidate_starts import of_kind
from smp_motor_ident.estimation.current_lag import (
    with_current_lag,
    with_other_sensor,
    without_current_lag,
)
from smp_motor_ident.estimation.delay_and_averaging import (
    as_averaged,
    delay_without_noise,
    snapped,
    with_digital_filter,
    with_filter_for_lag,
    with_late_speed,
    with_low_pass,
)
from smp_motor_ident.estimation.fit import Fit, Options, solve
from smp_motor_ident.estimation.initialisation import beginning, initial_fit
from smp_motor_ident.estimation.lag_exchange import rubs_behind_filter, with_quicker_filter
from smp_motor_ident.estimation.profile import RISE, one_level, rubbing
from smp_motor_ident.estimation.selection import (
    POLICY,
    FittedCandidate,
    sandwich_factor,
    slowly_filtered,
)
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.structures import Structure

Say = Callable[[str], None]

SHARES = (0.1, 0.3)  # of the largest voltage that friction may take, tried where gain and it trade


def varied(
    data: Experiments, best: Fit, options: Options, candidates: list[FittedCandidate], say: Say
) -> Fit:
    """Add what the data ask for, take away what they do not show."""
    best = with_filter_for_lag(data, best, options, candidates, say)
    best = with_low_pass(data, best, options, candidates, say)
    best = with_digital_filter(data, best, options, candidates, say)
    best = with_late_speed(data, best, options, candidates, say)
    best = as_averaged(data, best, options, candidates, say)
    best = without_current_lag(data, best, options, candidates, say)
    data = data.measured_as(best.kind)
    if slowly_filtered(best):
        best = with_quicker_filter(data, best, options, candidates)
    sensed = best.structure
    before = None
    while before != best.structure:  # what was added may have hidden that the rest is there, too
        before = best.structure
        for change in _additions(before):
            if "friction" in change and data.one_way:  # of the other direction nothing shows
                continue
            best = _with_addition(data, best, change, options, candidates, say)
    if best.structure != sensed:  # without it either lag may have stood for what was missing
        best = with_filter_for_lag(data, best, options, candidates, say)
        best = as_averaged(data, best, options, candidates, say)
        data = data.measured_as(best.kind)
    if best.structure != candidates[0].fit.structure:  # what was added may have hidden it
        best = with_current_lag(data, best, options, candidates, say)
    best = with_other_sensor(data, best, options, candidates, say)
    return _without_friction(data, best, options, candidates)


def _with_addition(
    data: Experiments,
    best: Fit,
    change: dict[str, object],
    options: Options,
    candidates: list[FittedCandidate],
    say: Say,
) -> Fit:
    """Return the fit with an addition, if the data ask for it."""
    richer = best.structure.with_(**change)
    if richer == best.structure or any(r.fit.structure == richer for r in candidates):
        return best
    hidden = delay_without_noise(data, best, options) if "delay" in change else None
    if hidden is None and not POLICY.worth_a_fit(data, best, richer):
        return best
    say(f"trying {richer.label}")
    z = best.z.with_(delay=0.3 * data.step) if "delay" in change else best.z
    other = descent.refine(data, richer, best, z, options)
    other = min(other, hidden or other, key=lambda f: f.deviance)
    verdict, reason = POLICY.preferred(best, other)
    if verdict and "delay" in change:
        other = snapped(data, other, options)
    if verdict and "delay" in change and other.z.delay < 0.03 * data.step:
        verdict, reason = False, "a delay of hundredths of a sample is how the input was held"
    if verdict:
        other = data_window.grown(data, other, options)
    if verdict and richer.current and "load" in change:  # R and K were found where it was missing
        other = initial_fit(data, richer, options, [other.z], near=other) or other
    candidates.append(FittedCandidate(other, reason))
    return other if verdict else best


def _additions(s: Structure) -> list[dict[str, object]]:
    """Return what may be added to a structure, in the order in which it is tried."""
    trials: list[dict[str, object]] = []
    load = not s.own_load  # of which a common one is no addition
    if s.current:
        trials.append({"offset": True})
        if "delay" not in s.fixed and not s.delay:
            trials.append({"delay": True})
    if s.friction != "asymmetric" and load:
        trials.append({"load": True})
    if s.current and load:  # an offset of the driver is both at once, and may be neither alone
        trials.append({"offset": True, "load": True})
    if s.friction == "symmetric":
        trials.append({"friction": "asymmetric", "load": load})
    return trials


def _without_friction(
    data: Experiments, best: Fit, options: Options, candidates: list[FittedCandidate]
) -> Fit:
    """Leave Coulomb friction out where the data show that there is next to none."""
    s = best.structure
    if s.friction != "symmetric" or "vc_plus" in s.fixed:
        return best
    smooth = s.frictionless()
    subset = of_kind(descent.screening_subset(data), best)
    if subset.size < data.size:
        with_it = descent.refine(subset, s, best, best.z, options)
        without = descent.refine(subset, smooth, with_it, best.z, options, known=with_it)
        if without.deviance > with_it.deviance + POLICY.hopeless * sandwich_factor(with_it):
            return best
    plain = descent.refine(data, smooth, best, best.z, options)
    if plain.deviance < best.deviance:  # then friction has led astray
        z = plain.z.with_(vc_plus=1e-3 * np.abs(data.hold_value).max())
        others = [descent.refine(data, s, plain, s.complete(z), options)]
        if s.current and one_level(data, plain):  # the same motion, with the friction of another
            others += _rubbing_more(data, plain, s, options)
        best = min(best, *others, key=lambda f: f.deviance)
    # Friction that the data do not show stays where a little would explain them as well:
    # leaving it out would make the gain certain.  A descent that did not settle is no reason
    # to believe in none.
    gained = (plain.deviance - best.deviance) / sandwich_factor(best)
    if gained <= float(np.log(best.samples)) and not may_rub(data, plain, options):
        candidates.append(FittedCandidate(plain, "no Coulomb friction shows"))
        return plain
    return best


def _rubbing_more(
    data: Experiments, plain: Fit, structure: Structure, options: Options
) -> list[Fit]:
    """Fit from motors that move alike at the one level of voltage and rub far more."""
    full = float(np.abs(data.hold_value).max())
    return [
        solve(data, structure, plain.at(structure.complete(z), initial), options, 30)
        for share in SHARES
        for z, initials in [rubbing(data, plain, share * full)]
        for initial in initials
    ]


def friction_shows(data: Experiments, fit: Fit, surely_small: bool) -> bool:
    """Tell by the score whether Coulomb friction is there, or may be and is not little."""
    structure = fit.structure.with_(friction="symmetric")
    _, step, cov = prediction.predicted_decrease(data, fit, structure)
    i = structure.free.index("vc_plus")
    std = float(np.sqrt(max(cov[i, i], 1e-300)) * np.sqrt(sandwich_factor(fit)))
    found = max(float(step[i]), 0.0)
    if not np.isfinite(found) or (found / std) ** 2 > 0.5 * np.log(fit.samples):
        return True
    return surely_small and found + 2 * std > _little(data)


def _little(data: Experiments) -> float:
    """Return the friction [V] below which there is next to none."""
    return LITTLE_FRICTION.value * float(np.abs(data.hold_value).max())


def may_rub(data: Experiments, fit: Fit, options: Options) -> bool:
    """Tell whether a friction that is not little would explain the data as well.

    The score at no friction does not tell: a motor that rests under a little friction is
    driven by its offset under none.
    """
    if one_level(data, fit) or friction_shows(data, fit, True):
        return True
    return _rubs_as_well(data, fit, options) or rubs_behind_filter(data, fit, options)


def _rubs_as_well(data: Experiments, fit: Fit, options: Options) -> bool:
    """Tell whether a friction that is just not little explains the data as well; a part first."""
    subset = of_kind(descent.screening_subset(data), fit)
    for few in (beginning(subset), subset):
        if few.size < data.size:
            there = descent.refine(few, fit.structure, fit, fit.z, options)
            if _lost_by_rubbing(few, there, options) > POLICY.hopeless:
                return False
    return _lost_by_rubbing(data, fit, options) < RISE


def _lost_by_rubbing(data: Experiments, fit: Fit, options: Options) -> float:
    """Return by how much worse a friction that is just not little explains the data [deviance]."""
    little = _little(data)
    z, initials = rubbing(data, fit, little)
    fixed = {**fit.structure.fixed, "vc_plus": little}
    rubs = fit.structure.with_(friction="symmetric", fixed=fixed)
    other = min(
        (solve(data, rubs, fit.at(rubs.complete(z), i), options, 12, known=fit) for i in initials),
        key=lambda f: f.deviance,
    )
    return (other.deviance - fit.deviance) / sandwich_factor(fit)
