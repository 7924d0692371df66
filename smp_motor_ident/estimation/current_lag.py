"""A current that its sensor filters: asked for by a score, fitted from several starts.

Left out, the lag of the sensor is taken for that of the winding: L comes out too large.
Derivation: docs/derivations.md, section 12.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np

from smp_motor_ident.diagnosis.limits import COLOURED
from smp_motor_ident.estimation import data_window, descent, prediction
from smp_motor_ident.estimation.candidate_starts import of_kind
from smp_motor_ident.estimation.delay_and_averaging import QUICKER, quicker, with_average
from smp_motor_ident.estimation.fit import Fit, Options, solve
from smp_motor_ident.estimation.selection import POLICY, FittedCandidate, sandwich_factor
from smp_motor_ident.estimation.trials import slower_winding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.structures import SENSORS, Electromechanical, Structure, sensor_of

LITTLE = 0.01  # of a sample: a lag that is as good as none, for the score
BEYOND = 0.6  # of a sample: the mean lag of a window that reaches beyond the last change of voltage
SHARES = (0.3, 0.8)  # of the winding's lag that may be the sensor's
SAMPLES = (0.25, 0.5, 1.5, 5.0)  # of lag at which a descent begins
FEW, KEPT = 4, 2  # passes after which starts are ranked, and how many go on
# What is left of a winding whose lag is the sensor's: samples or a share; passes it is given.
QUICK, LEFT, SETTLED = 0.5, 0.1, 8
RECURS, SURE = 5, 4.0  # samples and deviations by which errors of a right model hardly correlate
DELAYS = (0.3, 1.0)  # samples of delay beside which another sensor is begun


def with_current_lag(
    data: Experiments,
    best: Fit,
    options: Options,
    candidates: list[FittedCandidate],
    say: Callable[[str], None],
    surely: bool = False,
) -> Fit:
    """Return the fit, or one with the lag of the current's sensor where the data ask for it.

    ``surely``: they are known to ask.
    """
    direct = best
    own = direct.structure
    if not isinstance(own, Electromechanical) or own.lags:
        return best
    exchanged, ahead = _exchanged(data, direct, options)
    asked = surely or ahead > 0 or _asked_for(data, direct)
    # What a filter has of the winding's pole is its own, as long as that is not excluded.
    for sensor in SENSORS[1:] if asked else ("smoothed",) if exchanged else ():
        richer = own.with_(current_sensor=sensor)
        if any(r.fit.structure == richer for r in candidates):
            continue
        say(f"trying {richer.label}")
        starts = _leading(data, direct, richer, options) if asked else []
        starts += [best.z] * best.structure.lags + ([exchanged.z] if exchanged else [])
        if own.window and sensor == "averaged":  # what takes the mean of one takes that of both
            starts.append(richer.complete(best.z.with_(current_lag=0.5 * best.z.window)))
        # What looks like torque noise may be this.
        near = [best] if best.noise_ratio == 0 else [best, replace(best, noise_ratio=0.0)]
        tried = [descent.refine(data, richer, n, z, options) for z in starts for n in near]
        other = min(tried, key=lambda f: f.deviance)
        if other.z.current_lag < LITTLE * data.step:  # another minimum, of no lag
            candidates.append(FittedCandidate(other, "no lag of the current shows", whole=False))
            continue
        verdict, reason = POLICY.preferred(best, other)
        if verdict:
            other = data_window.grown(data, other, options)
        candidates.append(FittedCandidate(other, reason))
        best = other if verdict else best
    return best


def with_both_filters(
    data: Experiments,
    first: Fit,
    options: Options,
    candidates: list[FittedCandidate],
    say: Callable[[str], None],
) -> Fit:
    """Return the fit with a lag of the current, a speed that is averaged, or both: as asked for.

    Left out, the one is taken for another shape of the other, so that both orders are tried; and
    both left out may hide each other, so that neither alone is wanted.
    """
    best = with_average(
        data, with_current_lag(data, first, options, candidates, say), options, candidates, say
    )
    lagged = best.structure.has("current_lag")
    if lagged:
        with_average(data, first, options, candidates, say)
    structure = first.structure.with_(window=True)
    mean = next((r.fit for r in candidates if r.fit.structure == structure), first)
    if mean is first:  # which could not be fitted
        return best
    other = with_current_lag(of_kind(data, mean), mean, options, candidates, say, surely=lagged)
    best = other if POLICY.replaces(best, other)[0] else best
    return _with_two_low_passes(data, best, first, options, candidates, say)


def _with_two_low_passes(
    data: Experiments,
    best: Fit,
    first: Fit,
    options: Options,
    candidates: list[FittedCandidate],
    say: Callable[[str], None],
) -> Fit:
    """Return the fit, or where its errors are no noise one with a low-pass of speed and current.

    Each hides the other, and a motor as slow as both together hides them.
    """
    if data.quantum > 0 or not _errors_recur(of_kind(data, best), best):
        return best
    for sensor in SENSORS[1:]:
        richer = first.structure.with_(window=True, low_pass=True, current_sensor=sensor)
        say(f"trying {richer.label}")
        low, near = data.measured_as(richer.speed), replace(best, noise_ratio=0.0)
        tried = []
        for share in QUICKER:  # few passes rank how far the filters reach, not how quick it is
            z = _later(quicker(first.z, share), 0.0)
            starts = [richer.complete(z.with_(current_lag=n * data.step)) for n in SAMPLES[1:]]
            soon = [solve(low, richer, near.at(z), options, FEW) for z in starts]
            soon.sort(key=lambda f: f.deviance)
            tried += [descent.refine(low, richer, near, f.z, options) for f in soon[:KEPT]]
        other = min(tried, key=lambda f: f.deviance)
        verdict, reason = POLICY.replaces(best, other)
        candidates.append(FittedCandidate(other, reason))
        best = other if verdict else best
    return best


def with_other_sensor(
    data: Experiments,
    best: Fit,
    options: Options,
    candidates: list[FittedCandidate],
    say: Callable[[str], None],
) -> Fit:
    """Return the fit, or one whose current is filtered otherwise.

    A delay hides how, and which part of the lags is the sensor's: it is tried together with each
    where residuals are coloured.
    """
    s = best.structure
    if not (isinstance(s, Electromechanical) and s.lags):
        return best
    ways, coloured = [s], sandwich_factor(best) > COLOURED.value
    if s.low_pass:  # of which the likeliest kind has been sought beside this sensor alone
        ways += [s.with_(ticks=ticks, mean=0.0) for ticks in (0, 1) if ticks != s.ticks]
    if not s.delay and "delay" not in s.fixed and coloured:
        ways.append(s.with_(delay=True))
    for way, sensor in product(ways, SENSORS[1:]):
        structure = way.with_(current_sensor=sensor)
        if any(r.fit.structure == structure for r in candidates):
            continue
        say(f"trying {structure.label}")
        known = [r.fit.z for r in candidates if sensor_of(r.fit.structure) == sensor]
        starts = [best.z, *known]
        if structure.delay and not s.delay:
            starts = [_later(z, samples * data.step) for z in starts for samples in DELAYS]
        elif coloured:  # the winding may have what is the sensor's
            starts += _leading(data, best, structure, options)
        tried = [
            descent.refine(data, structure, best, structure.complete(z), options) for z in starts
        ]
        other = min(tried, key=lambda f: f.deviance)
        verdict, reason = POLICY.preferred(best, other)
        candidates.append(FittedCandidate(other, reason))
        best = other if verdict else best
    return best


def _later(z: Coordinates, delay: float) -> Coordinates:
    """Return a motor that answers later by so much less of its winding's lag."""
    te = max(z.electrical_time_constant - delay, LEFT * z.electrical_time_constant)
    return slower_winding(z, float(np.log(te))).with_(delay=delay)


