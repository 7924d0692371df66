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

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from smp_motor_ident.diagnosis.limits import MOST_FRICTION, PROFILE_FROM, REST, SAME_LEVEL
from smp_motor_ident.estimation.descent import initial_of
from smp_motor_ident.estimation.fit import Fit, Options, solve
from smp_motor_ident.estimation.fitted import NORMAL_95, Profile
from smp_motor_ident.estimation.prediction import simulate
from smp_motor_ident.estimation.ridge import slower_winding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.passes import own_columns
from smp_motor_ident.model import structures as models
from smp_motor_ident.model.structures import to_internal

Array = NDArray[np.float64]

RISE = float(chdtri(1, 0.05))  # of the deviance at the end of a 95 % interval
NONLINEAR = (models.VC_PLUS, models.A2, models.DELAY, models.WINDOW, models.CURRENT_LAG)
"""Coordinates that act other than linearly, in the order in which they are followed."""
NEAR = 3.0  # standard deviations to a bound within which no parabola is trusted
STEPS = 8  # points on each side
FARTHEST = 4.0  # e-folds


def profiled(data: Experiments, fit: Fit, options: Options) -> Fit:
    """Return the fit with the profiles of what is poorly known."""
    if np.isfinite(options.huber):
        return fit
    free = fit.structure.free()
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
        if coordinate == models.VC_PLUS and one_level(data, fit):
            ends = _range(data, fit, coordinate)
            # A winding first builds up the torque that breaks loose: from rest that is late,
            # and where its current is measured it tells friction.
            if fit.structure.current:
                found.append(_followed(data, fit, coordinate, float(std[i]), target, options))
            elif fit.structure.order == 2:
                both = [_fixed_at(data, fit, coordinate, f, options).z for f in ends]
                found.append(Profile(coordinate, (both[0], both[1])))
            else:
                both = [rubbing(data, fit, f)[0] for f in ends]
                found.append(Profile(coordinate, (both[0], both[1])))
            # The others are followed at this friction: along it the motors are all alike.
            alike = replace(fit, profiles=tuple(found))
            std = np.sqrt(np.maximum(np.diag(alike.conditional()), 0.0))
            white = np.minimum(white, np.maximum(std, 1e-12))
            friction = {**fit.structure.fixed, "vc_plus": float(fit.z[coordinate])}
            held = replace(fit, structure=fit.structure.with_(fixed=friction))
            continue
        value = float(fit.z[coordinate])
        loose = std[i] > PROFILE_FROM.value * (1.0 if coordinate == models.A2 else abs(value))
        if not loose and (coordinate == models.A2 or value > NEAR * std[i]):
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
    index = np.zeros(data.size, dtype=np.int64)
    for g, (a, b) in enumerate(zip(data.starts[:-1], data.starts[1:], strict=True)):
        first = int(data.hold_start[g])
        last = data.hold_end.size
        last = int(data.hold_start[g + 1]) if g + 2 < data.starts.size else last
        ends = data.hold_end[first:last]
        within = np.searchsorted(ends, data.time[a:b] - 1e-9)
        index[a:b] = first + np.minimum(within, last - first - 1)
    moving = np.abs(speed) > REST.value * np.abs(speed).max()
    driven = (data.hold_value[index] * np.sign(speed))[moving]  # braking is another level
    level = float(np.median(driven)) if driven.size else 0.0
    other = int(np.count_nonzero(np.abs(driven - level) > SAME_LEVEL.value * level))
    # As many samples as a segment's own state has coordinates tell that state, and no more.
    return other <= len(own_columns(data, fit.structure)) * (data.starts.size - 1)


def _followed(
    data: Experiments, fit: Fit, coordinate: int, std: float, target: float, options: Options
) -> Profile:
    low, high = _range(data, fit, coordinate)
    value = float(fit.z[coordinate])
    size = max(value, 0.02 * high) if coordinate != models.A2 else 1.0
    first = float(np.clip(NORMAL_95 * std, 0.05 * size, size))
    target *= data.size / fit.samples
    here = solve(data, fit.structure, fit.at(fit.z, initial_of(data, fit)), options, 6)
    ends = [_end(data, here, coordinate, end, first, target, options) for end in (low, high)]
    if fit.structure.current:
        shift = _physical(fit.z) - _physical(here.z)
        both = [_coordinates(_physical(end) + shift) for end in ends]
        return Profile(coordinate, (both[0], both[1]))
    shift = fit.z - here.z
    return Profile(coordinate, (ends[0] + shift, ends[1] + shift))


def _physical(z: Array) -> Array:
    """Return coordinates with be and ln tm for ln a1 and ln a2, which stay a motor's in between.

    Where L/R is short, a1 = tm + te be and a2 = te tm hang together to a millionth.
    """
    _, tm, _, be = to_internal(z, 2)[0][:4]
    out = z.copy()
    out[[models.A1, models.A2]] = be, np.log(tm)
    return out


