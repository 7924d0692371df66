"""By how much the numbers move where the motor is estimated beside what its model lacks.

A regression of the model's error names an effect and its size at the estimate.  With that put into
what is given to the model the motor is fitted again, and its error may show a rest of the effect
(Gauss-Newton steps) or another one.  Where, after a few of them, nothing that is shown moves a
number beyond its interval, the first estimate was off by as much as these moved it: with that move
as a standard deviation, and with the farthest by any other effect that is shown, its intervals hold
the motor.  Where something stays, nobody knows how much.

References
----------
L. Ljung, System Identification, 2nd ed., section 16.6 (model-error modelling).
"""

from collections.abc import Callable
from dataclasses import replace

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.adequacy import (
    Evidence,
    as_finding,
    farthest_possible,
    hidden,
    hinted,
    lacking,
    matters,
    stated,
)
from smp_motor_ident.diagnosis.effect_regression import Regression
from smp_motor_ident.diagnosis.effects import EFFECTS
from smp_motor_ident.diagnosis.misfit import Said, widened_by_misfit
from smp_motor_ident.diagnosis.model_error import motions, regression, signals
from smp_motor_ident.diagnosis.noise_or_effect import in_place_of_noise
from smp_motor_ident.diagnosis.residuals import residual_tests
from smp_motor_ident.estimation import data_window
from smp_motor_ident.estimation.consider_covariance import consider_current_lag, consider_hold
from smp_motor_ident.estimation.descent import refine
from smp_motor_ident.estimation.fit import Fit, Options
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments

STEPS = 4  # in which effects are put in at most


def held_against_effects(
    data: Experiments,
    fit: Fit,
    gear: float,
    errors: Regression | None,
    white: bool,
    said: Callable[[Fit], Said],
    options: Options,
) -> tuple[Said, list[Finding]]:
    """Return what is stated, as wide as what the model lacks asks for, and name that."""
    first = said(fit)[0]
    numbers = stated(fit, first)
    shown, possible = lacking(errors, white)
    # Of one level no line is stated that could be bent.
    imitated = [] if first.level else hidden(errors)
    possible += imitated
    begin = data, fit, errors
    grave = any(matters(e[0], numbers, data.step) for e in shown)
    if not grave and (instead := in_place_of_noise(data, fit, gear, options)):
        evidence, there, now = instead
        if matters(evidence, numbers, data.step):
            grave, begin, shown = True, (there, now, None), [*shown, [evidence]]
    notes, move = farthest_possible(possible, numbers, data.step)
    wide = fit if move is None else fit.along(move)
    notes = notes or hinted(imitated)
    if shown:
        wide = consider_hold(data, wide)
    if any(e[0].effect.code == "current_lag" for e in shown):
        wide = consider_current_lag(wide)
    move = _move(begin, wide, gear, said, options) if grave else None
    if move is not None:  # and by what else is shown, of which any may be the one
        other = farthest_possible([e for alike in shown for e in alike], numbers, data.step)[1]
        wide = wide.along(move) if other is None else wide.along(move).along(other)
    answer, beside = widened_by_misfit(data, wide, said, options)
    held = stated(wide, answer[0])
    named = (
        _covered(as_finding(e[0], e, numbers, data.step))
        if move is not None
        else as_finding(e[0], e, held, data.step)
        for e in shown
    )
    return answer, [*named, *notes, *beside]


def _covered(found: Finding) -> Finding:
    """Return a finding of an effect whose move is in the intervals."""
    if found.severity == "note":
        return found
    message = f"{found.message}: the intervals cover that"
    return replace(found, severity="warning", message=message)


def _move(
    begin: tuple[Experiments, Fit, Regression | None],
    fit: Fit,
    gear: float,
    said: Callable[[Fit], Said],
    options: Options,
) -> Array | None:
    """Return by how much the coordinates move beside effects that leave nothing; None if none do.

    A current that is off is left out instead, and a number that would be lost is kept as it is.
    """
    there, now, errors = begin
    first, changing = said(fit)[0], errors is not None and errors.changing
    for _ in range(STEPS):
        errors = errors or regression(there, now, gear, changing)
        move = fit.structure.of_free(now.z.array - fit.z.array)
        wide = fit.along(move)
        answer = said(wide)[0]
        values = {n for n, q in first.combinations.items() if q.value is not None}
        if any(answer.combinations[n].value is None for n in values):
            return None
        numbers = stated(wide, answer)
        shown, _ = lacking(errors, residual_tests(there, now).white is True)
        left = next((e[0] for e in shown if matters(e[0], numbers, there.step)), None)
        if left is None:
            return move
        if left.effect.place == "current":
            return None
        there = _with(there, now, left, gear)
        before, errors = now, None
        now = _fitted(there, now, options)
        if not (now.converged and now.deviance < before.deviance):
            return None
    return None


def _fitted(data: Experiments, fit: Fit, options: Options) -> Fit:
    """Return the motor fitted to other data, under a torque noise of their own if that fits."""
    near = refine(data, fit.structure, fit, fit.z, options)
    if fit.noise_ratio <= 0:
        return near
    return min(near, data_window.grow(data, fit.structure, fit, options), key=lambda f: f.deviance)


def _with(data: Experiments, fit: Fit, shown: Evidence, gear: float) -> Experiments:
    """Return experiments in which the model finds an effect as a part of what is given."""
    sections, samples = motions(data, fit, gear)
    made = [signal for effect in EFFECTS for signal in signals(effect, sections, samples)]
    for column, size in zip(shown.columns, shown.size, strict=True):
        data = made[column].within(data, float(size))
    return data
