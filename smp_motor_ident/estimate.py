"""The entry point: records of a motor in, an `Estimate` out, or a refusal that says why."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import cast

from smp_motor_ident.diagnosis import validation as validate
from smp_motor_ident.diagnosis.advice import advise, assess, unsettled_rival
from smp_motor_ident.diagnosis.alternatives import Alternatives
from smp_motor_ident.diagnosis.beside import held_against_effects
from smp_motor_ident.diagnosis.certainty import certain
from smp_motor_ident.diagnosis.conditions import dependent, rubbing_std
from smp_motor_ident.diagnosis.current_kind import ARMATURE, current_kind
from smp_motor_ident.diagnosis.data_quality import screen
from smp_motor_ident.diagnosis.model_error import regression
from smp_motor_ident.diagnosis.provenance import provenance
from smp_motor_ident.diagnosis.refusal import (
    explains,
    fallen_back,
    lag_unknown,
    no_candidate,
    of_which,
    only_lag_unknown,
    refuse_unexplained,
    refuse_unidentifiable,
)
from smp_motor_ident.diagnosis.repair import repaired
from smp_motor_ident.diagnosis.residuals import residual_tests
from smp_motor_ident.diagnosis.scope import (
    UNDECIDED,
    blames_current,
    contradicted,
    current_left_out,
    scope,
)
from smp_motor_ident.diagnosis.systematic import with_systematic
from smp_motor_ident.diagnosis.units import implausible_motor
from smp_motor_ident.errors import (
    CurrentError,
    InsufficientExcitationError,
    SignalError,
    SmpError,
    UnknownLagError,
)
from smp_motor_ident.estimation import flexible_shaft, order_selection
from smp_motor_ident.estimation.averaging import candidate_weights, covering, left_open
from smp_motor_ident.estimation.candidate_starts import of_kind
from smp_motor_ident.estimation.constraint import constrained
from smp_motor_ident.estimation.driver_effect import (
    DriverFit,
    declared,
    leaves_most,
    suspecting,
    suspects_driver,
)
from smp_motor_ident.estimation.driver_search import beside_driver
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.hold_choice import chosen_hold, earlier_command, otherwise
from smp_motor_ident.estimation.quantities import (
    Answer,
    answer,
    driven_longest,
    ways,
    without_lag,
)
from smp_motor_ident.estimation.request import Request, base_structure, checked
from smp_motor_ident.estimation.selection import FittedCandidate, in_turn
from smp_motor_ident.estimation.subset import excitation
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.one_thread import one_thread
from smp_motor_ident.record import Record
from smp_motor_ident.result import Estimate, FitPercent


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
    """Estimate a motor from recordings, without initial values, with what is and is not known.

    Output-error or innovations least squares on counts, angle or speed (and current where
    it is measured) with analytic sensitivities; no initial guess is needed.

    Parameters
    ----------
    records : Record or sequence of Record
        Of one motor; each record (and segment) has its own initial state.
    model : str
        ``auto``, or a candidate structure: ``static_gain``, ``first_order``,
        ``second_order``, ``electromechanical``.
    fixed : mapping of str to float, optional
        What the user knows, by the names of `model.physical.PHYSICAL` or ``delay``,
        ``averaging_window``, ``sensor_lag``, and of the driver ``dead_zone``, ``clip_voltage``,
        ``slew_rate``; SI, at the motor shaft.
    bounds : mapping of str to (float, float), optional
        Limits of physical parameters, where current is measured.
    loss : {'linear', 'huber'}
        Least squares, or a robust loss where there are outliers.
    validation : sequence of Record, optional
        Held-out records; by default the last part of ``records`` is held out for the
        validation figure, and used again for the final estimate.
    progress : callable, optional
        Receives in words what is being done.

    Returns
    -------
    Estimate
        Values with standard deviations; what is not identifiable has no value.

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
    rigid = "second_order" if model == flexible_shaft.NAME else model
    request = checked(group, rigid, fixed, bounds, loss, validation, progress)
    found = _as_recorded(group, request)
    if model == flexible_shaft.NAME:
        found = flexible_shaft.flexible_shaft(group, found)
    return with_systematic(found)


