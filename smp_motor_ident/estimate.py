# SPDX-License-Identifier: Apache-2.0
"""The entry point: records of a motor in, an `Estimate` out, or a refusal that says why."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from smp_motor_ident.errors import CurrentError, SmpError
from smp_motor_ident.finding import Finding
from smp_motor_ident.fit.adequacy import compute_scatters
from smp_motor_ident.fit.data import MIN_SEARCH_ROWS, Data, prepare
from smp_motor_ident.fit.descend import Fit, constrain, evaluate_on_rows, fit, refine
from smp_motor_ident.fit.search import prune, search
from smp_motor_ident.infer.answer import state_quantities
from smp_motor_ident.infer.findings import EstimateContext, collect_findings, refuse_unexplained
from smp_motor_ident.infer.provenance import describe_provenance
from smp_motor_ident.infer.residuals import check_residuals
from smp_motor_ident.infer.uncertainty import collect_contributions, detect_levels
from smp_motor_ident.infer.validation import compute_fit_percents
from smp_motor_ident.one_thread import one_thread
from smp_motor_ident.quality.excitation import find_excitation
from smp_motor_ident.quality.repair import repair_records
from smp_motor_ident.quality.screen import screen_records
from smp_motor_ident.record import Record
from smp_motor_ident.request import LOSSES, Request, check_request
from smp_motor_ident.result import Estimate


def estimate(
    records: Record | Sequence[Record],
    model: str = "auto",
    *,
    fixed: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    loss: str = "linear",
    validation: Sequence[Record] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Estimate:
    """Estimate a motor from recordings, without initial values, with its uncertainty.

    Maximum likelihood of a simulated chain of components on counts, angle or speed, and current
    where it is measured.

    Parameters
    ----------
    records : Record or sequence of Record
        Of one motor; each record (and segment) has its own initial state.
    model : str
        ``auto``, or a structure of the motor: ``first_order``, ``second_order``,
        ``electromechanical``.
    fixed : mapping of str to float, optional
        Known parameters by the names of `result.UNITS`; SI, at the motor shaft.
    bounds : mapping of str to (float, float), optional
        Limits of physical parameters, where current is measured.
    loss : {'linear', 'huber'}
        Least squares, or a robust loss where there are outliers.
    validation : sequence of Record, optional
        Held-out records; by default the last part of ``records`` judges a fit of the rest.
    progress : callable, optional
        Receives in words the step that begins.

    Returns
    -------
    Estimate
        Values with standard deviations; an unidentifiable quantity has no value.

    Raises
    ------
    InsufficientExcitationError
        When the data do not support the answer.
    SignalError
        When the data contradict themselves or a motor's physics.
    ParameterError
        When ``model``, ``fixed``, ``bounds`` or ``loss`` make no sense.

    References
    ----------
    docs/derivations.md; Ljung, System Identification, 2nd ed., sections 7.4 and 9.
    """
    group = [records] if isinstance(records, Record) else list(records)
    request = check_request(group, model, fixed, bounds, loss, validation, progress)
    group = repair_records(group)
    with one_thread(), np.errstate(all="ignore"):
        try:
            return _estimate_group(group, request, screen_records(group))
        except CurrentError as refusal:
            if not request.may_leave_current:
                raise
            bare, other = request.without_current(group)
            return _estimate_group(bare, other, [*screen_records(bare), _report_left_out(refusal)])


def _estimate_group(group: list[Record], request: Request, found: Sequence[Finding]) -> Estimate:
    """Search the chain, fit it, and state its numbers with their uncertainty."""
    group = [r.slice(*find_excitation(r)) for r in group]
    data = prepare(group, request.use_current, LOSSES[request.loss])
    best = _fit_best_chain(data, request)
    levels = detect_levels(data)
    hardware = group[0].hardware
    scatters = compute_scatters(data, best)
    parts = collect_contributions(data, best, levels, scatters, hardware.timing_accuracy)
    result = state_quantities(data, best, parts, levels, hardware, request.known)
    request.say("validating")
    context = EstimateContext(
        group, data, best, parts, scatters, levels, result,
        compute_fit_percents(group, data, best, request.validation), check_residuals(data, best),
        request.known,
    )  # fmt: skip
    refuse_unexplained(context)
    return Estimate(
        parameters=result.parameters,
        combinations=result.combinations,
        names=result.names,
        covariance=result.covariance,
        systematic=result.systematic,
        chain=best.chain.record,
        fit_percent=context.percent,
        residuals=context.tests,
        findings=(*found, *collect_findings(context)),
        **describe_provenance(context),
    )


def _fit_best_chain(data: Data, request: Request) -> Fit:
    """Return the fit of the chain that explains the data at the lowest price."""
    thin = data.thin(MIN_SEARCH_ROWS)
    found = search(thin, request.policy, request.say)
    request.say(f"fitting {' + '.join(found.chain.codes)}")
    found = fit(data, found if thin is data else evaluate_on_rows(data, found))
    found = prune(data, refine(data, found))
    return constrain(data, found, request.constraints) if request.constraints else found


def _report_left_out(refusal: SmpError) -> Finding:
    return Finding(
        "current_left_out",
        "warning",
        f"the current was left out: {refusal}",
        {},
        "record the armature's current with its sign, unfiltered",
    )
