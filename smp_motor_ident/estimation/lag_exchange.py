"""Two lags in a row answer alike in either order: which is the motor's, and which the filter's.

From voltage to speed only friction tells, where the motor starts, or turns back.
"""

import math
from collections.abc import Iterator

import numpy as np

from smp_motor_ident.diagnosis.limits import RELEVANT_BIAS
from smp_motor_ident.estimation.candidate_starts import of_kind
from smp_motor_ident.estimation.descent import refine, screening_subset
from smp_motor_ident.estimation.fit import Fit, Options
from smp_motor_ident.estimation.initialisation import beginning
from smp_motor_ident.estimation.prediction import positive_part
from smp_motor_ident.estimation.profile import RISE
from smp_motor_ident.estimation.selection import POLICY, FittedCandidate, sandwich_factor
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.coordinates import LOGARITHMS, Coordinates, lag_share, place
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.model.structures import FirstOrder

# Of the largest voltage: the friction at which a descent begins, and one that is as good as none
RUBS, HARDLY = 0.03, 0.002
_LOGARITHMS = [place(n) for n in LOGARITHMS]


def with_quicker_filter(
    data: Experiments, best: Fit, options: Options, candidates: list[FittedCandidate]
) -> Fit:
    """Return the fit, or one whose filter has a shorter of its lags, if that explains as much."""
    for other in _exchanged_fits(data, best, options):
        verdict, reason = POLICY.preferred(best, other)
        candidates.append(FittedCandidate(other, reason))
        best = other if verdict else best
    return best


def consider_exchange(data: Experiments, fit: Fit, options: Options) -> Fit:
    """Return the fit with its covariance widened by another of its lags that the filter may have.

    How likely that is its deviance tells: in one direction the two differ in nothing.
    """
    others = list(_exchanged_fits(data, fit, options))
    behind = [max(o.deviance - fit.deviance, 0.0) / sandwich_factor(fit) for o in others]
    odds = [math.exp(-0.5 * x) for x in behind]
    for other, one in zip(others, odds, strict=True):
        move = other.z.array - fit.z.array
        # As far as what is stated moves, which is no logarithm.
        move[_LOGARITHMS] = np.expm1(move[_LOGARITHMS])
        share, own = one / (1 + sum(odds)), fit.covariance()
        fit = fit.along(math.sqrt(share) * fit.structure.of_free(move))
        fit = fit.wider(share * positive_part(other.covariance() - own, own))
    return fit


def rubs_behind_filter(data: Experiments, fit: Fit, options: Options) -> bool:
    """Tell whether a motor that rubs explains as much if one of two lags is the speed's filter.

    A filter hides where the motor stands: behind it the score of a linear motor's friction tells
    nothing, nor does that of a motor whose own lag is the filter's.
    """
    s, slow = fit.structure, fit.z.time_constant
    quick = fit.z.second_lag * (s.order == 2) + 0.5 * fit.z.window * s.window
    if s.current or data.quantum > 0 or data.kind == ANGLE or s.has("window") > s.window:
        return False
    if quick < RELEVANT_BIAS.value * slow or slow > np.ptp(data.time):
        return False
    rubs, starts = s.with_(friction="symmetric"), list(exchanged(fit.z, s.order))
    if not s.low_pass:
        rubs = FirstOrder.like(rubs).with_(window=True, low_pass=True)
        either = (quick, slow), (slow, quick)
        starts = [fit.z.with_(ln_a1=fit.z.ln_a0 + math.log(m), window=2 * f) for m, f in either]
    top = float(np.abs(data.hold_value).max())
    part = of_kind(screening_subset(data), fit)
    for few in (of_kind(beginning(part), fit), part):
        known = refine(few, s, fit, fit.z, options)
        left = []
        for z in starts:
            there, begun = few.measured_as(rubs.speed), rubs.complete(z.with_friction(RUBS * top))
            other = refine(there, rubs, known, begun, options, known=known)
            ahead = (known.deviance - other.deviance) / sandwich_factor(known)
            if ahead > RISE or (
                ahead > -(RISE if few is part else POLICY.hopeless)
                and other.z.vc_plus > HARDLY * top
            ):
                left.append(z)
        starts = left
    return bool(starts)


def _exchanged_fits(data: Experiments, fit: Fit, options: Options) -> Iterator[Fit]:
    s = fit.structure
    if s.current or not s.low_pass or "window" not in s.free:
        return
    least = RUBS * float(np.abs(data.hold_value).max())
    for z in exchanged(fit.z, s.order):
        if s.friction == "symmetric" and z.vc_plus < least:  # as the other order hides it
            z = z.with_friction(least)
        yield refine(data, s, fit, s.complete(z), options)


def exchanged(z: Coordinates, order: int) -> Iterator[Coordinates]:
    """Yield the motors of the same response whose filter has another of the lags."""
    filters, total = 0.5 * z.window, z.time_constant
    if order == 1:
        yield z.with_(ln_a1=z.ln_a0 + math.log(filters), window=2 * total)
        return
    share = lag_share(z.ln_a2 + z.ln_a0 - 2 * z.ln_a1)
    lags = total / (1 + share), total * share / (1 + share)
    for kept, given in (lags, lags[::-1]):
        own = z.with_(ln_a1=z.ln_a0 + math.log(kept + filters), window=2 * given)
        yield own.with_second_lag(kept * filters / (kept + filters))
