"""What is found about a result, and what to record or measure to know more."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from smp_motor_control.motor.parameters import PHYSICAL
from smp_motor_ident.diagnosis import limits
from smp_motor_ident.diagnosis.sample_limits import FIT_WITHOUT_NOISE, LONGEST_WINDING
from smp_motor_ident.diagnosis.sensors import sensors
from smp_motor_ident.diagnosis.smoothed_friction import acceleration_noise
from smp_motor_ident.diagnosis.validation import within_resolution
from smp_motor_ident.estimation import prediction, shape_constraint
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.quantities import Answer, answer
from smp_motor_ident.estimation.selection import POLICY, FittedCandidate
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.passes import evaluate
from smp_motor_ident.model.coordinates import RINGS, Coordinates, lag_share
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.result import FitPercent, ResidualTests


def assess(data: Experiments, fit: Fit, percent: FitPercent, tests: ResidualTests) -> list[Finding]:
    """Return what speaks against an estimate, or must be known to read it.

    The held-out fit is here of the motion in the data that were fitted.
    """
    return [
        *_descent(data, fit),
        *_fit(percent, tests, within_resolution(data, fit), fit.noise_ratio > 0),
        *_resolution(data, fit, tests),
        *sensors(data, fit),
        *_second_lag(data, fit),
        *_resonance(fit),
        *_torque_noise(data, fit),
    ]


def unsettled_rival(
    candidates: Sequence[FittedCandidate], result: Answer, known: Mapping[str, float]
) -> list[Finding]:
    """Say it where a structure that explains more did not settle, and has other values.

    It is no answer; but neither is the one that it would have replaced.
    """
    chosen = candidates[-1]
    for other in candidates[:-1]:
        if (
            other.fit.converged
            or not other.whole
            or not POLICY.preferred_but_for_descent(chosen, other)
        ):
            continue
        values = answer(other.fit, known).combinations
        moved = [
            name
            for name, q in result.combinations.items()
            if q.value is not None and q.std and name in values
            and abs((values[name].value or 0.0) - q.value) > limits.HALF_WIDTH.value * q.std
        ]  # fmt: skip
        if moved:
            return [
                Finding(
                    "unsettled_rival",
                    "unreliable",
                    f"{other.label} explains the data better and did not settle; its "
                    f"{', '.join(moved)} lie outside of the intervals",
                    {"gain": chosen.fit.deviance - other.fit.deviance},
                    "record longer, with sharper and larger steps",
                )
            ]
    return []


def _descent(data: Experiments, fit: Fit) -> Iterator[Finding]:
    if fit.converged or not _unsettled(data, fit):
        return
    yield Finding(
        "not_converged",
        "unreliable",
        "the fit did not settle",
        advice="record a longer or stronger excitation",
    )


def _left_of(validation: float) -> str:
    """Return in words what of held-out data is left; more than all of them is no share."""
    if validation < 0:
        return "held-out data are left unexplained, further from the model than from their mean"
    return f"held-out data are left unexplained by {100 - validation:.0f} % of the motion"


def _fit(
    percent: FitPercent, tests: ResidualTests, closely: bool, noisy: bool
) -> Iterator[Finding]:
    """Judge the share of the motion that a model explains.

    ``closely``: as far as its sensor lets anything; ``noisy``: a torque noise explains the rest.
    """
    estimation, validation = percent.estimation or 0.0, percent.validation
    no_noise = tests.white is False and not noisy
    least = (FIT_WITHOUT_NOISE if no_noise else limits.FIT_EXPLAINS).value
    if estimation < least and not closely:
        yield Finding(
            "poor_fit",
            "unreliable",
            f"the model explains only {estimation:.0f} % of the speed"
            + (", and the rest is no noise" if no_noise else ""),
            {"fit_percent": estimation, "limit": least},
            "look for what else drives the motor; record what the driver really puts out",
        )
    if validation is not None and validation < estimation - limits.FIT_HOLDS.value:
        yield Finding(
            "validation",
            "unreliable",
            f"{_left_of(validation)}, the fitted ones by {100 - estimation:.0f} %; the "
            "motor or its load changed, or the excitation was too poor",
            {"estimation": estimation, "validation": validation},
            "record 20 s or more of one excitation under one load",
        )
    if tests.independent_of_input is False and estimation < limits.FIT_INDEPENDENT.value:
        yield Finding(
            "residual_follows_voltage",
            "warning",
            "the residuals still follow the voltage: the motor does what the model does not",
            {"fit_percent": estimation},
        )


def _resolution(data: Experiments, fit: Fit, tests: ResidualTests) -> Iterator[Finding]:
    own = data.quantum**2 / 12
    beyond = own > 0 and fit.noise_ratio == 0 and not within_resolution(data, fit)
    if data.kind == ANGLE and beyond and tests.white is False:
        times = float(np.sqrt(fit.noise[0, 0] / own))
        yield Finding(
            "beyond_resolution",
            "unreliable",
            f"the motion leaves the model by {times:.0f} times the counter's resolution, and "
            "not at random",
            {"times": times, "limit": float(np.sqrt(limits.UNEXPLAINED.value))},
            "sample faster, or look for what else drives it",
        )
    ring = _ring(fit)
    if ring * data.step > limits.RINGING.value:
        yield Finding(
            "ringing",
            "unreliable",
            f"the answer rings at {ring / (2 * np.pi):.3g} Hz, which sampling at "
            f"{1 / data.step:.4g} Hz hardly shows",
            {"radians_a_sample": ring * data.step, "limit": limits.RINGING.value},
            "sample faster",
        )


def _second_lag(data: Experiments, fit: Fit) -> Iterator[Finding]:
    """Say of a second lag that it may be none of the winding's.

    With time constants T and cT the sensor's lag is ``c / (1 + c)`` of what is stated as the
    motor's; of one that is too long for a winding's it may be the motor's own, and the first what
    answers slowly.  Counts have no filter, and of them only a long one is asked for.
    """
    if fit.structure.order != 2 or fit.structure.current:
        return
    ratio, spread = fit.log_ratio()
    if ratio - limits.HALF_WIDTH.value * spread > RINGS:  # which no lag does
        return
    share, least = (lag_share(ratio - k * spread) for k in (0.0, limits.HALF_WIDTH.value))
    second = share / (1 + share) * fit.z.time_constant
    long = share >= limits.WINDING_LAG.value or second > LONGEST_WINDING.value
    if data.kind == ANGLE:
        if not long or least < limits.RELEVANT_BIAS.value:
            return
        other = "a shaft's, a driver's, or a load's that settles slowly"
        advice = "record more steps, both ways; a drift answers to none of them"
    else:
        seen = least >= limits.RELEVANT_BIAS.value or limits.HALF_WIDTH.value * spread < 1
        if not long and not seen:
            return
        other = "a filter of the speed"
        advice = "switch the filter of the firmware off, or record encoder counts or the current"
    may_be = "long for a winding's, it may be" if long else "a winding's, or"
    yield Finding(
        "second_lag",
        "warning" if long else "note",
        f"the speed follows by two lags, the second {share:.2g} of the first: {may_be} {other}, "
        "which is no part of the motor's time constant",
        {
            "share": share,
            "limit": limits.WINDING_LAG.value,
            "quantity": "time_constant",
            "shift_share": (1.0 if long else share) / (1 + share),
        },
        advice,
    )


def _resonance(fit: Fit) -> Iterator[Finding]:
    """Say of a motor that rings beside a filter slower than it that the filter may be the motor."""
    ring, lag = _ring(fit), 0.5 * fit.z.window
    filtered = fit.structure.window and fit.structure.low_pass and not fit.structure.current
    if not filtered or ring == 0.0 or lag < fit.z.time_constant:
        return
    yield Finding(
        "compliance",
        "unreliable",
        f"the speed rings at {ring / (2 * np.pi):.3g} Hz beside a lag of {lag:.3g} s: that is "
        "likelier the motor's than a filter's, and what rings a shaft between motor and encoder",
        {"frequency": ring / (2 * np.pi), "lag": lag},
        "identify the shaft with --model flexible_shaft, or measure at the motor",
    )


def _torque_noise(data: Experiments, fit: Fit) -> Iterator[Finding]:
    if fit.noise_ratio <= 0 or data.kind != ANGLE:
        return
    if not fit.structure.current and _plain_square(data, fit):
        yield Finding(
            "plain_square",
            "unreliable",
            "a plain square tells friction from gain at its reversals alone, and a load that "
            "fluctuates hides them",
            {},
            "add a sine, a Fourier wave, or the current",
        )
    yield Finding(
        "torque_noise",
        "warning",
        "the motion scatters beyond the counter's resolution (a load that fluctuates, or a "
        "command that switches between samples)",
        {"intensity": float(fit.noise_ratio), "acceleration": acceleration_noise(fit)},
    )


def _plain_square(data: Experiments, fit: Fit) -> bool:
    """Tell whether the command goes there and back, always as far, and waits for steady speed.

    Rest before and after it does not count; two levels in quick succession are another matter.
    """
    value = data.hold_value
    driven = value[np.abs(value) > 0.05 * np.abs(value).max()]
    there, back = driven[driven > 0], -driven[driven < 0]
    if not there.size or not back.size:
        return False
    level = np.where(driven > 0, np.median(there), np.median(back))
    turns = data.hold_end[:-1][np.diff(np.sign(value)) != 0]
    return bool(
        np.mean(np.abs(np.abs(driven) - level) < limits.SQUARE_LEVEL.value * level) > 0.95
        and turns.size > 1
        and np.median(np.diff(turns)) > limits.STEADY.value * fit.z.time_constant
    )


def _ring(fit: Fit) -> float:
    """Return the frequency at which an underdamped motor rings [rad/s], else 0."""
    if fit.structure.order != 2:
        return 0.0
    z = fit.z
    return float(np.sqrt(z.a0 / z.a2)) if z.a1 * z.a1 < z.a0 * z.a2 else 0.0


def _unsettled(data: Experiments, fit: Fit) -> bool:
    """Tell whether a further step would move what is reported beyond its interval.

    A descent may end at a kink, or along L/R beside the response, which nothing reports.  At a
    kink the linear step is long and yet leads uphill: only a way that lowers the sum of squares
    by as much as such a move is worth counts.
    """
    _, step, _ = prediction.predicted_decrease(data, fit, fit.structure)
    reported = [n != "ln_te" or fit.structure.current for n in fit.structure.free]
    deviation = np.sqrt(np.diag(fit.covariance()))
    if not np.any(np.abs(step) > limits.HALF_WIDTH.value * deviation, where=reported):
        return False
    here = _least_squares(data, fit, fit.z)
    with np.errstate(all="ignore"):  # what runs away has no sum, and that is not lower
        return any(
            _least_squares(data, fit, fit.z.moved(share * fit.structure.matrix @ step))
            < here - limits.HALF_WIDTH.value**2
            for share in (1.0, 0.3, 0.1)
        )


def _least_squares(data: Experiments, fit: Fit, z: Coordinates) -> float:
    """Return the weighted sum of squares at coordinates, under the best initial states."""
    volts = {n: max(z.value(n), 0.0) for n in ("vc_plus", "vc_minus", "delay")}
    z = fit.structure.complete(z.with_(**volts))
    if shape_constraint.applies(fit.structure):
        z = shape_constraint.within(z)
    there = evaluate(data, fit.structure, z, fit.initial, fit.initial, fit.noise_model())
    return float(there.objective - there.local_decrease)


def advise(fit: Fit, result: Answer, known: Mapping[str, float]) -> Iterator[Finding]:
    """Yield what to record or measure to know what is not known."""
    missing = [n for n in PHYSICAL if result.parameters[n].status == "unidentifiable"]
    others = ", ".join(n for n in missing if n != "inductance")
    current = fit.structure.current
    if missing and not current:
        remedy = "record the motor current too; the combinations are what is known"
        if "resistance" not in known:
            remedy += "; with the resistance measured by ohmmeter one unknown less remains, yet "
            remedy += "not all can be separated without current"
        yield _note(
            "not_separable",
            f"voltage and speed alone cannot separate {', '.join(missing)}: any of a family "
            "of motors answers the same",
            remedy,
        )
    if current and "inductance" in missing:
        yield _note(
            "inductance_hidden",
            "inductance does not show at this rate",
            "sample faster or excite at higher frequency",
        )
    if current and others:
        yield _note(
            "weak_excitation",
            f"{others} cannot be identified from these data",
            f"{others}: excite harder, longer, over more frequencies and in both directions",
        )
    yield from _friction(fit)


def _friction(fit: Fit) -> Iterator[Finding]:
    free = fit.structure.free
    if "vc_plus" not in free or fit.structure.friction == "none":
        return
    i = free.index("vc_plus")
    std = float(np.sqrt(fit.covariance()[i, i]))
    if std <= limits.FRICTION_SHOWN.value * abs(fit.z.vc_plus) or std <= 0.05:
        return
    yield _note(
        "friction_hidden",
        "static friction hardly shows",
        "drive both directions, slowly through zero",
    )


def _note(code: str, message: str, advice: str) -> Finding:
    return Finding(code, "note", message, {}, advice)
