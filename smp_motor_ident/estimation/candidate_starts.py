"""Starts of one candidate structure from the answers of others: those in it, around it, beside it.

Derivation: docs/derivations.md, section 10.
"""

import numpy as np

from smp_motor_ident.estimation import descent
from smp_motor_ident.estimation.fit import Fit, Options
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.structures import Structure


def of_kind(data: Experiments, fit: Fit) -> Experiments:
    """Return the experiments with output and command taken as a fit's structure takes them."""
    return data.held(fit.structure.held).measured_as(fit.kind)


def no_worse(data: Experiments, fit: Fit, known: list[Fit], options: Options) -> Fit:
    """Hold a fit against those that it contains: their answers are starts as good as any."""
    free = set(fit.structure.free)
    inner = [f for f in known if f.kind == fit.kind and set(f.structure.free) < free]
    least = min(inner, key=lambda f: f.deviance, default=fit)
    if least.deviance >= fit.deviance:
        return fit
    z = least.z
    if fit.structure.order > least.structure.order:
        z = z.with_second_lag(0.02 * z.time_constant)
    if fit.structure.delay and not least.structure.delay:
        z = z.with_(delay=0.1 * data.step)
    again = descent.refine(data, fit.structure, least, fit.structure.complete(z), options)
    return min(fit, again, key=lambda f: f.deviance)


def from_richer(data: Experiments, tried: list[Fit], options: Options) -> list[Fit]:
    """Start the simpler candidates from the likeliest too: its torque noise may be theirs."""
    best = min(tried, key=lambda f: f.deviance, default=None)
    out = []
    for fit in tried:
        free, more = set(fit.structure.free), set(best.structure.free) if best else set()
        if best is not None and free < more and fit.kind == best.kind:
            z = best.z
            late = z.delay * ("delay" not in free)
            if fit.structure.order == 2 and late > 0:
                z = z.with_(ln_a2=np.logaddexp(z.ln_a2, z.ln_a1 + np.log(late)))
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
    prices = [f.structure.size * float(np.log(f.samples)) for f in tried]
    best = min(range(len(tried)), key=lambda i: tried[i].deviance + prices[i])
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


def _translated(rival: Fit, structure: Structure, step: float) -> Coordinates:
    """Return a rival's coordinates, what it is late by put into what the structure has."""
    z, has = rival.z, rival.structure
    late = z.delay * has.delay
    if has.order == 2 and structure.order == 1:
        late += z.second_lag
    if structure.order == 2 and has.order == 1:
        z = z.with_second_lag(max(late, 0.1 * step))
        late = 0.1 * step
    return z.with_(delay=max(late, 0.1 * step))


def under_load(known: Fit, best: Fit) -> list[Coordinates]:
    """Return coordinates of a structure whose fit lacked a load: its own, and the choice's."""
    other = best.z
    own = known.z.with_(vc_plus=other.vc_plus, vc_minus=other.vc_minus, load=other.load)
    s, t = best.structure, known.structure
    delay = other.delay
    if t.order > s.order:  # what answers late may be a second lag
        late = delay + 0.5 * other.window * s.window
        other = other.with_second_lag(max(late, 0.02 * other.time_constant))
    elif t.order < s.order:
        delay += other.second_lag
    window = best.z.window if s.window else known.z.window
    return [own, other.with_(delay=delay * t.delay, window=window)]