def _errors_recur(data: Experiments, fit: Fit) -> bool:
    """Tell whether what a fit leaves of speed or current is correlated from sample to sample."""
    seen = prediction.simulate(data, fit, gain=True)
    for error in (data.output - seen[:, 1], data.current - seen[:, 2]):
        e = error[np.isfinite(error)]
        if e.size <= RECURS:
            continue
        e = e - e.mean()
        most = SURE * float(e @ e) / e.size**0.5
        if any(abs(float(e[k:] @ e[:-k])) > most for k in range(1, RECURS + 1)):
            return True
    return False


def without_current_lag(
    data: Experiments,
    best: Fit,
    options: Options,
    candidates: list[FittedCandidate],
    say: Callable[[str], None],
) -> Fit:
    """Return the fit, or one whose winding has its lag back: of a speed that was not yet filtered
    as it is, the current's sensor may have taken it.
    """
    s = best.structure
    if not (isinstance(s, Electromechanical) and s.lags and s.window):
        return best
    plain = s.with_(current_sensor="")
    if any(r.fit.structure == plain for r in candidates):
        return best
    say(f"trying {plain.label}")
    te = best.z.electrical_time_constant + best.z.current_lag
    z = plain.complete(slower_winding(best.z, float(np.log(te))))
    other = descent.refine(data.measured_as(plain.speed), plain, best, z, options)
    needed, reason = POLICY.needed(other, best)
    candidates.append(FittedCandidate(other, "" if needed else f"a lag of the current: {reason}"))
    return best if needed else other


