"""Consider covariance: the uncertainty of what is fixed though not known exactly, handed on.

A delay, a load or a friction that the model leaves out is not known to be nothing.  The
estimate's answer to it, ``G = N^-1 N_beside``, carries its variance to all that is reported.
Order selection leaves out what is there, too, where it is not worth its price: of an addition
that the score puts at c with variance V, ``c^2 - V`` estimates the square of what is left out.
Derivation: docs/derivations.md, section 9; Leeb and Poetscher, Econometric Theory 21 (2005), 21
(intervals after a selection).
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import erfcx

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.limits import WINDING_LAG
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.current_lag import LITTLE, with_lag
from smp_motor_ident.estimation.descent import ROUGHLY, refine
from smp_motor_ident.estimation.fit import Fit, Options
from smp_motor_ident.estimation.lag_exchange import consider_exchange
from smp_motor_ident.estimation.selection import POLICY, sandwich_factor
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.coordinates import RINGS, Coordinates, direction, lag_share
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.model.physical import physical_gradients
from smp_motor_ident.model.structures import Electromechanical, FirstOrder, SecondOrder, Structure
from smp_motor_ident.result import NORMAL_95

POINTS = 64  # at which a lag may be
SECOND_LAGS = (0.003, 0.03, 0.1, 0.3, 1.0)  # of the delay that may stand for them
FAR = 1e3  # deviations beyond which what is left of a normal variable is exponential
LARGEST = 1e100  # of which the square is a number
SEEN, ROUNDING = 1e-6, 1e-11
"""Shares of a coordinate's information below which kinks, or rounding, decide what is left."""


def asks_for_earlier(data: Experiments, fit: Fit) -> bool:
    """Tell whether the score asks for a delay below none, by more than what one costs."""
    s = fit.structure
    if s.delay or "delay" in s.fixed or not s.free:
        return False
    beside = _beside(data, fit, s.with_(delay=True), "delay")
    price = POLICY.price(1, fit.samples) * sandwich_factor(fit)
    return beside.seen and beside.size < 0 and beside.size**2 > price * beside.variance


def latest(data: Experiments, fit: Fit, late: float) -> tuple[Structure, Coordinates] | None:
    """Return the motor with the longest delay that the data leave open, where the fit has none.

    Whatever else makes a motor late is shorter then, by as much as the score says.  Where nobody
    can tell, a driver takes up a command within a sample.  ``late``: what commands may be late on
    average [s] that scatter, of which the score says nothing.
    """
    s = fit.structure
    if s.delay or "delay" in s.fixed or not s.free:
        return None
    richer = s.with_(delay=True)
    beside = _beside(data, fit, richer, "delay")
    loose = NORMAL_95 * math.sqrt(sandwich_factor(fit) * beside.variance)
    delay = max(beside.size, 0.0) + min(loose, data.step)
    delay = max(min(delay, _room(s, "delay", beside.answer)), late)
    z = fit.z.moved(s.matrix @ (-delay * beside.answer))
    return richer, z.with_(delay=delay, window=max(z.window, 0.0))


def consider_timing(data: Experiments, fit: Fit, instant: float) -> Fit:
    """Return the fit with its covariance widened by what the input's instants leave open."""
    structure = fit.structure
    if instant <= 0 or structure.delay or "delay" in structure.fixed or not structure.free:
        return fit
    beside = _beside(data, fit, structure.with_(delay=True), "delay")
    return fit.wider(beside.covariance(instant**2))


def consider_late(data: Experiments, fit: Fit, late: float) -> Fit:
    """Return the fit with its covariance widened by a delay [s] beside that which was fitted."""
    structure = fit.structure
    if "delay" not in structure.free:
        return consider_timing(data, fit, late)
    answer = _beside(data, fit, structure, "delay").answer
    row = np.insert(answer, structure.free.index("delay"), 1.0)
    return fit.along(late * row)


