"""Order selection: the simplest candidate structure that the data do not reject, with reasons."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from smp_motor_ident.diagnosis.limits import COLOURED
from smp_motor_ident.estimation import data_window, descent
from smp_motor_ident.estimation.candidate_starts import (
    from_richer,
    from_rivals,
    no_worse,
    of_kind,
    under_load,
)
from smp_motor_ident.estimation.current_lag import with_both_filters, with_current_lag
from smp_motor_ident.estimation.delay_and_averaging import (
    first_with_averaging,
    first_with_delay,
    settled,
    with_delay,
)
from smp_motor_ident.estimation.fit import Fit, Options, solve
from smp_motor_ident.estimation.initialisation import beginning, first_fit, initial_fit, ranked_on
from smp_motor_ident.estimation.memory import remembered
from smp_motor_ident.estimation.selection import POLICY, FittedCandidate, sandwich_factor
from smp_motor_ident.estimation.thinning import thinned
from smp_motor_ident.estimation.trials import LAGS, RANDOM, slower_winding
from smp_motor_ident.estimation.trials import tried as other_starts
from smp_motor_ident.estimation.variations import friction_shows, may_rub, varied
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.measurement import ANGLE, SPEED
from smp_motor_ident.model.structures import FirstOrder, SecondOrder, Structure
from smp_motor_ident.result import NORMAL_95

Say = Callable[[str], None]

NOISE = 5  # passes in which a fit shows what it explains under another torque noise


def explore(
    data: Experiments,
    base: Structure,
    options: Options,
    auto: bool,
    say: Say,
    first: Fit | None = None,
) -> list[FittedCandidate]:
    """Fit the candidates that come into question; the last one is the choice."""
    smooth = _frictionless(data, base, options, auto, say)
    if smooth:
        return smooth
    candidates: list[FittedCandidate] = []
    if base.current or not auto:
        if first is None or first.structure != base:
            first = _initial_fit(data, base, options, say)
        if first is None:
            return []
        candidates.append(
            FittedCandidate(first, "asked for" if not auto else "current is measured")
        )
        if auto and data.kind == SPEED:
            best = with_both_filters(data, first, options, candidates, say)
        else:
            best = with_current_lag(data, first, options, candidates, say)
    else:
        if (found := _orders(data, base, options, say, candidates)) is None:
            return []
        best = found
    best = varied(data, best, options, candidates, say)
    best = _orders_again(data, best, options, candidates, say)
    reason = next((r.reason for r in candidates if r.fit is best), "")
    return [r for r in candidates if r.fit is not best] + [FittedCandidate(best, reason)]


def _initial_fit(data: Experiments, s: Structure, options: Options, say: Say) -> Fit | None:
    say(f"fitting {s.label}")
    if s.delay:
        return with_delay(data, s, options)
    return initial_fit(data, s, options)


def _frictionless(
    data: Experiments, base: Structure, options: Options, auto: bool, say: Say
) -> list[FittedCandidate]:
    """Climb without friction where the score of a linear motor asks for none.

    Where there is none, a descent with friction has no bottom to find: L/R beside the
    response's own coefficients is identifiable by friction alone.  The score is believed where
    nothing else is left, which torque noise or coloured residuals are.
    """
    if base.current or base.friction != "symmetric" or options.priors or data.quantum > 0:
        return []
    plain = base.frictionless()
    subset = descent.screening_subset(data)
    quick = initial_fit(subset, plain, options)
    if quick is None or not quick.converged or quick.noise_ratio > 0:
        return []
    if sandwich_factor(quick) > COLOURED.value or friction_shows(subset, quick, False):
        return []
    candidates = explore(data, plain, options, auto, say, quick if subset is data else None)
    if not candidates or may_rub(of_kind(data, candidates[-1].fit), candidates[-1].fit, options):
        return []
    reason = f"{candidates[-1].reason}; no Coulomb friction shows"
    return [*candidates[:-1], FittedCandidate(candidates[-1].fit, reason)]


def _orders(
    data: Experiments,
    base: Structure,
    options: Options,
    say: Say,
    candidates: list[FittedCandidate],
) -> Fit | None:
    """Climb, by the number of parameters, as far as the data ask.

    Candidates that come late are not fitted to a long record that shows no lag beside the motor's.
    """
    part = descent.screening_subset(thinned(data))
    structures = _structures(base, data.kind == SPEED, data.quantum > 0)
    if part is not data and data.kind == SPEED and data.quantum == 0:
        plain = [s for s in structures if not (s.delay or s.window)]
        firsts = _first_fits(part, plain, options, say)
        likeliest = min(firsts, key=lambda f: f.deviance, default=None)
        if likeliest and _enough(part, _settled(part, likeliest, options)):
            found: list[FittedCandidate] = []
            fit = _climbed(data, part, firsts, options, found)
            if fit and _enough(data, fit):
                candidates += found
                return fit
    return _climbed(data, part, _first_fits(part, structures, options, say), options, candidates)


def _settled(part: Experiments, first: Fit, options: Options) -> Fit:
    """Return a first fit carried on to the screening subset."""
    question = (first, options)
    return remembered(part, "settled", 1, question, lambda: settled(part, first, options, None))


def _enough(data: Experiments, fit: Fit) -> bool:
    """Tell whether residuals are white and the score of a delay, which any lag has, is none."""
    s = fit.structure
    if s.delay or s.window or "delay" in s.fixed or not fit.converged or fit.noise_ratio > 0:
        return False
    white = sandwich_factor(fit) <= COLOURED.value
    return white and not POLICY.worth_a_fit(data, fit, s.with_(delay=True))


def _climbed(
    data: Experiments,
    part: Experiments,
    tried: list[Fit],
    options: Options,
    candidates: list[FittedCandidate],
) -> Fit | None:
    """Climb from first fits.

    Candidates that the screening subset rejects by far are not fitted to all of a long record.
    """
    # Of a short record torque noise may stand for a load that is not asked for yet.
    if part is not data or data.kind == SPEED:
        tried = _left(data, part, _under_one_noise(part, tried, options), candidates)
    alone = _alone(data, part, tried, options, candidates) if part is not data else None
    if alone is not None:
        return alone
    tried = _on_subset(part, tried, options)
    if part is not data:
        tried = _left(data, part, tried, candidates)
    best: Fit | None = None
    on_part: Fit | None = None  # the best, as it was there
    for there in tried:
        fitted = there
        if part is not data:
            if best and on_part and not POLICY.more_shows(data, best, on_part, there):
                candidates.append(_no_better(data, part, best, on_part, there))
                continue
            fitted = _on_all(data, there, [r.fit for r in candidates if r.whole], options)
        if best is None:
            better, reason = True, "the simplest left" if candidates else "the simplest"
        else:
            better, reason = POLICY.preferred(best, fitted)
        candidates.append(FittedCandidate(fitted, reason))
        best, on_part = (fitted, there) if better else (best, on_part)
    return best and POLICY.simplest_left(next(r for r in candidates if r.fit is best), candidates)


def _alone(
    data: Experiments,
    part: Experiments,
    firsts: list[Fit],
    options: Options,
    candidates: list[FittedCandidate],
) -> Fit | None:
    """Return the simplest candidate left where neither the beginning nor any score asks for more.

    Of an angle torque noise may stand for what is missing, and tells no score of it.
    """
    if not firsts or data.kind != SPEED:
        return None
    simple, *others = firsts
    price = POLICY.price(1, simple.samples)
    if any(simple.deviance - r.deviance > price for r in others):
        return None
    fit = _on_all(data, _settled(part, simple, options), [], options)
    if not fit.converged or any(POLICY.more_shows(data, fit, simple, r) for r in others):
        return None
    candidates += [_no_better(data, part, fit, simple, r) for r in others]
    candidates.append(FittedCandidate(fit, "the simplest left"))
    return fit


def _no_better(
    data: Experiments, part: Experiments, best: Fit, on_part: Fit, rich: Fit
) -> FittedCandidate:
    """Return a richer candidate that neither a part of the data nor the score of all asks for."""
    reason = f"no better than {best.structure.label} by its score"
    return _rejected(data, part, rich, reason, best.deviance - (on_part.deviance - rich.deviance))


def _first_fits(
    part: Experiments, structures: list[Structure], options: Options, say: Say
) -> list[Fit]:
    """Fit candidates to the beginning of the screening subset."""
    tried: list[Fit] = []
    part = beginning(part)
    for structure in structures:
        say(f"fitting {structure.label}")
        fitted = _first(part, structure, options, tried)
        tried += [fitted] if fitted is not None else []
    return tried


def _under_one_noise(part: Experiments, tried: list[Fit], options: Options) -> list[Fit]:
    """Return first fits, those far behind under the torque noise of the likeliest if that is more.

    Each believes in as much as its own motor's bandwidth asks for, and a wrong one's may be any.
    """
    out = []
    for fit in tried:
        best = min(tried, key=lambda f: f.deviance)
        less = fit.noise_ratio < best.noise_ratio
        if part.kind == ANGLE and less and POLICY.rejects_on_subset(fit, best.deviance):
            start = fit.at(fit.z, noise_ratio=best.noise_ratio)
            there = ranked_on(of_kind(beginning(part), fit))
            again = solve(there, fit.structure, start, options, NOISE)
            fit = min(fit, again, key=lambda f: f.deviance)
        out.append(fit)
    return out


def _left(
    data: Experiments, part: Experiments, tried: list[Fit], candidates: list[FittedCandidate]
) -> list[Fit]:
    """Return the fits that the samples so far do not reject by far; note the others."""
    least = min((f.deviance for f in tried), default=0.0)
    left = []
    for fit in tried:
        if POLICY.rejects_on_subset(fit, least):
            reason = f"rejected on {fit.samples} samples"
            projected = fit.deviance * data.size / fit.samples
            candidates.append(_rejected(data, part, fit, reason, projected))
        else:
            left.append(fit)
    return left


def _on_subset(part: Experiments, firsts: list[Fit], options: Options) -> list[Fit]:
    """Fit candidates to the screening subset, each started from the others' answers too."""
    tried: list[Fit] = []
    rival = min(firsts, key=lambda f: f.deviance, default=None)
    for first in firsts:
        there = of_kind(part, first)
        fitted = settled(there, first, options, _near(first.structure, tried), rival)
        tried.append(no_worse(there, other_starts(there, fitted, LAGS, options), tried, options))
    return from_rivals(part, from_richer(part, tried, options), options)


