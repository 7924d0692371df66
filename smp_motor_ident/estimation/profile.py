"""Intervals from the profile likelihood: the deviance is followed, its parabola not trusted.

A coordinate that is poorly known, or at its bound, is fixed at other values and all others are
fitted again, until the deviance has risen by the quantile of chi-square (times the sandwich
factor).  A bound that is reached first ends the interval: then it is one-sided.
Derivation: docs/derivations.md, section 9.

References
----------
Venzon and Moolgavkar, Applied Statistics 37 (1988), 87; Self and Liang, JASA 82 (1987), 605
(at a bound).
"""

from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.limits import MOST_FRICTION, PROFILE_FROM, REST, SAME_LEVEL
from smp_motor_ident.estimation.descent import initial_of
from smp_motor_ident.estimation.fit import Fit, Options, solve
from smp_motor_ident.estimation.fitted import Profile
from smp_motor_ident.estimation.prediction import simulate, voltage_at_samples
from smp_motor_ident.estimation.quantities import ways
from smp_motor_ident.estimation.trials import slower_winding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.passes import own_columns
from smp_motor_ident.model.coordinates import Coordinates, direction
from smp_motor_ident.model.second_order import internal
from smp_motor_ident.result import NORMAL_95

RISE = float(chdtri(1, 0.05))  # of the deviance at the end of a 95 % interval
NONLINEAR = ("vc_plus", "ln_a1", "ln_a2", "delay", "window", "current_lag")
LAGS = ("ln_a1", "ln_a2")  # logarithms
"""Coordinates that act other than linearly, in the order in which they are followed."""
NEAR = 3.0  # standard deviations to a bound within which no parabola is trusted
STEPS = 8  # points on each side, the last of which is the bound
FARTHEST = 4.0  # e-folds
SLOWEST = 10.0  # time constants of the motor, for a delay and for a sensor


def profiled(data: Experiments, fit: Fit, options: Options) -> Fit:
    """Return the fit with the profiles of what is poorly known."""
    if np.isfinite(options.huber):
        return fit
    free = fit.structure.free
    std = np.sqrt(np.diag(fit.covariance()))
    white = np.sqrt(np.diag(fit.white()))
    found: list[Profile] = []
    held = fit
    for coordinate in NONLINEAR:
        if coordinate not in free:
            continue
        i = free.index(coordinate)
        # Coloured residuals and repeating counts scale the deviance as they do variances.
        target = RISE * float((std[i] / white[i]) ** 2)
        if coordinate == "vc_plus" and one_level(data, fit):
            ends = _range(data, fit, coordinate)
            # A winding first builds up the torque that breaks loose, which is late. So are sensors,
            # clocks, and friction that sticks more than it slides: nothing is read in it.
            if fit.structure.order == 2:
                both = [_fixed_at(data, fit, coordinate, f, options).z for f in ends]
                found.append(Profile(coordinate, (both[0], both[1])))
            else:
                both = [rubbing(data, fit, f)[0] for f in ends]
                found.append(Profile(coordinate, (both[0], both[1])))
            # The others are followed at this friction: along it the motors are all alike.
            alike = replace(fit, profiles=tuple(found))
            std = np.sqrt(np.maximum(np.diag(alike.conditional()), 0.0))
            white = np.minimum(white, np.maximum(std, 1e-12))
            friction = {**fit.structure.fixed, "vc_plus": fit.z.vc_plus}
            held = replace(fit, structure=fit.structure.with_(fixed=friction))
            continue
        value = fit.z.value(coordinate)
        loose = std[i] > PROFILE_FROM.value * (1.0 if coordinate in LAGS else abs(value))
        if not loose and (coordinate in LAGS or value > NEAR * std[i]):
            continue
        found.append(_followed(data, held, coordinate, float(std[i]), target, options))
    return replace(fit, profiles=tuple(found))


