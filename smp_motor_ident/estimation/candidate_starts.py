"""Starts of one candidate structure from the answers of others: those in it, around it, beside it.

Derivation: docs/derivations.md, section 10.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.estimation import descent
from smp_motor_ident.estimation.choice import size
from smp_motor_ident.estimation.fit import Fit, Options
from smp_motor_ident.likelihood import recursion as rc
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model import structures as models
from smp_motor_ident.model.structures import Structure

Array = NDArray[np.float64]


def of_kind(data: Experiments, fit: Fit) -> Experiments:
    """Return the experiments with output and command taken as a fit's structure takes them."""
    data = data.held(fit.structure.held)
    return data.as_mean_speed() if fit.kind == rc.MEAN_SPEED else data


def no_worse(data: Experiments, fit: Fit, known: list[Fit], options: Options) -> Fit:
    """Hold a fit against those that it contains: their answers are starts as good as any."""
    free = set(fit.structure.free())
    inner = [f for f in known if f.kind == fit.kind and set(f.structure.free()) < free]
    least = min(inner, key=lambda f: f.deviance, default=fit)
    if least.deviance >= fit.deviance:
        return fit
    z = least.z.copy()
    if fit.structure.order > least.structure.order:
        z[models.A2] = 2 * z[models.A1] - z[models.A0] + np.log(0.02)
        z[models.TE] = z[models.A2] - z[models.A1]
    if fit.structure.delay and not least.structure.delay:
        z[models.DELAY] = 0.1 * data.step
    again = descent.refine(data, fit.structure, least, fit.structure.complete(z), options)
    return min(fit, again, key=lambda f: f.deviance)


def from_richer(data: Experiments, tried: list[Fit], options: Options) -> list[Fit]:
    """Start the simpler candidates from the likeliest too: its torque noise may be theirs."""
    best = min(tried, key=lambda f: f.deviance, default=None)
    out = []
    for fit in tried:
        free, more = set(fit.structure.free()), set(best.structure.free()) if best else set()
        if best is not None and free < more and fit.kind == best.kind:
            z = best.z.copy()
            late = z[models.DELAY] * (models.DELAY not in free)
            if fit.structure.order == 2 and late > 0:
                z[models.A2] = np.logaddexp(z[models.A2], z[models.A1] + np.log(late))
            part = of_kind(data, fit)
            z = fit.structure.complete(z)
            again = descent.refine(part, fit.structure, best, z, options, known=fit)
            fit = min(fit, again, key=lambda f: f.deviance)
        out.append(fit)
    return out


def from_rivals(data: Experiments, tried: list[Fit], options: Options) -> list[Fit]:
    """Start the likeliest from every rival's answer: what is late in one way may be in another."""
    if len(tried) < 2:
        return tried
    best = min(range(len(tried)), key=lambda i: tried[i].deviance + _price(tried[i]))
    out = list(tried)
    for rival in tried:
        winner = out[best]
        if rival is winner or rival.kind != winner.kind:
            continue
        z = winner.structure.complete(_translated(rival, winner.structure, data.step))
        part = of_kind(data, winner)
        again = descent.refine(part, winner.structure, rival, z, options, known=winner)
        if again.deviance < winner.deviance:
            out[best] = again
    return out


def _price(fit: Fit) -> float:
    return size(fit.structure) * float(np.log(fit.samples))


def _translated(rival: Fit, structure: Structure, step: float) -> models.Array:
    """Return a rival's coordinates, what it is late by put into what the structure has."""
    z, has = rival.z.copy(), rival.structure
    late = z[models.DELAY] * has.delay
    if has.order == 2 and structure.order == 1:
        late += float(np.exp(z[models.A2] - z[models.A1]))
    if structure.order == 2 and has.order == 1:
        z[models.A2] = z[models.A1] + np.log(max(late, 0.1 * step))
        z[models.TE] = z[models.A2] - z[models.A1]
        late = 0.1 * step
    z[models.DELAY] = max(late, 0.1 * step)
    return z


def under_load(known: Fit, best: Fit) -> list[Array]:
    """Return coordinates of a structure whose fit lacked a load: its own, and the choice's."""
    volts = [models.VC_PLUS, models.VC_MINUS, models.LOAD]
    own, other = known.z.copy(), best.z.copy()
    own[volts] = best.z[volts]
    s, t = best.structure, known.structure
    if t.order > s.order:  # what answers late may be a second lag
        slow = np.exp(other[models.A1] - other[models.A0])
        late = float(other[models.DELAY] + 0.5 * other[models.WINDOW] * s.window)
        other[models.A2] = other[models.A1] + np.log(max(late, 0.02 * slow))
        other[models.TE] = other[models.A2] - other[models.A1]
    elif t.order < s.order:
        other[models.DELAY] += np.exp(other[models.A2] - other[models.A1])
    other[models.DELAY] *= t.delay
    other[models.WINDOW] = best.z[models.WINDOW] if s.window else known.z[models.WINDOW]
    return [own, other]
