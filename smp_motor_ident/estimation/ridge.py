"""The likelihood's ridge along which friction and gain trade where no current is measured.

Derivation: docs/derivations.md, section 10.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.estimation.fit import Fit, Options, solve
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.structures import Structure

Array = NDArray[np.float64]

SHARES = (0.97, 0.7, 0.1)  # of a0 that K is
RESTARTS = 6  # fresh starts around a place where a descent was stuck
RESTART_LENGTHS = (1.0, 0.3, 3.0)  # standard deviations (or e-folds, where these are more) to it
ALIKE = 0.5  # deviance by which two fits explain the data alike
OPEN = 0.3  # standard deviation of ln a2 above which other starts are tried


def along_friction(part: Experiments, structure: Structure, best: Fit, options: Options) -> Fit:
    """Try other shares of friction and gain that turn the motor as fast at full voltage.

    Without current the two trade against each other along a long curved ridge of the likelihood.
    """
    if structure.current or "vc_plus" not in structure.free:
        return best
    full = float(np.abs(part.hold_value).max())
    for share in (0.01, 0.025, 0.06):
        left = (full - share * full) / max(full - best.z.vc_plus, 1e-9)
        z = best.z.with_(vc_plus=share * full, ln_a0=best.z.ln_a0 + np.log(left))
        starts = [z]
        if "ln_te" in structure.free and best.z.vc_plus < 1e-3 * full:
            # None at all may only be the other lag's friction.
            starts.append(z.with_(ln_te=z.undamped().ln_te + 0.3))
        for z in starts:
            other = _from(z, part, structure, best, options)
            if better(other, best):
                best = other
    best = _along_lag(part, structure, best, options)
    if best.converged or structure.friction != "symmetric":
        return best
    return random_restart(
        part, structure, _scan_friction(part, structure, best, options, full), options
    )


def better(one: Fit, other: Fit) -> bool:
    """Tell which of two fits to keep: the likelier; of two alike the one that claims less."""
    if one.deviance < other.deviance - ALIKE:
        return True
    free = one.structure.free
    if one.deviance > other.deviance + ALIKE or "vc_plus" not in free:
        return one.deviance < other.deviance
    i = free.index("vc_plus")
    mine, theirs = one.covariance()[i, i], other.covariance()[i, i]
    return bool(mine > 4 * theirs or (mine > theirs / 4 and one.deviance < other.deviance))


def random_restart(part: Experiments, structure: Structure, best: Fit, options: Options) -> Fit:
    """Restart at random around a descent that did not settle: a kink holds it at one place only."""
    rng = np.random.default_rng(len(part.starts))
    matrix = structure.matrix
    for n in range(RESTARTS):
        if best.converged:
            break
        values, vectors = np.linalg.eigh(best.covariance())
        length = RESTART_LENGTHS[n % len(RESTART_LENGTHS)]
        move = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
        ways = Coordinates.of(matrix @ move)
        largest = max(abs(x) for x in (ways.ln_a0, ways.ln_a1, ways.ln_a2, ways.ln_te))
        z = best.z.moved(matrix @ move * min(length, length / max(largest, 1e-12)))
        other = _from(z, part, structure, best, options)
        if other.deviance < best.deviance:
            best = other
    return best


def shapes(z: Coordinates) -> list[Coordinates]:
    """Return motors of the same linear response, by shares of the back-EMF in what limits it.

    ``K = a0 - be`` and ``be te^2 - a1 te + a2 = 0``: which of two lags is the electric one,
    and how much the motor brakes itself, is identifiable by friction alone.
    """
    out = []
    for share in SHARES:
        roots = np.roots([(1 - share) * z.a0, -z.a1, z.a2])
        real = roots[np.abs(roots.imag) < 1e-9 * np.abs(roots)].real
        out += [z.with_(ln_te=np.log(te)) for te in real if te > 0]
    return out or [z]


def slower_winding(z: Coordinates, ln_te: float) -> Coordinates:
    """Return the coordinates of the same rotor under another L/R."""
    before, after = np.float64(z.electrical_time_constant), float(np.exp(ln_te))
    tm = z.a2 / before
    damping = float(np.clip((z.a1 - tm) / before, 0.0, z.a0))
    return z.with_(ln_a1=np.log(tm + after * damping), ln_a2=np.log(after * tm), ln_te=ln_te)


def _from(
    z: Coordinates, part: Experiments, structure: Structure, best: Fit, options: Options
) -> Fit:
    """Descend from other coordinates in the surroundings of the best fit so far."""
    return solve(part, structure, best.at(structure.complete(z)), options, 30)


def _along_lag(part: Experiments, structure: Structure, best: Fit, options: Options) -> Fit:
    """Try other lags and shapes where the fit leaves them open, or what it leaves is not noise."""
    free = structure.free
    if "ln_a2" not in free or "ln_te" not in free:
        return best
    i = free.index("ln_a2")
    starts = shapes(best.z) if best.noise_ratio > 0 or not best.converged else []
    if not best.converged or best.covariance()[i, i] > OPEN**2:
        for share in (0.05, 0.2, 0.6):
            z = best.z.with_second_lag(share * best.z.time_constant)
            starts.append(z.with_(ln_te=z.ln_te + 0.02))
    for z in starts:
        other = _from(z, part, structure, best, options)
        if other.deviance < best.deviance - 1:
            best = other
    return best


def _scan_friction(
    part: Experiments, structure: Structure, best: Fit, options: Options, full: float
) -> Fit:
    """Search friction by the profile of the deviance: the others are fitted at each value.

    Where the motor sticks often, the joint surface has a kink at every start and stop, and a
    descent along the ridge ends at one of them; across the ridge it does not.
    """
    profile: dict[float, Fit] = {}

    def at(level: float) -> Fit:
        if level not in profile:
            near = min(profile.values(), key=lambda f: abs(_level(f) - level), default=best)
            left, before = (max(full - x, 1e-9) for x in (level, _level(near)))
            z = near.z.with_(ln_a0=near.z.ln_a0 + np.log(left / before))
            fixed = structure.with_(fixed={**structure.fixed, "vc_plus": level})
            start = near.at(fixed.complete(z), noise_ratio=best.noise_ratio)
            profile[level] = solve(part, fixed, start, options, 12, 0.1)
        return profile[level]

    grid = sorted({_level(best), *(full * np.array([0.003, 0.008, 0.016, 0.025, 0.04, 0.08]))})
    for level in grid:
        at(level)
    for _ in range(8):
        levels = sorted(profile)
        i = levels.index(min(levels, key=lambda x: profile[x].deviance))
        low, high = levels[max(i - 1, 0)], levels[min(i + 1, len(levels) - 1)]
        at(0.5 * (low + levels[i]) if levels[i] - low > high - levels[i] else
           0.5 * (high + levels[i]))  # fmt: skip
    least = min(profile.values(), key=lambda f: f.deviance)
    if least.deviance >= best.deviance - 1:
        return best
    return solve(part, structure, least.at(least.z, noise_ratio=best.noise_ratio), options, 30)


def _level(fit: Fit) -> float:
    return fit.z.vc_plus