def one_level(data: Experiments, fit: Fit) -> bool:
    """Tell whether the motor moves at one level of voltage only, along its motion.

    Then gain and friction trade exactly: with ``s = (v - F) / (v - F')`` the motor of s a0,
    s a1, s a2 and friction F' moves alike.
    """
    settled = fit if len(fit.initial) == len(data.initial) else replace(fit, initial=data.initial)
    speed = simulate(data, settled)[:, 0]
    moving = np.abs(speed) > REST.value * np.abs(speed).max()
    driven = (voltage_at_samples(data) * np.sign(speed))[moving]  # braking is another level
    level = float(np.median(driven)) if driven.size else 0.0
    other = np.zeros(moving.size, np.int64)
    other[moving] = np.abs(driven - level) > SAME_LEVEL.value * level
    # As many samples as a segment's own state has coordinates tell that state, and no more.
    each = np.add.reduceat(other, data.starts[:-1])
    return bool(np.all(each <= len(own_columns(data, fit.structure))))


def _followed(
    data: Experiments, fit: Fit, coordinate: str, std: float, target: float, options: Options
) -> Profile:
    low, high = _range(data, fit, coordinate)
    value = fit.z.value(coordinate)
    size = max(value, 0.02 * high) if coordinate not in LAGS else 1.0
    first = float(np.clip(NORMAL_95 * std, 0.05 * size, size))
    target *= data.size / fit.samples
    here = solve(data, fit.structure, fit.at(fit.z, initial_of(data, fit)), options, 6)
    ends = [_end(data, here, coordinate, end, first, target, options) for end in (low, high)]
    if fit.structure.current:
        shift = _physical(fit.z) - _physical(here.z)
        both = [_coordinates(_physical(end) + shift) for end in ends]
        return Profile(coordinate, (both[0], both[1]))
    shift = fit.z.array - here.z.array
    return Profile(coordinate, (ends[0].moved(shift), ends[1].moved(shift)))


def _physical(z: Coordinates) -> Array:
    """Return coordinates with be and ln tm for ln a1 and ln a2, which stay a motor's in between.

    Where L/R is short, a1 = tm + te be and a2 = te tm hang together to a millionth.
    """
    _, tm, _, be = internal(z)[0][:4]
    return z.with_(ln_a1=be, ln_a2=np.log(tm)).array


def _coordinates(physical: Array) -> Coordinates:
    """Return what `_physical` was made of."""
    z = Coordinates.of(physical)
    te, tm, be = z.electrical_time_constant, z.a2, z.ln_a1
    return z.with_(ln_a1=np.log(max(tm + te * be, 1e-3 * tm)), ln_a2=np.log(te * tm))


def _range(data: Experiments, fit: Fit, coordinate: str) -> tuple[float, float]:
    value = fit.z.value(coordinate)
    if coordinate == "ln_a2":
        slowest = 2 * fit.z.ln_a1 - fit.z.ln_a0  # a winding as slow as the rotor
        return value - FARTHEST, max(value + FARTHEST, slowest)
    if coordinate == "ln_a1":
        return value - FARTHEST, value + FARTHEST
    if coordinate == "vc_plus":
        return 0.0, most_friction(data, fit)
    longest = max(value, SLOWEST * fit.z.time_constant)  # after which nothing is left of a motion
    return (0.0 if coordinate == "delay" else 1e-9), min(longest, float(np.ptp(data.time)))


def most_friction(data: Experiments, fit: Fit) -> float:
    """Return the friction [V] that a motor may have which moves alike at one level of voltage."""
    full = float(np.abs(data.hold_value).max())
    if not fit.structure.current:
        return MOST_FRICTION.value * full
    # The current tells the back-EMF: friction is what viscous friction may be, at most.
    back, value = _back_emf(fit.z) / fit.z.a0, fit.z.vc_plus
    return min(MOST_FRICTION.value * full, value + (1 - back) * max(full - value, 0.0))


