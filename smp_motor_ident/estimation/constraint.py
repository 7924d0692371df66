"""Refits under what the user holds fixed or bounded, and what physics forbids."""

from dataclasses import replace

import numpy as np

from smp_motor_control.motor.parameters import PHYSICAL
from smp_motor_ident.estimation.descent import refine
from smp_motor_ident.estimation.fit import Fit, Prior
from smp_motor_ident.estimation.profile import rubbing
from smp_motor_ident.estimation.request import Request
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.physical import physical


def constrained(data: Experiments, fit: Fit, request: Request) -> Fit:
    """Return a fit that keeps to what is known, and to friction that takes power."""
    if not fit.structure.current:
        return fit
    known = request.known
    values = physical(fit.z)
    scale = {n: abs(values[n]) for n in PHYSICAL}
    scale["viscous_friction"] = values["motor_constant"] ** 2 / values["resistance"]
    priors = [
        Prior(n, known[n], 1e-4 * max(abs(known[n]), 1e-2 * scale[n]))
        for n in PHYSICAL
        if n in known
        and not (n == "resistance" or (n == "inductance" and "ln_te" in fit.structure.fixed))
    ]
    for name, (low, high) in request.bounds.items():
        if not low <= values[name] <= high:
            priors.append(Prior(name, float(np.clip(values[name], low, high)), 1e-4 * scale[name]))
    negative = values["viscous_friction"] < 0 and "viscous_friction" not in known
    if negative:
        most = scale["viscous_friction"]
        priors.append(Prior("viscous_friction", 1e-9 * most, 1e-4 * most))
    if not priors:
        return fit
    bound = replace(request.options, priors=tuple(priors))
    if not negative:
        return refine(data, fit.structure, fit, fit.z, bound)
    starts = [fit.z, _rubbing_less(data, fit, values["motor_constant"])]
    tried = (refine(data, fit.structure, fit, z, bound) for z in starts)
    return min(tried, key=lambda f: f.deviance)


def _rubbing_less(data: Experiments, fit: Fit, constant: float) -> Coordinates:
    """Return a motor that turns as fast at the largest voltage and loses nothing but to friction.

    Where friction and what grows with speed hardly differ, the way there is longer than a descent.
    """
    full = float(np.abs(data.hold_value).max())
    less = full - constant / fit.z.a0 * (full - fit.z.vc_plus)
    return fit.structure.complete(rubbing(data, fit, max(less, 0.0))[0])
