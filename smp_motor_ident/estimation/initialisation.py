"""From regressions to the right minimum: rank candidates, refine the best, grow the data window.

Derivation: docs/derivations.md, sections 8 and 10.
"""

from collections.abc import Sequence

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.estimation.data_window import grow
from smp_motor_ident.estimation.descent import (
    SCREENING_SAMPLES,
    bandwidth,
    first_noise,
    noise_ratio_of,
)
from smp_motor_ident.estimation.fit import Fit, Options, Start, solve
from smp_motor_ident.estimation.memory import remembered
from smp_motor_ident.estimation.start import FilteredData, speed_candidates
from smp_motor_ident.estimation.trials import WINDINGS, better, shapes, tried
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.noise import NoiseModel, deviance, kalman_gain
from smp_motor_ident.likelihood.passes import gather
from smp_motor_ident.model.coordinates import Coordinates, direction
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.model.structures import Structure

ALIKE = 0.05  # e-folds or volts by which starts differ that end alike
SHAPES = 6  # of the same linear response that are refined
LAGS, SAMPLES = 20.0, 2_000  # of a motor, and at least, on which starts are compared


MOVES = 0.5
"""Largest share of the voltage that a start lets friction take: a motor that never moves shows a
descent no way out."""


def candidates(data: Experiments, structure: Structure) -> list[Coordinates]:
    """Return starting coordinates for a structure, from linear regressions."""
    most = MOVES * float(np.abs(data.hold_value).max(initial=0.0))
    found = []
    for z in structure.guesses(FilteredData(data)):
        z = z.with_friction(float(np.clip(z.vc_plus, -most, most)))  # what moves is held by less
        found.append(z.with_(window=1.02 * data.step) if structure.window else z)
    return found


def ranked_on(data: Experiments) -> Experiments:
    """Return the part that first fits are of."""
    return data.data_window(min(8.0, SCREENING_SAMPLES * data.step))


def beginning(data: Experiments) -> Experiments:
    """Return as much of the data as tells starts apart: some seconds, or less of a quick motor."""
    return remembered(data, "beginning", 1, (), lambda: _beginning(data))


def _beginning(data: Experiments) -> Experiments:
    whole = ranked_on(data)
    lags = [z.time_constant for z in speed_candidates(whole, 1)]
    if not lags:
        return data
    few = data.data_window(max(LAGS * float(np.median(lags)), SAMPLES * data.step))
    moved = np.ptp(few.voltage) > 0.5 * np.ptp(whole.voltage)  # of the same both ways
    return few if moved and few.size < whole.size else data


def initial_fit(
    data: Experiments,
    structure: Structure,
    options: Options,
    extra: Sequence[Coordinates] = (),
    near: Fit | None = None,
) -> Fit | None:
    """Fit a structure without any guess."""
    first = first_fit(data, structure, options, extra)
    return first and grow(data, structure, first, options, near)


def first_fit(
    data: Experiments,
    structure: Structure,
    options: Options,
    extra: Sequence[Coordinates] = (),
    keep: int = 3,
    own: bool = True,
) -> Fit | None:
    """Fit a structure to the beginning of the data: the likeliest of several starts."""
    subset = ranked_on(data)
    found = [*extra, *(candidates(data, structure) if own else [])]
    starts = [z for z in map(structure.complete, found) if np.all(np.isfinite(z.array))]
    if not starts:
        return None
    noise = first_noise(subset)
    ranked = _ranked(subset, structure, starts, noise)
    best: Fit | None = None
    if "ln_te" in structure.free and not structure.current:
        shaped = [other for z in ranked[:2] for other in shapes(z)]
        ranked, keep = _ranked(subset, structure, shaped, noise), SHAPES
    for z in ranked[:keep]:
        noise_ratio = noise_ratio_of(bandwidth(z, subset), subset.step, subset.kind)
        begun = Start(z, subset.initial, noise, noise_ratio)
        one = solve(subset, structure, begun, options, 25, 0.1, best)
        again = best is not None and abs(one.deviance - best.deviance) < 0.1
        if best is None or better(one, best):
            best = one
        agreed = again and "ln_te" not in structure.free
        if (agreed or structure.friction == "none") and one.converged:
            break  # two starts agree, or the surface is smooth
    assert best is not None
    if structure.current:
        if subset.kind == ANGLE:
            other = _under_any_load(subset, structure, ranked[0], noise, options)
            best = min(best, other, key=lambda f: f.deviance)
        best = tried(subset, best, WINDINGS, options, 25, 0.1)
    return best


def _under_any_load(
    subset: Experiments, structure: Structure, z: Coordinates, noise: Array, options: Options
) -> Fit:
    """Fit with the angle followed at once, of which the electrical equation holds under any load.

    A load that wanders sets angle against current, and a descent gives up either: with R kept
    until the noise of both is known, neither.
    """
    at_once = noise_ratio_of(np.pi / subset.step, subset.step, subset.kind)
    kept = structure.with_(fixed={**structure.fixed, "ln_r": z.ln_r})
    start = Start(z, subset.initial, noise, at_once)
    return solve(subset, structure, solve(subset, kept, start, options, 25, 0.1), options, 25, 0.1)


def _distinct(starts: Sequence[Coordinates], step: float) -> list[Coordinates]:
    """Return starts without those from which a descent would end as from one before them."""
    per: Array = direction(
        **dict.fromkeys(("ln_a0", "ln_a1", "ln_a2", "ln_te", "vc_plus"), 1 / ALIKE),
        **dict.fromkeys(("delay", "window"), 2 / step),
    )
    scaled = np.array([z.array for z in starts]) * per
    left = np.arange(len(starts))
    out: list[Coordinates] = []
    while left.size:
        out.append(starts[left[0]])
        left = left[np.abs(scaled[left] - scaled[left[0]]).max(axis=1) >= 1]
    return out


def _ranked(
    subset: Experiments, structure: Structure, starts: list[Coordinates], noise: Array
) -> list[Coordinates]:
    """Return starts, the likeliest first; of those that are alike, one."""
    return sorted(_distinct(starts, subset.step), key=lambda z: _score(subset, structure, z, noise))


def _score(subset: Experiments, structure: Structure, z: Coordinates, noise: Array) -> float:
    """Return the deviance of a candidate on the innovations (robust against drift)."""
    noise_ratio = noise_ratio_of(bandwidth(z, subset), subset.step, subset.kind)
    relative = noise[1, 1] / noise[0, 0] if subset.current.size else 0.0
    gain, _ = kalman_gain(structure, z, subset.kind, subset.step, noise_ratio, relative)
    sums = gather(
        subset, structure, z, subset.initial, NoiseModel(noise, gain), differentiate=False
    )
    value = deviance(sums.spread)
    return value if np.isfinite(value) else np.inf
