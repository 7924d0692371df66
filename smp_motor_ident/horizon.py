"""Torque noise found on the head of the data, and the horizon grown from there.

Derivation: docs/derivations.md, sections 7 and 10.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident import models
from smp_motor_ident import recursion as rc
from smp_motor_ident.descent import HEAD, Options, bandwidth, descend, initial_of, ratio_of
from smp_motor_ident.experiments import Experiments
from smp_motor_ident.fit import Fit
from smp_motor_ident.models import Structure
from smp_motor_ident.valley import along_friction

Array = NDArray[np.float64]

FLOOR = 1.3  # residual variance over that of quantisation, below which there is no more
PRICE = 12.0  # deviance that torque noise must explain before it is believed


def grow(data: Experiments, structure: Structure, first: Fit, options: Options) -> Fit:
    """Find the noise ratio on a growing horizon, then fit all data.

    Parameters
    ----------
    data : Experiments
        Prepared records.
    structure : Structure
        What is free.
    first : Fit
        On the head of the data, with a high ratio.
    options : Options
        Loss and prior knowledge.

    Returns
    -------
    Fit
        On all data.
    """
    part = data.head(min(HEAD * data.step, 60.0))
    best = _find_ratio(part, structure, first, options)
    best = along_friction(part, structure, best, options)
    return extend(data, structure, best, options)


def extend(data: Experiments, structure: Structure, best: Fit, options: Options) -> Fit:
    """Carry a fit of the head on to all data, on a growing horizon.

    Parameters
    ----------
    data : Experiments
        Prepared records.
    structure : Structure
        What is free.
    best : Fit
        On the head of the data.
    options : Options
        Loss and prior knowledge.

    Returns
    -------
    Fit
        On all data.
    """
    part = data.head(min(HEAD * data.step, 60.0))
    if best.samples == data.size:
        return best
    horizon = part.size * 4 if structure.friction != "none" else data.size
    while horizon < data.size and best.ratio == 0:
        longer = data.head(horizon * data.step)
        best = descend(
            longer, structure, best.z, initial_of(longer, best), best.noise, best.ratio, options, 8
        )
        horizon *= 6
    return descend(
        data, structure, best.z, initial_of(data, best), best.noise, best.ratio, options, 25
    )


def _find_ratio(part: Experiments, structure: Structure, first: Fit, options: Options) -> Fit:
    """Walk from following to free run; keep the likeliest ratio of torque noise."""
    # A speed output survives torque noise in free run, and free run has no bias where the
    # model is not the motor; the innovations form is for angles, which drift.
    if part.kind != rc.ANGLE:
        return _at_rest(
            part,
            structure,
            descend(
                part, structure, first.z, initial_of(part, first), first.noise, 0.0, options, 30
            ),
            options,
        )
    # Residuals no larger than the counter's own resolution leave nothing for torque noise.
    at_once = _at_rest(part, structure, descend(part, structure, first.z, initial_of(part, first),
                       first.noise, 0.0, options, 30), options)  # fmt: skip
    if at_once.converged and at_once.noise[0, 0] < FLOOR * part.quantum**2 / 12:
        return at_once
    band = bandwidth(first.z, part)
    path: list[tuple[float, Fit]] = []
    here = first
    for factor in (1.0, 0.3, 0.1, 0.03, 0.01, 0.0):
        ratio = ratio_of(band * factor, part.step, part.kind)
        here = _at_rest(
            part,
            structure,
            descend(
                part, structure, here.z, initial_of(part, here), here.noise, ratio, options, 20
            ),
            options,
        )
        path.append((factor, here))
        worst = here.deviance - min(f.deviance for _, f in path)
        if factor > 0 and worst > (60 if here.converged else 2000):
            break
    factor, best = min(path, key=lambda item: item[1].deviance)
    free_run = path[-1][1]
    if at_once.deviance < free_run.deviance or free_run.ratio > 0:
        free_run = at_once
    if factor == 0.0 or free_run.deviance < best.deviance + PRICE:
        return free_run
    for finer in (1.8, 1 / 1.8):
        while True:
            ratio = ratio_of(band * factor * finer, part.step, part.kind)
            here = descend(part, structure, best.z, best.initial, best.noise, ratio, options, 12)
            if here.deviance >= best.deviance - 0.5:
                break
            best, factor = here, factor * finer
            if factor > 30:
                break
    return best


def _at_rest(data: Experiments, structure: Structure, fit: Fit, options: Options) -> Fit:
    """Try whether segments that begin slowly began at rest: friction makes that a kink."""
    if structure.friction == "none":
        return fit
    first = np.abs(fit.initial[:, 1])
    slow = (first > 0) & (
        first < 0.05 * np.exp(-fit.z[models.A0]) * np.abs(data.section_value).max()
    )
    if not slow.any():
        return fit
    initial = fit.initial.copy()
    initial[slow, 1] = 0.0
    other = descend(data, structure, fit.z, initial, fit.noise, fit.ratio, options, 12)
    return other if other.deviance < fit.deviance else fit