def _near(structure: Structure, known: list[Fit]) -> Fit | None:
    """Return the fit whose torque noise a candidate is likely to have."""
    if structure.window:
        return None
    if structure.delay:
        return _find(known, structure.with_(delay=False))
    return min(known, key=lambda f: f.deviance, default=None)


def _on_all(data: Experiments, fit: Fit, known: list[Fit], options: Options) -> Fit:
    """Carry a fit of the screening subset on to all data."""
    every = of_kind(data, fit)
    starts, few = [fit], thinned(every)
    if few is not every:
        # Thinning hides a short winding, and leaves an error of its own that looks like noise.
        starts += [replace(fit, noise_ratio=0.0)] * (fit.noise_ratio > 0)
        if fit.structure.order == 2 and _may_hide(fit, few.step):
            z = slower_winding(fit.z, float(np.log(0.5 * data.step)))
            starts.append(replace(fit, noise_ratio=0.0, z=fit.structure.complete(z)))
    best = data_window.extend(every, fit.structure, starts[0], options)
    for start in starts[1:]:
        other = data_window.extend(every, fit.structure, start, options, best)
        best = min(best, other, key=lambda f: f.deviance)
    fit = data_window.quieted(every, best, options)
    fit = other_starts(every, fit, RANDOM, options)
    return no_worse(every, fit, known, options)


