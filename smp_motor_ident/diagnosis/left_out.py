"""Estimates without the part of a record in which something beside its voltage moved the motor."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from smp_motor_ident.diagnosis.load_step import load_step
from smp_motor_ident.diagnosis.scope import differing
from smp_motor_ident.estimation.candidate_starts import of_kind
from smp_motor_ident.estimation.disturbance import disturbance
from smp_motor_ident.estimation.driver_effect import leaves_torque_noise
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.request import Request
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.record import Record
from smp_motor_ident.result import Estimate

Tried = Callable[[list[Record], Request, Sequence[Finding]], Estimate | None]
"""Estimates a motor from records; nothing where that is refused."""


def undisturbed(
    tried: Tried,
    group: list[Record],
    request: Request,
    found: Sequence[Finding],
    fit: Fit,
    noisy: Estimate | None,
) -> Estimate | None:
    """Return the estimate without what something else did to the motor, if it holds.

    One that took that for torque noise is not contradicted: if so, the part that tells was lost.
    """
    request.say("what else moved the motor")
    there = disturbance(group, request.since) if request.since else None
    if there is None:
        return None
    e = tried(there.records, replace(request, since=()), [*found, there.finding()])
    if e is None or e.unreliable or leaves_torque_noise(e, fit):
        return None
    return None if noisy and not noisy.unreliable and differing(noisy, e) else e


def under_own_loads(
    tried: Tried,
    group: list[Record],
    request: Request,
    found: Sequence[Finding],
    data: Experiments,
    fit: Fit,
) -> Estimate | None:
    """Return the estimate with a load before and one after a step, if that leaves no change.

    An angle wanders under torque noise as under steps of a load: nothing is to be left of it.
    """
    if not request.since:
        return None
    request.say("whether the load changed")
    there = load_step(group, request.since, of_kind(data, fit), fit, request.options)
    if there is None:
        return None
    asked = replace(request, since=(), own_loads=True)
    e = tried(there.records, asked, [*found, there.finding()])
    if e is None or e.unreliable:
        return None
    shown = {f.code for f in e.findings if "explained_deviance" in f.evidence}
    return None if "drift" in shown or "torque_noise" in {f.code for f in e.findings} else e