def _as_recorded(group: list[Record], request: Request) -> Estimate:
    """Estimate with the uncertainty that the records themselves show."""
    group = repaired(group)

    def behind(records: list[Record], kept: Sequence[Record] | None) -> Estimate:
        try:
            return _checked(records, replace(request, validation=kept))
        except UnknownLagError as refusal:
            return cast(Estimate, refusal.estimate)

    with one_thread():
        try:
            return declared(behind, group, request.validation, request.known)
        except (SignalError, InsufficientExcitationError) as refusal:
            raise of_which(group, refusal, lambda r: behind([r], None)) from None


def _checked(group: list[Record], request: Request) -> Estimate:
    """Estimate from records whose data are looked at first."""
    kind = current_kind(group) if request.may_leave_current else ARMATURE
    if kind != ARMATURE:
        group, request = request.without_current(group)
    found = screen(group)
    rows = [excitation(r) for r in group]
    since = tuple(float(r.time[begin]) for r, (begin, _) in zip(group, rows, strict=True))
    group = [r.slice(*of) for r, of in zip(group, rows, strict=True)]
    request = replace(request, since=since)
    if kind != ARMATURE:
        return _estimated(group, request, [*found, current_left_out(kind)])
    return _answered(group, request, found)


def _answered(group: list[Record], request: Request, found: Sequence[Finding]) -> Estimate:
    """Estimate; without the current where that is what does not fit."""
    if not request.may_leave_current:
        return _estimated(group, request, found)
    first: Estimate | None = None
    blamed: Finding | None = None
    refusal: SmpError | None = None
    try:
        first = _estimated(group, request, found)
        blamed = next((f for f in first.findings if blames_current(f)), None)
        if blamed is None:
            return first
        reason = blamed.code
    except CurrentError as error:
        refusal, reason = error, "current_offset"
    except (SignalError, InsufficientExcitationError) as error:
        refusal, reason = error, UNDECIDED
    bare, other = request.without_current(group)
    other = replace(other, suspected=first is not None and suspects_driver(first))
    second = _tried(bare, other, [*found, current_left_out(reason)])
    if second is None and refusal is not None:
        raise refusal
    if first is not None and (second is None or second.unreliable):
        return first
    assert second is not None
    return replace(second, findings=(*second.findings, *contradicted(first, second, blamed)))


def _estimated(group: list[Record], request: Request, found: Sequence[Finding]) -> Estimate:
    """Choose a structure, fit it, and say how far it can be trusted."""
    data, hold, candidates = _candidates(group, request)
    if ahead := earlier_command(group, request, data, hold, candidates[-1].fit):
        records, asked, said = ahead
        if early := _tried(records, asked, [*found, said]):
            if early.residuals.white:
                return early
            as_read = _tried(group, replace(request, earlier=True), found)
            better = as_read and not as_read.unreliable and leaves_most(early, as_read)
            return as_read if as_read and better else early
    refused: SmpError | None = None
    driver: DriverFit | None = None
    left = list(candidates)
    for one in in_turn(candidates):
        left = [r for r in left if r.fit is not one.fit]
        try:
            words = [*found, *fallen_back(refused, one.label)]
            plain = _stated(group, request, words, data, hold, [*left, one], refused is None)
        except (SignalError, InsufficientExcitationError) as refusal:
            if refused is None:
                other = Alternatives(_tried, group, request, found, data, hold, one.fit)
                held, driver = other.beside_model(None, True)
                if held:
                    return held
            refused = refused or refusal
            # What was refused, and what is richer, is no rival that another's answer must cover.
            most = one.fit.structure.size
            left = [replace(r, whole=r.whole and r.fit.structure.size <= most) for r in left]
            left.append(replace(one, reason=f"refused: {refusal}", whole=False))
            continue
        if refused is not None:
            return suspecting(plain, driver, one.fit)
        other = Alternatives(_tried, group, request, found, data, hold, one.fit)
        held, driver = other.instead_of(plain)
        if held or driver is None:
            return held or plain
        if driver.as_likely:  # the answer covers both
            rivals = [*left, *driver.as_likely, one]
            return _stated(group, request, words, data, hold, rivals, refused is None)
        return suspecting(plain, driver, one.fit)
    assert refused is not None
    # A load hides what the others are: with it in every candidate they may be found.
    again = not (request.loaded or request.within)
    loaded = _tried(group, replace(request, loaded=True), found) if again else None
    if loaded and not loaded.unreliable:
        return loaded
    raise refused