def _may_hide(fit: Fit, step: float) -> bool:
    """Tell whether a second lag may be shorter than the intervals at which it was looked at."""
    free = fit.structure.free
    if "ln_a2" not in free:
        return True
    i = free.index("ln_a2")
    shortest = np.log(fit.z.second_lag) - NORMAL_95 * np.sqrt(fit.covariance()[i, i])
    return bool(shortest < np.log(step))


def _rejected(
    data: Experiments, part: Experiments, fit: Fit, reason: str, deviance: float
) -> FittedCandidate:
    """Return a fit of a part as one of all data, of which the deviance is what it would be."""
    initial = descent.initial_of(data, fit)
    fit = replace(fit, initial=initial, deviance=deviance, samples=data.size)
    return FittedCandidate(fit, reason, whole=False, on=part)


def _structures(base: Structure, speed: bool, coarse: bool) -> list[Structure]:
    """Return the candidate structures by number of parameters.

    A speed that comes in coarse steps is a difference of counts, a mean over a window by its
    making: a second time constant is asked for beside that window, not in its place.
    """
    first = FirstOrder.like(base)
    second = SecondOrder.like(base, shape=True)
    late, late2 = first.with_(delay=True), second.with_(delay=True)
    candidates: list[Structure]
    if not speed:
        candidates = [first, late, second, late2]
    elif coarse:
        candidates = [first, late, first.with_(window=True), late.with_(window=True)]
        candidates += [second.with_(window=True), late2.with_(window=True)]
    else:
        candidates = [first, late, first.with_(window=True), second, late.with_(window=True)]
        candidates += [second.with_(window=True), late2]
    return [r for r in candidates if not (r.delay and "delay" in base.fixed)]


