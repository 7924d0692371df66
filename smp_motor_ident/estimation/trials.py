"""Descents from several starts: a table says which, one loop tries them, one rule keeps the best.

Without current, friction and gain trade along a long curved ridge of the likelihood, and L/R shows
by the shape of stick and slip alone; with it, an L/R of less than a sample leaves a surface so flat
that a descent ends where it began.  At a kink, of which friction makes one at every start and stop,
a descent is held at one place only.
Derivation: docs/derivations.md, section 10.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.estimation.fit import Fit, Options, Start, solve
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.coordinates import Coordinates, direction

Starts = Callable[[Experiments, Fit, Options], Iterator[Start]]

ALIKE = 0.5  # deviance by which two fits explain the data alike
SHARES = (0.97, 0.7, 0.1)  # of a0 that K is
FRICTIONS = (0.01, 0.025, 0.06)  # of the largest voltage that friction takes
SECOND_LAGS = (0.05, 0.2, 0.6)  # of the first
SCANNED = (0.003, 0.008, 0.016, 0.025, 0.04, 0.08)  # of the largest voltage: levels of friction
FACTORS = (0.2, 0.5, 2.0, 5.0)  # on L, and on R at the same L
RESTARTS = 6  # fresh starts around a place where a descent was stuck
RESTART_LENGTHS = (1.0, 0.3, 3.0)  # standard deviations (or e-folds, where these are more) to it
OPEN = 0.3  # standard deviation of ln a2 above which other starts are tried
LOOSE = 0.02  # standard deviation of ln L/R or ln R above which other starts are tried
WINDING = 0.2  # of a sample: a shorter L/R has settled to a hundredth when the current is read


@dataclass(frozen=True)
class Trial:
    """Other starts of a fit: what they are, whether it is their turn, and where they lie."""

    about: str
    applies: Callable[[Experiments, Fit], bool]
    starts: Callable[[Experiments, Fit, Options], Iterable[Start]]


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


def _rubs(data: Experiments, best: Fit) -> bool:
    return not best.structure.current and "vc_plus" in best.structure.free


def _shaped(data: Experiments, best: Fit) -> bool:
    return _rubs(data, best) and {"ln_a2", "ln_te"} <= set(best.structure.free)


def _unexplained(data: Experiments, best: Fit) -> bool:
    return _shaped(data, best) and (best.noise_ratio > 0 or not best.converged)


def _open(data: Experiments, best: Fit) -> bool:
    return _shaped(data, best) and (not best.converged or _deviation(best, "ln_a2") > OPEN)


def _unsettled(data: Experiments, best: Fit) -> bool:
    return not best.converged


def _kinked(data: Experiments, best: Fit) -> bool:
    return _rubs(data, best) and not best.converged and best.structure.friction == "symmetric"


def _loose(data: Experiments, best: Fit) -> bool:
    free = [n for n in ("ln_te", "ln_r") if n in best.structure.free]
    return best.structure.current and any(_deviation(best, n) > LOOSE for n in free)


def _hidden(data: Experiments, best: Fit) -> bool:
    """Tell of an L/R that shows in nothing: what a descent left behind on its way there shows."""
    return _loose(data, best) and best.z.ln_te <= np.log(WINDING * data.step)


def _deviation(fit: Fit, name: str) -> float:
    i = fit.structure.free.index(name)
    return float(np.sqrt(fit.covariance()[i, i]))


def _late_twice(data: Experiments, best: Fit) -> bool:
    return not best.structure.current and {"delay", "ln_a2"} <= set(best.structure.free)


def _full(data: Experiments) -> float:
    return float(np.abs(data.hold_value).max())


def _with_friction(share: float) -> Starts:
    def starts(data: Experiments, best: Fit, options: Options) -> Iterator[Start]:
        """Yield a motor as fast at full voltage, of which friction takes a share."""
        z = _as_fast(best.z, share * _full(data), _full(data)).with_(vc_plus=share * _full(data))
        yield best.at(z)
        if "ln_te" in best.structure.free and best.z.vc_plus < 1e-3 * _full(data):
            # None at all may only be the other lag's friction.
            yield best.at(z.with_(ln_te=z.undamped().ln_te + 0.3))

    return starts


def _as_fast(z: Coordinates, friction: float, full: float) -> Coordinates:
    """Return the gain of a motor that turns as fast at full voltage under another friction."""
    left, before = (max(full - x, 1e-9) for x in (friction, z.vc_plus))
    return z.with_(ln_a0=z.ln_a0 + np.log(left / before))


def _other_shapes(data: Experiments, best: Fit, options: Options) -> Iterator[Start]:
    yield from (best.at(z) for z in shapes(best.z))


def _other_lags(data: Experiments, best: Fit, options: Options) -> Iterator[Start]:
    for share in SECOND_LAGS:
        z = best.z.with_second_lag(share * best.z.time_constant)
        yield best.at(z.with_(ln_te=z.ln_te + 0.02))


def _exchanged(data: Experiments, best: Fit, options: Options) -> Iterator[Start]:
    """Yield what answers late as delay next to all, and as second lag next to all."""
    late, little = best.z.delay + best.z.second_lag, 0.1 * data.step
    for delay in (late - little, little):
        if 0 < delay < late:
            yield best.at(best.z.with_second_lag(late - delay).with_(delay=delay))


def _scaled(factor: float, way: Array) -> Starts:
    def starts(data: Experiments, best: Fit, options: Options) -> Iterator[Start]:
        yield best.at(best.z.moved(way * np.log(factor)))

    return starts


def _slower_windings(data: Experiments, best: Fit, options: Options) -> Iterator[Start]:
    fastest = WINDING * data.step
    for te in np.geomspace(fastest, max(fastest, 0.2 * best.z.time_constant), 4):
        yield best.at(slower_winding(best.z, float(np.log(te))))


def _nearby(n: int) -> Starts:
    def starts(data: Experiments, best: Fit, options: Options) -> Iterator[Start]:
        """Yield a place drawn at random from the interval of a fit, or an e-fold from it."""
        matrix = best.structure.matrix
        values, vectors = np.linalg.eigh(best.covariance())
        draw = np.random.default_rng([len(data.starts), n]).standard_normal(len(values))
        move = Coordinates.of(matrix @ (vectors @ (np.sqrt(np.maximum(values, 0.0)) * draw)))
        largest = max(abs(x) for x in (move.ln_a0, move.ln_a1, move.ln_a2, move.ln_te))
        length = RESTART_LENGTHS[n % len(RESTART_LENGTHS)]
        yield best.at(best.z.moved(move.array * min(length, length / max(largest, 1e-12))))

    return starts


def _by_profile(data: Experiments, best: Fit, options: Options) -> Iterator[Start]:
    """Yield where the profile of the deviance along friction is least.

    Where the motor sticks often, the joint surface has a kink at every start and stop, and a
    descent along the ridge ends at one of them; across the ridge it does not.
    """
    from scipy.optimize import minimize_scalar  # takes a while to load, and is seldom needed

    profile: dict[float, Fit] = {}

    def deviance(level: float) -> float:
        near = min(profile.values(), key=lambda f: abs(f.z.vc_plus - level), default=best)
        fixed = best.structure.with_(fixed={**best.structure.fixed, "vc_plus": level})
        z = fixed.complete(_as_fast(near.z, level, _full(data)))
        start = near.at(z, noise_ratio=best.noise_ratio)
        profile[level] = solve(data, fixed, start, options, 12, 0.1)
        return profile[level].deviance

    levels = sorted({best.z.vc_plus, *(_full(data) * share for share in SCANNED)})
    least = int(np.argmin([deviance(level) for level in levels]))
    around = levels[max(least - 1, 0)], levels[min(least + 1, len(levels) - 1)]
    minimize_scalar(  # type: ignore[call-overload]  # the stubs want arguments that have defaults
        deviance, bounds=around, method="bounded", options={"maxiter": 8}
    )
    found = min(profile.values(), key=lambda f: f.deviance)
    if found.deviance < best.deviance - 1:
        yield found.at(found.z, noise_ratio=best.noise_ratio)


LAGS = (Trial("delay and second lag exchanged", _late_twice, _exchanged),)
"""Of a motor late by both: either may stand for the other, with a minimum each."""

RANDOM = tuple(Trial(f"random restart {n + 1}", _unsettled, _nearby(n)) for n in range(RESTARTS))
"""Around a descent that did not settle."""

RIDGE = (
    *(Trial(f"friction of {share:.1%} of the voltage", _rubs, _with_friction(share))
      for share in FRICTIONS),
    Trial("other shares of the back-EMF", _unexplained, _other_shapes),
    Trial("other second lags", _open, _other_lags),
    Trial("friction by its profile", _kinked, _by_profile),
    *(Trial(t.about, _kinked, t.starts) for t in RANDOM),
)  # fmt: skip
"""Along friction, gain and L/R where no current is measured."""

WINDINGS = (
    *(Trial(f"{factor:g} times L", _loose, _scaled(factor, direction(ln_a2=1.0, ln_te=1.0)))
      for factor in FACTORS),
    *(Trial(f"R over {factor:g} at the same L", _loose,
            _scaled(factor, direction(ln_te=1.0, ln_r=-1.0)))
      for factor in FACTORS),
    Trial("a slower winding", _hidden, _slower_windings),
)  # fmt: skip
"""Of other L and R where the current leaves them open."""


def tried(
    data: Experiments,
    best: Fit,
    trials: Sequence[Trial],
    options: Options,
    passes: int = 30,
    tolerance: float = 1e-2,
) -> Fit:
    """Return the best of a fit and of the descents from other starts, one trial after the other."""
    structure = best.structure
    # A current may leave L and R so open that any place is near where a descent began.
    near = not structure.current
    for trial in trials:
        if not trial.applies(data, best):
            continue
        for start in trial.starts(data, best, options):
            begun = start.at(structure.complete(start.z))
            other = solve(
                data, structure, begun, options, passes, tolerance, best if near else None
            )
            best = other if better(other, best) else best
    return best


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