def consider_hold(data: Experiments, fit: Fit) -> Fit:
    """Return the fit with its covariance widened by how a command ran that seems interpolated.

    Its deviance alone tells that, of which a misfit has as much: a command that was held is half a
    row ahead, in place of which a second lag is longer by anything up to that.
    """
    s = fit.structure
    lags = [n for n in ("ln_a2", "ln_te") if n in s.free]
    if s.held != "interpolated" or not lags:
        return fit
    longer = 0.5 * data.step / np.sqrt(3.0) / fit.z.second_lag
    return fit.along(s.of_free(direction(**dict.fromkeys(lags, longer))))


def consider_current_lag(fit: Fit) -> Fit:
    """Return the fit with its covariance widened by a lag of the current that is not its own.

    What is late in the current is L/R, or its sensor's: where more of that shows than the model
    has, nothing is known of the winding's but its size.
    """
    return fit.along(fit.structure.of_free(direction(ln_a2=1.0, ln_te=1.0)))


def consider_filter(data: Experiments, fit: Fit, options: Options) -> Fit:
    """Return the fit with its covariance widened by a filter of the speed for its second lag.

    From voltage to speed the two answer the same, but where the motor rubs and turns back: how
    likely a filter then is, its deviance tells.  The motor's lag is without it the first alone.
    """
    s = fit.structure
    if s.low_pass:
        return consider_exchange(data, fit, options)
    if s.order != 2 or s.current or data.kind == ANGLE:
        return fit
    ratio, spread = fit.log_ratio()
    if ratio - NORMAL_95 * spread > RINGS:  # which no two lags do
        return fit
    longer = math.log1p(lag_share(ratio))
    odds = 1.0
    if s.friction != "none" and not data.one_way:
        late = "delay" not in s.fixed  # as is what is left of L/R beside a filter
        z = fit.z.with_(ln_a1=fit.z.ln_a1 - longer, window=2 * fit.z.second_lag)
        least = math.inf
        rubs = FirstOrder.like(s).with_(window=True, low_pass=True, delay=late)
        # A continuous filter, one of samples, and one of differences from row to row.
        for ticks, mean in ((0, 0.0), (1, 0.0), (1, data.step)):
            filtered = rubs.with_(ticks=ticks, mean=mean)
            there = data.measured_as(filtered.speed)
            other = refine(there, filtered, fit, filtered.complete(z), options)
            least = min(least, other.deviance)
        # The shape of stick and slip is a number that no choice has been charged for.
        price = POLICY.price(1, fit.samples) * ("ln_te" in s.free)
        odds = math.exp(-0.5 * max(least - fit.deviance - price, 0.0) / sandwich_factor(fit))
    row = s.of_free(direction(ln_a1=-longer, ln_a2=-1.0, ln_te=-1.0))
    return fit.along(math.sqrt(odds / (1 + odds)) * row)


def consider_clock(data: Experiments, fit: Fit, share: float) -> Fit:
    """Return the fit with its covariance widened by a clock that is known to a share only.

    Under another interval an angle's speed, and every time, is another; voltages are not.
    """
    if share <= 0 or not fit.structure.free:
        return fit
    n = data.kind.integrals
    powers = direction(
        ln_a0=n, ln_a1=1 + n, ln_a2=2 + n, ln_te=1.0,
        delay=fit.z.delay, window=fit.z.window, current_lag=fit.z.current_lag,
    )  # fmt: skip
    return fit.along(share * fit.structure.of_free(powers))


def consider_drop(data: Experiments, fit: Fit) -> Fit:
    """Return the fit with its covariance widened by what a current's offset may be instead.

    Where the motor turns one way only, a driver's drop of ``R offset`` looks the same, and
    friction is then that much more or less.
    """
    s = fit.structure
    one_way = not data.hold_value.min() < 0 < data.hold_value.max()
    if not (one_way and isinstance(s, Electromechanical) and s.offset and "vc_plus" in s.free):
        return fit
    drop = float(np.exp(fit.z.ln_r) * fit.z.current_offset)
    return fit.along(s.of_free(direction(vc_plus=drop, vc_minus=drop)))