def _first(
    data: Experiments, structure: Structure, options: Options, known: list[Fit]
) -> Fit | None:
    """Fit one candidate first, started from what the simpler ones found."""
    if structure.window:
        late = FirstOrder.like(structure, delay=True)
        twin = _find(known, late) or _find(known, late.with_(window=False))
        if twin is None or structure.order == 1:
            twin = _find(known, structure.with_(window=False, delay=True))
        return first_with_averaging(data, structure, options, twin)
    if structure.delay:
        plain = _find(known, structure.with_(delay=False))
        return first_with_delay(data, structure, options, plain)
    extra = []
    if structure.order == 2 and known:
        z = min(known, key=lambda f: f.deviance).z
        late_by = max(z.delay + z.window, 0.05 * z.time_constant)
        extra = [z.with_second_lag(late_by).with_(delay=0.0)]
    return first_fit(data, structure, options, extra)


def _find(known: list[Fit], structure: Structure) -> Fit | None:
    return next((f for f in known if f.structure == structure), None)


def _orders_again(
    data: Experiments, best: Fit, options: Options, candidates: list[FittedCandidate], say: Say
) -> Fit:
    """Hold the other orders against the choice once more, with the load that was found since.

    A load that is left out hides what tells them apart.
    """
    s = best.structure
    if s.current or not s.load:
        return best
    for known in [r.fit for r in candidates if r.whole and not r.fit.structure.load]:
        structure = known.structure.with_(load=True, friction=s.friction)
        if any(r.fit.structure == structure for r in candidates):
            continue
        say(f"trying {structure.label}")
        there = of_kind(data, known)
        start = replace(known, noise=best.noise, noise_ratio=best.noise_ratio)
        fits = [
            descent.refine(there, structure, start, z, options) for z in under_load(known, best)
        ]
        other = no_worse(there, min(fits, key=lambda f: f.deviance), [best], options)
        better, reason = POLICY.replaces(best, other)
        if better:
            other = data_window.grown(there, other, options)
        candidates.append(FittedCandidate(other, reason))
        best, s = (other, structure) if better else (best, s)
    return best
