"""Outputs that come late: a delay, a speed averaged over a window; each from several starts.

Derivation: docs/derivations.md, section 10.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np

from smp_motor_ident.diagnosis.limits import RELEVANT_BIAS
from smp_motor_ident.estimation import data_window, descent, start
from smp_motor_ident.estimation.fit import Fit, Options
from smp_motor_ident.estimation.initialisation import beginning, first_fit, initial_fit
from smp_motor_ident.estimation.selection import POLICY, FittedCandidate
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.model.structures import FirstOrder, SecondOrder, Structure

HARDLY = 0.01  # of a sample: a window that is as good as none, for the score
WINDOWS = (1.0, 4.0)  # samples at which a low-pass is begun
QUICKER = (0.6, 0.2)  # of a time constant that are the motor's, beside a filter's of its speed
TICKS = (1, 2, 5, 10)  # samples that a digital low-pass takes a row
FEW = 2  # up to which means since the one before are another filter than samples are
WINDING = 0.05  # of a motor's time constant, as which a second lag is begun
NEAR = 0.25  # samples from a whole delay within which its other side is tried
BEYOND = 0.1  # samples from it on the other side, where that is begun
CROSSINGS = 3  # of whole delays at most: a first delay is off by a sample or two
DELAYS = (0.3, 1.5, 3.5)  # samples at which a delay is begun that torque noise may have hidden


def with_delay(data: Experiments, delayed: Structure, options: Options) -> Fit | None:
    """Fit with a delay, and with a whole number of samples of it."""
    first = first_with_delay(data, delayed, options, None)
    return first and settled(data, first, options, None)


def settled(
    data: Experiments, first: Fit, options: Options, near: Fit | None, rival: Fit | None = None
) -> Fit:
    """Carry a first fit on to all data, and to its torque noise."""
    fit = data_window.grow(data, first.structure, first, options, near, rival)
    return snapped(data, fit, options) if first.structure.delay else fit


def first_with_delay(
    data: Experiments, delayed: Structure, options: Options, plain: Fit | None
) -> Fit | None:
    """Fit with a delay, started from several: the surface has a minimum for each sample."""
    structure = delayed.with_(delay=False)
    starts = []
    if plain is not None:
        starts.append(plain.z.with_(delay=0.2 * data.step))
    for lag in (0, 1, 2, 4, 8, 16, 32):
        # The regressions of a lagged input are those of a delayed motor.
        late = max(lag - 0.5, 0.1) * data.step
        starts += [z.with_(delay=late) for z in start.speed_candidates(data, structure.order, lag)]
    return first_fit(data, delayed, options, starts, keep=4, own=False)


def snapped(data: Experiments, fit: Fit, options: Options) -> Fit:
    """Try whole numbers of samples of delay, and what is beyond: the surface has a kink at each.

    A switch of the input that falls on a sampling instant makes the derivative by the delay
    jump; a descent that comes near such a point stays short of it, and so does one whose own
    minimum lies beyond.
    """
    best = fit
    for n in {int(fit.z.delay / data.step), int(fit.z.delay / data.step) + 1}:
        whole = fit.structure.with_(fixed={**fit.structure.fixed, "delay": n * data.step})
        other = descent.refine(data, whole, fit, fit.z, options, known=best)
        if other.deviance < best.deviance - 1:
            best = descent.restate(data, fit.structure, other, options)
    for _ in range(CROSSINGS):
        samples = best.z.delay / data.step
        kink = round(samples)
        across = kink + math.copysign(BEYOND, kink - samples)
        if abs(samples - kink) > NEAR or across < 0:
            break
        z = best.z.with_(delay=across * data.step)
        other = descent.refine(data, fit.structure, best, z, options, known=best)
        if other.deviance > best.deviance - 1:
            break
        best = other
    return best


def first_with_averaging(
    data: Experiments, structure: Structure, options: Options, twin: Fit | None
) -> Fit | None:
    """Fit a speed averaged over a window, started from what looked like a delay."""
    if twin is None:
        return None
    lag = max(twin.z.delay + 0.5 * twin.z.window, 0.5 * data.step)
    starts = [twin.z.with_second_lag(0.1 * lag)] if twin.structure.window else []
    for width in (0.5, 1.0, 1.6) if structure.delay else (1.0, 2.0, 3.0):
        window = max(width * lag, 1.01 * data.step)
        delay = max(lag - 0.5 * window, 0.1 * data.step) if structure.delay else 0.0
        z = twin.z.with_(window=window, delay=delay)
        further = structure.order == 2 and twin.structure.order == 1
        starts.append(z.with_second_lag(0.3 * lag) if further else z)
    own = structure.order == 2 and not structure.delay
    return first_fit(data.measured_as(structure.speed), structure, options, starts, keep=3, own=own)


def with_average(
    data: Experiments,
    best: Fit,
    options: Options,
    candidates: list[FittedCandidate],
    say: Callable[[str], None],
) -> Fit:
    """Try a speed averaged over a window of a sample or more, current being measured.

    A speed that was taken for what it is at its stamp may have made the fit give the current up:
    the regressions begin anew.
    """
    structure = best.structure.with_(window=True)
    say(f"trying {structure.label}")
    starts = [best.z.with_(window=width * data.step) for width in (1.02, 2.0, 4.0)]
    fitted = initial_fit(data.measured_as(structure.speed), structure, options, starts)
    if fitted is None:
        return best
    verdict, reason = POLICY.preferred(best, fitted)
    candidates.append(FittedCandidate(fitted, reason))
    return fitted if verdict else best


def with_low_pass(
    data: Experiments,
    best: Fit,
    options: Options,
    candidates: list[FittedCandidate],
    say: Callable[[str], None],
) -> Fit:
    """Return the fit, or one whose speed is low-passed where the data ask for that.

    Where nothing rubs and no current is measured, a low-pass is a second lag like any.
    """
    near = _likelier_mean(best, candidates)
    s = near.structure
    apart = s.current or (s.order == 2 and s.friction != "none")
    if data.kind == ANGLE or data.quantum > 0 or s.has("window") > s.window or s.low_pass:
        return best
    richer = s.with_(window=True, low_pass=True)
    low = data.measured_as(richer.speed)
    if not s.window:
        # To first order a low-passed speed is a late one, whose score is known by now.
        late = s.with_(delay="delay" not in s.fixed)
        if late != s and not POLICY.worth_a_fit(data, near, late):
            return best
        hardly = replace(near, z=near.z.with_(window=HARDLY * data.step))
        if not apart or not POLICY.worth_a_fit(low, hardly, richer):
            return best
    say(f"trying {richer.label}")
    starts = [near.z] if s.window else [near.z.with_(window=n * data.step) for n in WINDOWS]
    if s.order == 2 and not s.window and not s.current:
        lag = near.z.second_lag
        starts.append(near.z.with_second_lag(0.2 * lag).with_(window=1.6 * lag))
    elif s.current:  # which tells how fast the motor is, however slow the filter
        starts += [quicker(near.z, share) for share in QUICKER]
    tried = [_filtered(low, richer, near, z, options) for z in starts]
    other = min(tried, key=lambda f: f.deviance)
    verdict, reason = POLICY.preferred(best, other)
    if verdict:
        other = data_window.grown(low, other, options)
    candidates.append(FittedCandidate(other, reason))
    if not verdict:
        return best
    simple = _without_second_lag(low, other, options) if s.order == 2 and not s.current else None
    if simple is None or POLICY.needed(simple, other)[0]:
        return other
    candidates.append(FittedCandidate(simple, f"as good as {other.structure.label}"))
    return simple


def with_digital_filter(
    data: Experiments,
    best: Fit,
    options: Options,
    candidates: list[FittedCandidate],
    say: Callable[[str], None],
) -> Fit:
    """Return the fit, or one whose speed is smoothed sample by sample where that explains more.

    It spreads an impulse further than a continuous one that is as late, which else would be missing
    from L/R, or stand for a current that comes late.
    """
    s = best.structure
    if not (s.window and s.low_pass):
        return best
    ways = [way for way in product(TICKS, (False, True)) if way[0] <= FEW or not way[1]]
    near = None
    while near is not best:  # from a better one others go on that had ended elsewhere
        near = best
        for ticks, means in ways:
            structure = s.with_(ticks=ticks, mean=data.step / ticks * means)
            if structure == best.structure:
                continue
            say(f"trying {structure.label}")
            tried = _filtered(data, structure, best, best.z, options)
            verdict, reason = POLICY.preferred(best, tried)
            candidates.append(FittedCandidate(tried, reason))
            best = tried if verdict else best
    return best


def with_late_speed(
    data: Experiments,
    best: Fit,
    options: Options,
    candidates: list[FittedCandidate],
    say: Callable[[str], None],
) -> Fit:
    """Return the fit, or one whose speed is late as it is, where its current is not.

    To first order it is the mean over a window, or the low-pass, that stands for it.
    """
    s = best.structure
    if not s.current or "window" not in s.free or data.quantum > 0:
        return best
    structure = s.with_(late=True, low_pass=False, ticks=0, mean=0.0)
    say(f"trying {structure.label}")
    other = _filtered(data, structure, best, best.z, options)
    verdict, reason = POLICY.preferred(best, other)
    candidates.append(FittedCandidate(other, reason))
    return other if verdict else best


def as_averaged(
    data: Experiments,
    best: Fit,
    options: Options,
    candidates: list[FittedCandidate],
    say: Callable[[str], None],
) -> Fit:
    """Return the fit of a late speed, or one of a mean over a row whose command is late."""
    if not best.structure.late or "delay" in best.structure.fixed:
        return best
    structure = best.structure.with_(late=False, delay=True)
    say(f"trying {structure.label}")
    late = max(best.z.delay + 0.5 * (best.z.window - data.step), 0.0)
    other = _filtered(data, structure, best, best.z.with_(window=data.step, delay=late), options)
    verdict, reason = POLICY.preferred(best, other)
    candidates.append(FittedCandidate(other, reason))
    return other if verdict else best


def with_filter_for_lag(
    data: Experiments,
    best: Fit,
    options: Options,
    candidates: list[FittedCandidate],
    say: Callable[[str], None],
) -> Fit:
    """Return the fit, or one of whose two lags either is the filter's of the speed.

    From voltage to speed they answer the same, but where the motor rubs and turns back.  A filter
    slower than the motor is another minimum, of which no score of a short one says anything.
    """
    s, slow = best.structure, best.z.time_constant
    quick = best.z.second_lag * (s.order == 2) + 0.5 * best.z.window * s.window
    rubs = s.friction != "none" and not s.current and data.quantum == 0 and data.kind != ANGLE
    if not rubs or s.has("window") > s.window or quick < RELEVANT_BIAS.value * slow:
        return best
    if slow > np.ptp(data.time):  # an angle, which is never steady
        return best
    lags = {"window": True, "low_pass": True}
    first, second = FirstOrder.like(s).with_(**lags), SecondOrder.like(s).with_(**lags)
    say(f"trying {first.label}")
    part = descent.screening_subset(data)
    few = beginning(part)
    soon = best if few is data else descent.refine(few, s, best, best.z, options)
    there = best if part is data else soon if few is part else None
    for motor, lag in ((quick, slow), (slow, quick)):
        z = best.z.with_(ln_a1=best.z.ln_a0 + math.log(motor), window=2 * lag)
        for structure in (first, second):
            tried = _filtered(few, structure, soon, z, options, soon)
            far = POLICY.rejects_on_subset(tried, soon.deviance)
            if few is not part and not far:
                there = there or descent.refine(part, s, best, best.z, options)
                tried = _filtered(part, structure, there, z, options)
            z = tried.z.with_second_lag(WINDING * tried.z.time_constant)
            if far or there is None or tried.deviance > there.deviance:
                continue  # all of the data decide where a part leaves it open
            there = tried
            if part is not data:
                tried = _filtered(data, structure, best, tried.z, options)
            verdict, reason = POLICY.preferred(best, tried)
            candidates.append(FittedCandidate(tried, reason))
            best = tried if verdict else best
    return best


def _filtered(
    data: Experiments,
    structure: Structure,
    near: Fit,
    z: Coordinates,
    options: Options,
    known: Fit | None = None,
) -> Fit:
    """Fit a low-passed speed from another's answer on the same data."""
    data = data.measured_as(structure.speed)
    return descent.refine(data, structure, near, structure.complete(z), options, known=known)