def consider_bound(free: Fit, bound: Fit) -> Fit:
    """Return a fit whose viscous friction is held at zero, widened by what that may be above it.

    ``free`` is the same fit without the bound, where it may be negative.  A profile of friction
    ends where viscous friction is none, and needs no more.
    """
    followed = any(p.coordinate == "vc_plus" for p in bound.profiles)
    if bound is free or not free.structure.current or followed:
        return bound
    value, row = physical_gradients(free.z)["viscous_friction"]
    if value >= 0:
        return bound
    row = row @ free.structure.matrix
    covariance = free.conditional()
    variance = float(row @ covariance @ row)
    if not 0 < variance < math.inf:
        return bound
    size = above_zero(value, math.sqrt(variance))
    return bound.along(size / variance * (covariance @ row))


def above_zero(value: float, deviation: float) -> float:
    """Return the root mean square of what is known as a normal variable, and to be positive.

    Of ``N(value, deviation^2)`` above zero: ``E x^2 = deviation^2 + value E x``.
    """
    below = -value / deviation
    if below > FAR:
        return math.sqrt(2) * deviation / below
    mean = deviation * (math.sqrt(2 / math.pi) / float(erfcx(below / math.sqrt(2))) - below)
    return math.sqrt(deviation**2 + value * mean)


def consider_friction(data: Experiments, fit: Fit) -> tuple[Fit, float]:
    """Return the fit with its covariance widened by a friction that was left out."""
    structure = fit.structure
    if structure.friction != "none" or not structure.free:
        return fit, 0.0
    beside = _beside(data, fit, structure.with_(friction="symmetric"), "vc_plus")
    variance = float(np.max(fit.sandwich_factors())) * beside.variance
    variance = min(variance, float(np.abs(data.hold_value).max()) ** 2)  # or it would not turn
    return fit.wider(beside.covariance(variance)), float(np.sqrt(variance))


def consider_left_out(data: Experiments, fit: Fit) -> Fit:
    """Return the fit with its covariance widened by what was not worth its price.

    That is a delay, a load, or a lag of the current's sensor.
    """
    s = fit.structure
    # With the most that nobody would know of it: a driver takes up a command within a sample, and
    # a sensor that averages over one is late by half.
    additions: list[tuple[Structure, str, float]] = []
    if not s.delay and "delay" not in s.fixed:
        additions.append((s.with_(delay=True), "delay", data.step))
    if not s.load and not s.own_load and "load" not in s.fixed:
        additions.append((s.with_(load=True), "load", 0.0))
    if isinstance(s, Electromechanical) and not s.lags:
        additions.append((s.with_(current_sensor="averaged"), "current_lag", 0.5 * data.step))
    factor = float(np.median(fit.sandwich_factors())) if s.free else 1.0
    wider = _consider_second_lag(data, fit, factor) if s.order == 1 else fit
    for richer, coordinate, most in additions if s.free else []:
        little = LITTLE * data.step * (coordinate == "current_lag")
        beside = _beside(data, with_lag(fit, little) if little else fit, richer, coordinate)
        own, found = factor * beside.variance, beside.size + little
        early = little > 0 and found < 0  # which no sensor is
        room = _room(s, coordinate, beside.answer)
        left = mean_square(found, own, min(most, room))
        # Akaike: with it the motor is predicted better.
        if beside.seen and found**2 > 2 * own and not early:
            left = max(left, min(found**2 - own, room**2))
        wider = wider.wider(beside.covariance(left)) if left > 0 else wider
    return wider