def _candidates(
    group: list[Record], request: Request
) -> tuple[Experiments, str, list[FittedCandidate]]:
    """Return the data, how the command was held, and what was fitted to them, the choice last."""
    base = base_structure(request, group)
    data, hold, first = chosen_hold(group, base, request.options, request.say)
    data = data.measured_as(base.speed)
    candidates = order_selection.explore(
        data, base, request.options, request.model == "auto", request.say, first
    )
    if not candidates:
        raise no_candidate(group)
    if request.driver is not None:
        candidates = beside_driver(data, request.driver, request.options, candidates)
    if explains(group, data, candidates):  # else no hold between the samples does
        data, hold, candidates = otherwise(group, base, request, data, hold, candidates)
    return data, hold, candidates


def _tried(group: list[Record], request: Request, found: Sequence[Finding]) -> Estimate | None:
    """Estimate; return nothing where that is refused."""
    try:
        return _estimated(group, request, found)
    except (SignalError, InsufficientExcitationError):
        return None


def _stated(
    group: list[Record],
    request: Request,
    found: Sequence[Finding],
    data: Experiments,
    hold: str,
    candidates: list[FittedCandidate],
    first: bool,
) -> Estimate:
    """Return what the last candidate says, and how far it can be trusted.

    Where only the lag is not known, that is said of the ``first`` candidate; others are refused.
    """
    free = candidates[-1].fit
    final = of_kind(data, free)
    chosen = constrained(final, free, request)
    fitted = validate.speed_fit(group, final, chosen)
    refuse_unexplained(group, final, chosen, fitted)
    chosen, friction_std, change = certain(final, free, chosen, request, group, hold)
    weight = candidate_weights(data, candidates)

    def said(fit: Fit) -> tuple[Answer, dict[str, float]]:
        own = answer(fit, request.known, friction_std, driven_longest(final), ways(final))
        return covering(weight, candidates, own, request.known)

    if not first:
        refuse_unidentifiable(group, chosen, said(chosen)[0])
    gear = group[0].hardware.gear_ratio
    errors = regression(final, chosen, gear, bool(change.std))
    chosen, parts = dependent(chosen, errors)
    if parts and friction_std > 0:  # which hangs on the same
        friction_std = rubbing_std(final, chosen, gear, friction_std, request.options)
    refusal = only_lag_unknown(group, chosen, said(chosen)[0])
    request.say("validating")
    own, common = validate.validated(group, request, final, chosen, hold)
    percent = FitPercent(fitted, own)
    tests = residual_tests(final, chosen)
    (result, alike), lacks = held_against_effects(
        final, chosen, gear, errors, tests.white is True, said, request.options
    )
    unknown = refusal or only_lag_unknown(group, chosen, result)
    result = without_lag(result) if unknown else result
    findings = [
        *found,
        *lag_unknown(result, unknown, data.step),
        *assess(final, chosen, FitPercent(fitted, common), tests),
        *implausible_motor(group, chosen.z),
        *lacks,
        *parts,
        *unsettled_rival(candidates, result, request.known),
        *advise(chosen, result, request.known),
        *scope(final, result, change, alike, group, chosen),
    ]
    estimate = Estimate(
        model=chosen.structure.title,
        parameters=result.parameters,
        combinations=result.combinations,
        names=result.names,
        covariance=result.covariance,
        fit_percent=percent,
        candidates=validate.candidates_of(candidates, chosen, group, data),
        residuals=tests,
        findings=tuple(findings),
        **provenance(group, data, chosen),
    )
    late = estimate.evidence("command_jitter", "delay")
    alternatives = left_open(final, chosen, weight, candidates, late)
    estimate = replace(estimate, alternatives=alternatives)
    if refusal is not None:
        refusal.estimate = estimate
        raise refusal
    return estimate