def with_lag(fit: Fit, lag: float) -> Fit:
    """Return a fit at another lag of the current's sensor [s]."""
    return replace(fit, z=fit.z.with_(current_lag=lag))


def _asked_for(data: Experiments, direct: Fit) -> bool:
    """Tell from the score of a window whether a fit with a lag is worth its passes.

    A window of next to nothing shows nothing of a winding that has settled when its current is
    read, so the score is taken at one of more than a sample, too.
    """
    if not direct.converged:
        return True
    least, price = _predicted(data, direct, direct.structure), _price(direct)

    def left(sensor: str, lag: float) -> float:
        richer = direct.structure.with_(current_sensor=sensor)
        return _predicted(data, with_lag(direct, lag * data.step), richer)

    trials = (("averaged", LITTLE), ("averaged", BEYOND), ("smoothed", BEYOND))
    return any(not least - left(*trial) < price for trial in trials)


def _price(direct: Fit) -> float:
    return float(np.log(direct.samples)) * sandwich_factor(direct)


def _exchanged(data: Experiments, direct: Fit, options: Options) -> tuple[Fit | None, float]:
    """Return a fit by few passes in which a digital filter has the winding's pole, and its lead.

    Under a held voltage the current steps alike behind either, and no score leads from the one to
    the other.  Both run freely: where the data correct the state, either follows them.  The lead is
    in deviance, beyond the price of the filter's lag; one that is as far behind is excluded.
    """
    te = direct.z.electrical_time_constant
    # Of the same pole: e^(-T/te) = lag / (T + lag).
    lag = float(-data.step * np.exp(-data.step / te) / np.expm1(-data.step / te))
    if not lag > LITTLE * data.step:
        return None, -np.inf
    richer = direct.structure.with_(current_sensor="smoothed")
    free = replace(direct, noise_ratio=0.0)
    starts = [
        richer.complete(slower_winding(direct.z, float(np.log(left))).with_(current_lag=lag))
        for left in (QUICK * data.step, LEFT * te)
    ]
    tried = [solve(data, richer, free.at(z), options, SETTLED) for z in starts]
    other = min(tried, key=lambda f: f.deviance)
    if direct.noise_ratio > 0:
        free = solve(data, direct.structure, free, options, FEW)
    hopeless = POLICY.hopeless * sandwich_factor(direct)
    if not other.converged and other.deviance < free.deviance + hopeless:
        other = solve(data, richer, other, options)  # slowly, while lag and L/R trade
    ahead, price = free.deviance - other.deviance, _price(direct)
    if ahead < -price or not other.z.current_lag > LITTLE * data.step:
        return None, -np.inf
    return other, ahead - price


def _predicted(data: Experiments, fit: Fit, structure: Structure) -> float:
    """Return the sum of squares that a step from here would leave; infinite for no lag."""
    here = prediction.again(data, structure, fit)
    step = prediction.inverse(here.normal) @ here.gradient
    if structure.lags and fit.z.current_lag + step[-1] <= 0:
        return np.inf
    return here.objective - here.local_decrease - float(here.gradient @ step)


def _leading(
    data: Experiments, direct: Fit, richer: Structure, options: Options
) -> list[Coordinates]:
    """Return the starts that are ahead after a few passes: the others cost as much and lose."""

    def soon(z: Coordinates) -> float:
        return solve(data, richer, direct.at(z), options, FEW).deviance

    return sorted(_starts(data, direct, richer), key=soon)[:KEPT]


def _starts(data: Experiments, direct: Fit, richer: Structure) -> list[Coordinates]:
    """Return starts: lags of so many samples, and those that L/R has taken up."""
    te = direct.z.electrical_time_constant
    lags = [(samples * data.step, te) for samples in SAMPLES]
    out = []
    for lag, left in lags + [(share * te, (1 - share) * te) for share in SHARES]:
        z = slower_winding(direct.z, float(np.log(left)))
        out.append(richer.complete(z.with_(current_lag=lag)))
    return out