def _consider_second_lag(data: Experiments, fit: Fit, factor: float) -> Fit:
    """Return the fit with its covariance widened by a second lag for which its delay may stand.

    Every motor has one: any part of the delay, or of the mean age of a speed that is averaged, is
    as likely as another, up to the longest of a winding, as far as the shape of the response
    leaves it open.  Some are fitted, each with a likelihood of its own.
    """
    s, tau = fit.structure, fit.z.time_constant
    late = next((n for n in ("delay", "window") if n in s.free), None)
    age = 0.0 if late is None else fit.z.value(late) * (1.0 if late == "delay" else 0.5)
    longest = min(age, WINDING_LAG.value * tau)
    if late is None or not age > 0:
        return fit
    lags, near = longest * np.array(SECOND_LAGS), fit
    richer = SecondOrder.like(s)
    deviances, moves = [], []
    for lag in lags:
        slower = fit.z.with_(ln_a1=fit.z.ln_a1 + math.log1p(lag / tau)).with_second_lag(lag)
        left = max(1 - lag / age, 0.0) * fit.z.value(late)
        fixed = richer.with_(fixed={**s.fixed, "ln_a2": slower.ln_a2})
        z = fixed.complete(slower.with_(**{late: left}))
        near = refine(data, fixed, near, z, Options(), ROUGHLY)
        deviances.append(near.deviance)
        moves.append(s.of_free(near.z.array - fit.z.array))
    if not np.isfinite(deviances).all():
        return fit
    likely = np.exp(-0.5 * (np.array(deviances) - min(deviances)) / factor)
    edges = np.concatenate([[0.0], 0.5 * (lags[1:] + lags[:-1]), [longest]])
    weight = likely * np.diff(edges)
    free = np.array(moves)
    return fit.wider(np.asarray(free.T @ ((weight / weight.sum())[:, None] * free)))


def _room(structure: Structure, coordinate: str, answer: Array) -> float:
    """Return the longest delay whose place a second lag can have taken: all of it, and no more."""
    if coordinate != "delay" or "ln_a2" not in structure.free:
        return math.inf
    share = float(answer[structure.free.index("ln_a2")])  # of the second lag, for a second of delay
    return 1 / share if share > 0 else math.inf


def mean_square(found: float, variance: float, most: float) -> float:
    """Return the mean square [s^2] of a lag that as likely is none as any part of ``most``.

    ``found`` and ``variance`` are what the data say of it (a normal likelihood).  The logarithm of
    the samples, by which an addition must gain, is the price of one that could be anything.

    References
    ----------
    Mitchell and Beauchamp, J. Am. Stat. Assoc. 83 (1988), 1023 (spike and slab).
    """
    if not math.isfinite(variance):
        return most**2 / 6
    deviation = math.sqrt(variance)
    lags = (np.arange(POINTS) + 0.5) * most / POINTS
    likely = np.exp(-0.5 * np.square((lags - found) / deviation))
    none = math.exp(-0.5 * (found / deviation) ** 2)
    return float(np.mean(likely * np.square(lags)) / (np.mean(likely) + none + 1e-300))


@dataclass(frozen=True, eq=False)
class _Beside:
    """A coordinate beside a fit: what the score says of it, and how the fit answers to it."""

    answer: Array  # shape (f,): change of the free coordinates for a unit
    size: float
    variance: float
    seen: bool  # whether the data tell it from the free coordinates at all

    def covariance(self, variance: float) -> Array:
        """Return what a variance of the coordinate is for the free ones."""
        return np.asarray(variance * np.outer(self.answer, self.answer))


def _beside(data: Experiments, fit: Fit, richer: Structure, coordinate: str) -> _Beside:
    """Return how the fit answers to one more coordinate."""
    here = prediction.again(data, richer, fit)
    keep = [i for i, c in enumerate(richer.free) if c != coordinate]
    late = richer.free.index(coordinate)
    answer = prediction.inverse(here.normal[np.ix_(keep, keep)], 1e-12) @ here.normal[keep, late]
    whole = float(here.normal[late, late])
    left = float(here.normal[late, late] - here.normal[late, keep] @ answer)
    if not left > ROUNDING * whole:  # the data say nothing of it
        return _Beside(answer, 0.0, math.inf, False)
    score = float(here.gradient[late] - here.gradient[keep] @ answer)
    size = float(np.clip(score / left, -LARGEST, LARGEST))
    return _Beside(answer, size, 1 / left, left > SEEN * whole)