def _coordinates(physical: Array) -> Array:
    """Return what `_physical` was made of."""
    te, tm, be = np.exp(physical[models.TE]), np.exp(physical[models.A2]), physical[models.A1]
    z = physical.copy()
    z[[models.A1, models.A2]] = np.log(max(tm + te * be, 1e-3 * tm)), np.log(te * tm)
    return z


def _range(data: Experiments, fit: Fit, coordinate: int) -> tuple[float, float]:
    if coordinate == models.A2:
        slowest = float(2 * fit.z[models.A1] - fit.z[models.A0])  # a winding as slow as the rotor
        value = float(fit.z[models.A2])
        return value - FARTHEST, max(value + FARTHEST, slowest)
    if coordinate == models.VC_PLUS:
        full = float(np.abs(data.hold_value).max())
        if not fit.structure.current:
            return 0.0, MOST_FRICTION.value * full
        # The current tells the back-EMF: friction is what viscous friction may be, at most.
        back = _back_emf(fit.z) / float(np.exp(fit.z[models.A0]))
        value = float(fit.z[coordinate])
        return 0.0, min(MOST_FRICTION.value * full, value + (1 - back) * max(full - value, 0.0))
    return (0.0 if coordinate == models.DELAY else 1e-9), float(np.ptp(data.time))


def _end(
    data: Experiments,
    fit: Fit,
    coordinate: int,
    bound: float,
    first: float,
    target: float,
    options: Options,
) -> Array:
    """Return the coordinates at which the deviance has risen by ``target``, or at the bound."""
    side = np.sign(bound - fit.z[coordinate])
    inner, inner_rise, move, near = fit, 0.0, first, fit
    for _ in range(STEPS if side else 0):
        value = float(fit.z[coordinate] + side * move)
        last = side * (value - bound) >= 0
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
            return np.asarray(inner.z + share * (outer.z - inner.z))
        inner, inner_rise, near = outer, rise, outer
        if last:
            break
        move *= 2.0
    return inner.z


def _fixed_at(data: Experiments, near: Fit, coordinate: int, value: float, options: Options) -> Fit:
    """Fit all others with a coordinate fixed at a value, its segments moving or at rest at first.

    Friction takes its volts from the gain.
    """
    fixed = {**near.structure.fixed, models.Z_NAMES[coordinate]: value}
    structure = near.structure.with_(fixed=fixed)
    if coordinate == models.VC_PLUS:
        z, initials = rubbing(data, near, value)
    else:
        z, initials = near.z.copy(), [near.initial]
        if coordinate == models.A2 and structure.current:
            z = slower_winding(z, z[models.TE] + value - z[models.A2])
    z[coordinate] = value
    starts = [structure.complete(z)]
    if coordinate == models.VC_PLUS and models.TE in structure.free() and not structure.current:
        # Without friction L/R is any; with it, what is late in the response is the winding.
        z[models.TE] = z[models.A2] - z[models.A1]
        starts.append(structure.complete(z))
    tried = [
        solve(data, structure, near.at(z, i), options, 10, 0.05) for z in starts for i in initials
    ]
    return min(tried, key=lambda f: f.deviance)


def _back_emf(z: Array) -> float:
    """Return K [V s/rad], between none and all of a0."""
    return float(np.clip(to_internal(z, 2)[0][2], 0.0, np.exp(z[models.A0])))


def rubbing(data: Experiments, near: Fit, value: float) -> tuple[Array, list[Array]]:
    """Return coordinates and initial states of other friction that turn the motor as fast.

    At one level of voltage these answer exactly alike: all of the response scales.  A segment
    may also have begun at rest.
    """
    full = float(np.abs(data.hold_value).max())
    least = 1e-9 * full  # friction of all the voltage and more leaves a motor that stands
    scale = max(full - value, least) / max(full - near.z[models.VC_PLUS], least)
    z = near.z.copy()
    z[[models.A0, models.A1, models.A2]] += np.log(scale)
    if near.structure.current:  # which tells the back-EMF, so that it does not scale
        te, a1 = np.exp(near.z[[models.TE, models.A1]])
        more = scale * a1 + te * _back_emf(near.z) * (scale - 1)
        z[models.A1] = np.log(max(more, 1e-3 * scale * a1))
    z[[models.VC_PLUS, models.VC_MINUS]] = value
    moving = near.initial.copy()
    sign = np.sign(near.initial[:, 1])
    moving[:, 0] = scale * (moving[:, 0] - sign * near.z[models.VC_PLUS]) + sign * value
    before = np.abs(data.hold_value[data.hold_start[: len(moving)]])
    at_rest = before < max(value, near.z[models.VC_PLUS])
    if not np.any(at_rest & near.initial[:, :2].any(axis=1)):
        return z, [moving]
    still = np.array([0.0, 0.0, 1.0, 1.0, 0.0])
    return z, [moving, np.where(at_rest[:, None], still, 1.0) * moving]
