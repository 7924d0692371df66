"""Torque noise found on the screening subset, and the data window grown from there.

Derivation: docs/derivations.md, sections 7 and 10.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from smp_motor_ident.diagnosis.limits import TORQUE_NOISE
from smp_motor_ident.estimation.descent import (
    SCREENING_SAMPLES,
    at_rest,
    bandwidth,
    initial_of,
    noise_ratio_of,
    refine,
)
from smp_motor_ident.estimation.fit import Fit, Options, solve
from smp_motor_ident.estimation.profile import most_friction, one_level, rubbing
from smp_motor_ident.estimation.selection import POLICY
from smp_motor_ident.estimation.trials import RIDGE, tried
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.model.structures import Structure

FLOOR = 1.3  # residual variance over that of quantisation, below which there is no more
WALK = 0.6  # step of the logarithm of the bandwidth while its best is not bracketed
CLOSE = 0.15  # spacing of the same at which the best is known well enough
SLOW = 0.03  # of the motor's own bandwidth: what follows no faster runs as good as free
ALONG = 12  # passes along friction, after which it is known to a hundredth of what it may be
MOST = 5.0  # farthest from the motor's own bandwidth


def grow(
    data: Experiments,
    structure: Structure,
    first: Fit,
    options: Options,
    near: Fit | None = None,
    rival: Fit | None = None,
) -> Fit:
    """Find the process-to-measurement noise ratio on a growing data window, then fit all data.

    What a rival on the same data is far above then is not sought along its ridges.
    """
    part = data.data_window(min(SCREENING_SAMPLES * data.step, 60.0))
    first = _with_friction_of(part, structure, first, options)
    best = _find_noise_ratio(part, structure, first, options, near)
    least = rival.deviance if rival is not None and rival.samples == part.size else np.inf
    if POLICY.rejects_on_subset(best, least):
        whole = best.samples == data.size
        return best if whole else extend(data, structure, best, options, rival)
    found = tried(part, best, RIDGE, options)
    moved = found.deviance < best.deviance - TORQUE_NOISE.value
    if found.noise_ratio > 0 and (moved or not found.converged):
        again = _find_noise_ratio(part, structure, found, options, found)
        found = min(found, again, key=lambda f: f.deviance)
    slowest = noise_ratio_of(SLOW * bandwidth(found.z, part), part.step, part.kind)
    fine = found.noise[0, 0] < FLOOR * part.quantum**2 / 12
    if found.noise_ratio > 0 and (fine or found.noise_ratio < slowest):
        # It came from afar on innovations; in free run nothing is left for torque noise.
        free_run = solve(part, structure, found.at(found.z, noise_ratio=0.0), options, 40)
        if (
            free_run.noise[0, 0] < FLOOR * part.quantum**2 / 12
            or free_run.deviance < found.deviance + TORQUE_NOISE.value
        ):
            found = tried(part, free_run, RIDGE, options)
    best = found
    return extend(data, structure, best, options)


def grown(data: Experiments, fit: Fit, options: Options) -> Fit:
    """Find anew how much torque noise there is: what a model lacked may have looked like it."""
    if not fit.noise_ratio > 0:
        return fit
    again = grow(data, fit.structure, fit, options)
    return again if again.deviance < fit.deviance + TORQUE_NOISE.value else fit


def quieted(data: Experiments, fit: Fit, options: Options) -> Fit:
    """Return the free run where it leaves nothing for torque noise, which brought a fit near."""
    if not fit.noise_ratio > 0:
        return fit
    free_run = refine(data, fit.structure, replace(fit, noise_ratio=0.0), fit.z, options)
    return free_run if free_run.deviance < fit.deviance + TORQUE_NOISE.value else fit


def extend(
    data: Experiments, structure: Structure, best: Fit, options: Options, known: Fit | None = None
) -> Fit:
    """Carry a fit of the screening subset on to all data, on a growing data window."""
    part = data.data_window(min(SCREENING_SAMPLES * data.step, 60.0))
    if best.samples == data.size and best.converged:
        return best
    samples = part.size * 4 if structure.friction != "none" else data.size
    # The last stretch is at most six times the one before, as those in between are.
    while 1.5 * samples < data.size and best.noise_ratio == 0:
        longer = data.data_window(samples * data.step)
        best = _with_friction_of(longer, structure, best, options)
        best = solve(longer, structure, best.at(best.z, initial_of(longer, best)), options, 8)
        samples *= 6
    best = _with_friction_of(data, structure, best, options)
    start = best.at(best.z, initial_of(data, best))
    return solve(data, structure, start, options, 25, known=known)


def _with_friction_of(data: Experiments, structure: Structure, fit: Fit, options: Options) -> Fit:
    """Return a fit with the friction that more data ask for, if its own were of one level.

    Gain and friction trade exactly there, and it has any of them: from afar a descent on motion
    at another level ends at a kink.
    """
    few = data.first(fit.samples)
    if few is data or structure.friction != "symmetric" or "vc_plus" not in structure.free:
        return fit
    if not one_level(few, fit) or one_level(data, fit):
        return fit
    from scipy.optimize import minimize_scalar  # takes a while to load, and is seldom needed

    near = replace(fit, initial=initial_of(data, fit))
    tried = [solve(data, structure, near, options, 1)]

    def deviance(friction: float) -> float:
        z, initials = rubbing(data, near, friction)
        alike = [near.at(structure.complete(z), initial) for initial in initials]
        there = [solve(data, structure, start, options, 1) for start in alike]
        tried.append(min(there, key=lambda f: f.deviance))
        return tried[-1].deviance

    most = most_friction(data, near)
    minimize_scalar(  # type: ignore[call-overload]  # the stubs want arguments that have defaults
        deviance, bounds=(0.0, most), method="bounded", options={"maxiter": ALONG}
    )
    best = min(tried, key=lambda f: f.deviance)
    return replace(fit, z=best.z, initial=best.initial)


def _find_noise_ratio(
    part: Experiments, structure: Structure, first: Fit, options: Options, near: Fit | None
) -> Fit:
    """Walk from following to free run; keep the likeliest process-to-measurement noise ratio."""

    def fitted(near: Fit, noise_ratio: float, passes: int) -> Fit:
        start = near.at(near.z, initial_of(part, near), noise_ratio)
        one = solve(part, structure, start, options, passes)
        return at_rest(part, structure, one, options)

    # A speed output survives torque noise in free run, and free run has no bias where the
    # model is not the motor; the innovations form is for angles, which drift.
    free_run = fitted(first, 0.0, 30)
    if part.kind != ANGLE:
        return free_run
    # Residuals no larger than the counter's own resolution leave nothing for torque noise.
    quiet = free_run.noise[0, 0] < FLOOR * part.quantum**2 / 12
    if quiet or (free_run.converged and near is not None and near.noise_ratio == 0):
        return free_run
    band = bandwidth(first.z, part)
    path: dict[float, Fit] = {}
    here = first

    def walked(near: Fit, x: float) -> Fit:
        return fitted(near, noise_ratio_of(band * float(np.exp(x)), part.step, part.kind), 15)

    if near is not None and near.noise_ratio > 0:
        x = float(np.log((near.noise_ratio / part.step) ** 0.25 / band))
        path[x] = fitted(first, near.noise_ratio, 20)
        best = _likeliest(path, walked)
        return min(
            free_run, best, key=lambda f: f.deviance + TORQUE_NOISE.value * (f.noise_ratio > 0)
        )
    # Where a current was kept under any load, down from where the angle was followed at once.
    fastest = (first.noise_ratio / part.step) ** 0.25 / band if structure.current else 1.0
    above = fastest * 0.3 ** np.arange(round(np.log(max(fastest, 1.0)) / np.log(1 / 0.3)))
    for factor in (*above, 1.0, 0.3, 0.1, 0.03, 0.01):
        here = fitted(here, noise_ratio_of(band * factor, part.step, part.kind), 20)
        path[float(np.log(factor))] = here
        worst = here.deviance - min(f.deviance for f in path.values())
        if worst > (60 if here.converged else 2000):
            break
    else:
        free_run = min(free_run, fitted(here, 0.0, 20), key=lambda f: f.deviance)
    if free_run.deviance < min(f.deviance for f in path.values()) + TORQUE_NOISE.value:
        return free_run
    return _likeliest(path, walked)


def _likeliest(path: dict[float, Fit], fitted: Callable[[Fit, float], Fit]) -> Fit:
    """Refine the logarithm of a bandwidth by parabolas through the deviance."""
    for _ in range(14):
        xs = sorted(path)
        i = xs.index(min(xs, key=lambda x: path[x].deviance))
        best = path[xs[i]]
        if i in (0, len(xs) - 1):  # not bracketed yet
            # From one point first towards the motor's own bandwidth: a poorer model's is farther.
            outward = xs[i] > 0.0 if len(xs) == 1 else i == 0
            x = xs[i] + (-WALK if outward else WALK)
            if abs(x) > max(MOST, abs(xs[i])):
                break
        else:
            (a, b, c), y = xs[i - 1 : i + 2], [path[x].deviance for x in xs[i - 1 : i + 2]]
            rise, fall = (y[2] - y[1]) / (c - b), (y[1] - y[0]) / (b - a)
            if (c - a) * (rise - fall) < 0.2:  # flat to a tenth of a deviance
                break
            x = 0.5 * (a + b) - 0.5 * fall * (c - a) / (rise - fall)
            if c - a > 2.5 * WALK or abs(x - b) < 0.02 * (c - a):
                x = 0.5 * (a + b) if b - a > c - b else 0.5 * (b + c)
            if max(c - b, b - a) < CLOSE:
                break
        path[x] = fitted(best, x)
    return min(path.values(), key=lambda f: f.deviance)
