"""Two lags in a row answer alike in either order: which is the motor's, and which the filter's.

From voltage to speed only friction tells, where the motor starts, or turns back.
"""

import math
from collections.abc import Iterator

import numpy as np

from smp_motor_ident.estimation.descent import refine
from smp_motor_ident.estimation.fit import Fit, Options
from smp_motor_ident.estimation.selection import POLICY, FittedCandidate, sandwich_factor
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.coordinates import LOGARITHMS, Coordinates, lag_share, place

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
        fit = fit.along(math.sqrt(one / (1 + sum(odds))) * fit.structure.of_free(move))
    return fit


def _exchanged_fits(data: Experiments, fit: Fit, options: Options) -> Iterator[Fit]:
    s = fit.structure
    if s.current or not s.low_pass or "window" not in s.free:
        return
    for z in exchanged(fit.z, s.order):
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