def _end(
    data: Experiments,
    fit: Fit,
    coordinate: str,
    bound: float,
    first: float,
    target: float,
    options: Options,
) -> Coordinates:
    """Return the coordinates at which the deviance has risen by ``target``, or at the bound."""
    begin = fit.z.value(coordinate)
    side = np.sign(bound - begin)
    inner, inner_rise, move, near = fit, 0.0, first, fit
    for step in range(STEPS if side else 0):
        value = float(begin + side * move)
        last = side * (value - bound) >= 0 or step == STEPS - 1
        value = bound if last else value
        outer = _fixed_at(data, near, coordinate, value, options)
        rise = outer.deviance - fit.deviance
        if not np.isfinite(rise) or rise >= target:
            rise = rise if np.isfinite(rise) else 4 * target
            # The deviance is a parabola between the two, its square root a line.
            a, b = np.sqrt(max(inner_rise, 0.0)), np.sqrt(rise)
            share = float(np.clip((np.sqrt(target) - a) / max(b - a, 1e-12), 0.0, 1.0))
            if fit.structure.current:
                near_end, far_end = _physical(inner.z), _physical(outer.z)
                return _coordinates(near_end + share * (far_end - near_end))
            return inner.z.moved(share * (outer.z.array - inner.z.array))
        inner, inner_rise, near = outer, rise, outer
        if last:
            break
        move *= 2.0
    return inner.z


def _fixed_at(data: Experiments, near: Fit, coordinate: str, value: float, options: Options) -> Fit:
    """Fit all others with a coordinate fixed at a value, its segments moving or at rest at first.

    Friction takes its volts from the gain.
    """
    fixed = {**near.structure.fixed, coordinate: value}
    structure = near.structure.with_(fixed=fixed)
    if coordinate == "vc_plus":
        z, initials = rubbing(data, near, value)
    else:
        z, initials = near.z, [near.initial]
        if coordinate == "ln_a2" and structure.current:
            z = slower_winding(z, z.ln_te + value - z.ln_a2)
    starts = [structure.complete(z)]
    if coordinate == "vc_plus" and "ln_te" in structure.free and not structure.current:
        # Without friction L/R is any; with it, what is late in the response is the winding.
        starts.append(structure.complete(z.undamped()))
    begun = [(z, i) for z in starts for i in initials]
    if coordinate == "vc_plus" and structure.own_load:  # which is as much less one way
        loads = near.initial.copy()
        loads[:, 3] -= ways(data) * (value - near.z.vc_plus)
        begun.append((structure.complete(near.z.with_friction(value)), loads))
    tried = [solve(data, structure, near.at(z, i), options, 10, 0.05) for z, i in begun]
    return min(tried, key=lambda f: f.deviance)


def _back_emf(z: Coordinates) -> float:
    """Return K [V s/rad], between none and all of a0."""
    return float(np.clip(internal(z)[0][2], 0.0, z.a0))


def rubbing(data: Experiments, near: Fit, value: float) -> tuple[Coordinates, list[Array]]:
    """Return coordinates and initial states of other friction that turn the motor as fast.

    At one level of voltage these answer exactly alike: all of the response scales.  A segment
    may also have begun at rest.
    """
    full = float(np.abs(data.hold_value).max())
    least = 1e-9 * full  # friction of all the voltage and more leaves a motor that stands
    before = near.z.vc_plus
    scale = max(full - value, least) / max(full - before, least)
    higher = np.log(scale)
    z = near.z.moved(direction(ln_a0=higher, ln_a1=higher, ln_a2=higher)).with_friction(value)
    if near.structure.current:  # which tells the back-EMF, so that it does not scale
        te, a1 = near.z.electrical_time_constant, near.z.a1
        more = scale * a1 + te * _back_emf(near.z) * (scale - 1)
        z = z.with_(ln_a1=np.log(max(more, 1e-3 * scale * a1)))
    moving = near.initial.copy()
    sign = np.sign(near.initial[:, 1])
    moving[:, 0] = scale * (moving[:, 0] - sign * before) + sign * value
    driven = np.abs(data.hold_value[data.hold_start[: len(moving)]])
    at_rest = driven < max(value, before)
    if not np.any(at_rest & near.initial[:, :2].any(axis=1)):
        return z, [moving]
    still = np.array([0.0, 0.0, 1.0, 1.0, 0.0])
    return z, [moving, np.where(at_rest[:, None], still, 1.0) * moving]