def quicker(z: Coordinates, share: float) -> Coordinates:
    """Return a motor with a share of the time constant, whose rest is the filter's of the speed."""
    less, rest = math.log(share), (1 - share) * z.time_constant
    return z.with_(ln_a1=z.ln_a1 + less, ln_a2=z.ln_a2 + less, window=2 * rest)


def _likelier_mean(best: Fit, candidates: list[FittedCandidate]) -> Fit:
    """Return a fit of a mean speed that is likelier than the choice by far, or the choice.

    Where the filter is no mean, errors hang together, and what else is there seems not needed.
    """
    means = [r.fit for r in candidates if r.whole and r.fit.structure.window]
    likeliest = min(means, key=lambda f: f.deviance, default=best)
    more = likeliest.structure.size - best.structure.size
    gained = best.deviance - likeliest.deviance
    return likeliest if gained > POLICY.price(max(more, 1), best.samples) else best


def _without_second_lag(data: Experiments, fit: Fit, options: Options) -> Fit:
    """Return a fit of one lag less: what the sensor has may have been the motor's second."""
    simple = FirstOrder.like(fit.structure)
    z = fit.z.with_(delay=(fit.z.delay + fit.z.second_lag) * simple.delay)
    return descent.refine(data, simple, fit, simple.complete(z), options)


def delay_without_noise(data: Experiments, best: Fit, options: Options) -> Fit | None:
    """Return a fit with the delay in whose place the torque noise of another stands, if any.

    Torque noise flattens the score of what it has taken the place of: there only fits that begin
    without it tell.
    """
    if not best.noise_ratio > 0:
        return None
    noiseless = replace(best, noise_ratio=0.0)
    plain = descent.refine(data, best.structure, noiseless, best.z, options)
    richer = best.structure.with_(delay=True)
    late = [
        descent.refine(data, richer, plain, plain.z.with_(delay=samples * data.step), options)
        for samples in DELAYS
    ]
    other = min(late, key=lambda f: f.deviance)
    preferred, _ = POLICY.preferred(plain, other)
    return data_window.grow(data, richer, other, options) if preferred else None
