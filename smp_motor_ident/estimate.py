"""The entry point: records of a motor in, an `Estimate` out, or a refusal that says why."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.diagnosis import validation as validate
from smp_motor_ident.diagnosis.adequacy import adequacy, stated
from smp_motor_ident.diagnosis.advice import advise, assess
from smp_motor_ident.diagnosis.bunched import merge_bunches
from smp_motor_ident.diagnosis.limits import CANDIDATE_WEIGHT
from smp_motor_ident.diagnosis.residuals import residual_tests
from smp_motor_ident.diagnosis.screening import screen
from smp_motor_ident.errors import InsufficientExcitationError, ParameterError, SignalError
from smp_motor_ident.estimation import flexible_shaft, order_selection
from smp_motor_ident.estimation.averaging import averaged, weights
from smp_motor_ident.estimation.choice import FittedCandidate
from smp_motor_ident.estimation.consider_covariance import consider_friction, consider_timing
from smp_motor_ident.estimation.data_window import extend, grow
from smp_motor_ident.estimation.descent import Options, refine, screening_subset
from smp_motor_ident.estimation.fit import Fit, Prior
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.estimation.profile import profiled
from smp_motor_ident.estimation.quantisation import widened
from smp_motor_ident.estimation.quantities import Answer, answer
from smp_motor_ident.estimation.segments import heterogeneous
from smp_motor_ident.estimation.subset import excited
from smp_motor_ident.estimation.thinning import thinned
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood import recursion as rc
from smp_motor_ident.likelihood.experiments import Experiments, prepare
from smp_motor_ident.likelihood.hold import between_samples
from smp_motor_ident.model import structures as models
from smp_motor_ident.model.structures import MODELS, PHYSICAL, Structure
from smp_motor_ident.record import Record
from smp_motor_ident.result import Candidate, Estimate, FitPercent

Array = NDArray[np.float64]

LOSSES = {"linear": np.inf, "huber": 2.0}
FIXABLE = (*PHYSICAL, "delay", "averaging_window")
WORST_FIT = 30.0
LEAST_FIT = -100.0
LARGEST_OFFSET = 0.1
INSTANT = 0.01
MANY = 400_000
MANY_TO_PROFILE = 20_000  # samples above which as few are followed as tell the same
CLEARLY = 30.0  # deviance by which another way of holding the command must be better
FAR = 100.0  # deviance on the screening subset by which a way of holding the command is out


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
        Parameters that the user knows, by the names of `models.PHYSICAL` or ``delay``,
        ``averaging_window``; SI, at the motor shaft.
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
    if model == flexible_shaft.NAME:
        rigid = estimate(group, "second_order", fixed=fixed, loss=loss, progress=progress)
        return flexible_shaft.flexible_shaft(group, rigid)
    say = progress or (lambda _: None)
    known = _checked(model, fixed, loss, group)
    _check_bounds(bounds or {}, model, group)
    group = [merge_bunches(r) for r in group]
    findings = screen(group)
    group = [excited(r) for r in group]
    use_current = _has_current(group) and model in ("auto", "electromechanical")
    base = _structure(model, use_current, known, group)
    hold, first = _hold(group, base, LOSSES[loss], say)
    data = prepare(group, use_current, hold=hold)
    if base.window or "window" in base.fixed:
        data = data.as_mean_speed()
    options = Options(huber=LOSSES[loss])
    candidates = order_selection.explore(data, base, options, model == "auto", say, first)
    if not candidates:
        raise InsufficientExcitationError(
            f"{_where(group)}: no motor model explains these data; record 20 s or more of a "
            "square or Fourier voltage that turns the motor in both directions"
        )
    chosen = _constrain(
        _for_final(data, candidates[-1].fit), candidates[-1].fit, options, known, bounds
    )
    final = _for_final(data, chosen)
    few = thinned(final) if final.size > MANY_TO_PROFILE else final
    chosen = profiled(few, widened(final, chosen), options)
    chosen, friction_std = consider_friction(
        final, consider_timing(final, chosen, _instants(group, hold))
    )
    chosen, change = heterogeneous(final, chosen)
    result = answer(chosen, known, friction_std, _level(final))
    result, alike = _covering(data, candidates, result, known)
    fitted = validate.speed_fit(group, final, chosen)
    _refuse(group, chosen, result, fitted)
    _refuse_offset(group, chosen)
    say("validating")
    held_out = _validation(group, validation, chosen, options, hold)
    percent = FitPercent(fitted, held_out)
    tests = residual_tests(final, chosen)
    findings += [
        *assess(final, chosen, percent, tests),
        *adequacy(final, chosen, stated(chosen, result), group[0].hardware.gear_ratio, tests),
        *advise(chosen, result, known),
        *_findings(result, change, alike),
    ]
    return Estimate(
        wheel=group[0].wheel,
        model=_name(chosen.structure),
        parameters=result.parameters,
        combinations=result.combinations,
        names=result.names,
        covariance=result.covariance,
        fit_percent=percent,
        candidates=_candidates(candidates, chosen, group, data),
        residuals=tests,
        findings=tuple(findings),
        samples=data.size,
        duration=float(sum(r.duration for r in group)),
        sample_time=data.step,
        largest_voltage=max(float(np.abs(r.voltage).max()) for r in group),
        sources=tuple(dict.fromkeys(r.source for r in group if r.source)),
        hardware=group[0].hardware,
    )


def _level(data: Experiments) -> float:
    """Return the voltage [V] at which the motor was driven longest."""
    value = np.abs(data.hold_value)
    driven = data.hold_value[value > 0.5 * value.max()]
    return float(np.copysign(np.median(np.abs(driven)), driven.sum()))


def _covering(
    data: Experiments,
    candidates: Sequence[FittedCandidate],
    result: Answer,
    known: Mapping[str, float],
) -> tuple[Answer, dict[str, float]]:
    """Return the answer over all structures that explain the data as well, and their weights."""
    whole = [r for r in candidates[:-1] if r.whole and r.fit.converged]
    if data.quantum > 0:  # a speed in coarse steps is a difference of counts, by its making
        whole = [r for r in whole if r.fit.kind == candidates[-1].fit.kind]
    if not whole or result.level:
        return result, {}
    fits = [candidates[-1].fit, *(r.fit for r in whole)]
    weight = weights(lambda fit: _for_final(data, fit), fits)
    found = averaged(result, weight, [answer(f, known) for f in fits[1:]])
    labels = [candidates[-1].label, *(r.label for r in whole)]
    alike = {n: float(w) for n, w in zip(labels, weight, strict=True) if w > CANDIDATE_WEIGHT.value}
    return found, alike if len(alike) > 1 else {}


def _findings(
    result: Answer, change: Mapping[str, float], alike: Mapping[str, float]
) -> list[Finding]:
    out = []
    if alike:
        words = ", ".join(f"{name} ({100 * w:.0f} %)" for name, w in alike.items())
        out.append(
            Finding(
                "structures_alike",
                "note",
                f"the data do not decide between {words}: values and intervals cover them all",
                dict(alike),
                "sample faster, and excite with sharp steps of several sizes: a delay, an averaged "
                "speed and a second lag differ in the first samples after a step",
            )
        )
    if result.level:
        speed = result.combinations["steady_speed"]
        out.append(
            Finding(
                "one_level",
                "warning",
                f"of gain and static voltage only the steady speed at {result.level:.3g} V is "
                f"known, {speed.value:.4g} rad/s: every pair with this product "
                "dc_gain (voltage - static_voltage) moves the motor alike",
                {"voltage": result.level, "steady_speed": speed.value},
                "record two levels of voltage, or a reversal, to know gain and friction apart",
            )
        )
    if change:
        out.append(
            Finding(
                "motor_changes",
                "note",
                "parts of the recordings differ by more than their noise (temperature, friction): "
                "the intervals are those of another recording of this motor",
                dict(change),
                "let the motor warm up, or record on several days, to know how much it changes",
            )
        )
    return out


def _where(group: Sequence[Record]) -> str:
    sources = ", ".join(dict.fromkeys(r.source for r in group if r.source))
    return f"{sources or 'record'}: {group[0].wheel}"


def _checked(
    model: str, fixed: Mapping[str, float] | None, loss: str, group: Sequence[Record]
) -> dict[str, float]:
    if not group:
        raise ParameterError("estimate needs at least one record")
    if model != "auto" and model.removesuffix("_asymmetric") not in MODELS:
        raise ParameterError(f"model {model!r} is not one of auto, {', '.join(MODELS)}")
    if loss not in LOSSES:
        raise ParameterError(f"loss {loss!r} is not one of {', '.join(LOSSES)}")
    known = dict(fixed or {})
    for name, value in known.items():
        if name not in FIXABLE:
            raise ParameterError(f"fixed {name!r} is not one of {', '.join(FIXABLE)}")
        positive = name in PHYSICAL[:4] or name == "averaging_window"
        if not np.isfinite(value) or value < 0 or (positive and value == 0):
            raise ParameterError(f"fixed {name} = {value} is not a motor's")
    wheels = {r.wheel for r in group}
    if len(wheels) > 1:
        raise ParameterError(f"records of one motor are needed, got {', '.join(sorted(wheels))}")
    ohmmeter = group[0].hardware.resistance
    if "resistance" not in known and ohmmeter and np.isfinite(ohmmeter) and not _has_current(group):
        known["resistance"] = float(ohmmeter)
    return known


def _check_bounds(
    bounds: Mapping[str, tuple[float, float]], model: str, group: Sequence[Record]
) -> None:
    for name, limits in bounds.items():
        if name not in PHYSICAL:
            raise ParameterError(f"bounds of {name!r}: not one of {', '.join(PHYSICAL)}")
        if len(limits) != 2 or not limits[0] <= limits[1]:
            raise ParameterError(f"bounds of {name} = {limits}: two numbers, the lower one first")
        if model not in ("auto", "electromechanical") or not _has_current(group):
            raise ParameterError(
                f"bounds of {name}: voltage and speed alone do not tell it; record the current "
                "too, or leave the bounds out"
            )


def _has_current(group: Sequence[Record]) -> bool:
    there = [r.current for r in group if r.current is not None]
    finite = sum(int(np.isfinite(c).sum()) for c in there)
    return finite > 0.3 * sum(len(r) for r in group) and any(np.nanstd(c) > 0 for c in there)


def _structure(
    model: str, use_current: bool, known: Mapping[str, float], group: Sequence[Record]
) -> Structure:
    fixed: dict[str, float] = {}
    if "resistance" in known and (use_current or "inductance" in known):
        fixed["ln_r"] = float(np.log(known["resistance"]))
    if "resistance" in known and "inductance" in known:
        fixed["ln_te"] = float(np.log(known["inductance"] / known["resistance"]))
    if "delay" in known:
        fixed["delay"] = known["delay"]
    window = known.get("averaging_window", max(r.velocity_window for r in group))
    if window > 0:
        fixed["window"] = window
    candidate = model.removesuffix("_asymmetric")
    asymmetric = model.endswith("_asymmetric")
    friction = "asymmetric" if asymmetric else "symmetric"
    if use_current:
        return Structure(
            "electromechanical", 2, friction, current=True, load=asymmetric, fixed=fixed
        )
    if candidate in ("auto", "electromechanical"):
        candidate = "second_order"
    order = 2 if candidate == "second_order" else 1
    # How friction is felt depends on L/R, which the linear response leaves open.
    return Structure(candidate, order, friction, shape=order == 2, load=asymmetric, fixed=fixed)


def _hold(
    group: Sequence[Record], base: Structure, huber: float, say: Callable[[str], None]
) -> tuple[str, Fit | None]:
    """Choose how the command ran inside the intervals, by what explains the outputs best."""
    if base.order != 2 or "window" in base.fixed or sum(len(r) for r in group) > MANY:
        return "held", None
    plain = prepare(group, base.current)
    if plain.kind != rc.ANGLE or thinned(plain) is not plain:
        return "held", None  # how the command ran within so short an interval does not show
    others = {h: prepare(group, base.current, hold=h) for h in ("switched", "middle")}
    others = {h: d for h, d in others.items() if d.hold_end.size > plain.hold_end.size}
    if len(others) > 1 and others["switched"].held_like(others["middle"]):
        del others["middle"]
    if not others:
        return "held", None
    say("how the command was held between samples")
    options = Options(huber=huber)
    best = initial_fit(plain, base if base.current else base.with_(shape=False), options)
    if best is None:
        return "held", None
    hold = "held"
    part = screening_subset(plain)
    near = refine(part, best.structure, best, best.z, options) if part is not plain else best
    for other, data in others.items():
        part = screening_subset(data)
        allowed = near.deviance + (FAR if part is not data else -CLEARLY)
        # From the torque noise that was found it shows soon whether this is worth a full search.
        soon = grow(part, best.structure, near, options, near)
        if soon.converged and soon.deviance > allowed:
            continue
        fitted = grow(part, best.structure, near, options)
        fitted = extend(data, best.structure, fitted, options)
        if fitted.deviance < best.deviance - CLEARLY:
            hold, best = other, fitted
    return hold, best


def _instants(group: Sequence[Record], hold: str) -> float:
    """Return how well the input's instants are known [s].

    A command on a clock of its own, or jittered stamps, leave a hundredth of an interval open.
    """
    steps = np.concatenate([np.diff(r.time[:MANY]) for r in group])
    step = float(np.median(steps))
    jitter = float(np.median(np.abs(steps - step)))
    loose = hold != "held" or jitter > 1e-3 * step or any(between_samples(r) for r in group)
    return INSTANT * step if loose else 0.0


def _for_final(data: Experiments, fit: Fit) -> Experiments:
    return data.as_mean_speed() if fit.kind == rc.MEAN_SPEED else data


def _name(structure: Structure) -> str:
    return structure.name + ("_asymmetric" if structure.friction == "asymmetric" else "")


def _constrain(
    data: Experiments,
    fit: Fit,
    options: Options,
    known: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]] | None,
) -> Fit:
    """Refit under what the user holds fixed or bounded, and what physics forbids."""
    if not fit.structure.current:
        return fit
    values, _ = models.physical(fit.z)
    scale = {n: abs(values[n]) for n in PHYSICAL}
    scale["viscous_friction"] = values["motor_constant"] ** 2 / values["resistance"]
    priors = [
        Prior(n, known[n], 1e-4 * max(abs(known[n]), 1e-2 * scale[n]))
        for n in PHYSICAL
        if n in known
        and not (n == "resistance" or (n == "inductance" and "ln_te" in fit.structure.fixed))
    ]
    for name, (low, high) in (bounds or {}).items():
        if not low <= values[name] <= high:
            priors.append(Prior(name, float(np.clip(values[name], low, high)), 1e-4 * scale[name]))
    if values["viscous_friction"] < 0 and "viscous_friction" not in known:
        priors.append(
            Prior(
                "viscous_friction",
                1e-9 * scale["viscous_friction"],
                1e-4 * scale["viscous_friction"],
            )
        )
    if not priors:
        return fit
    bound = Options(options.huber, tuple(priors), options.lower, options.upper)
    return refine(data, fit.structure, fit, fit.z, bound)


def _refuse(group: Sequence[Record], fit: Fit, result: Answer, fitted: float) -> None:
    where = _where(group)
    if not np.isfinite(fitted) or fitted < WORST_FIT:
        raise SignalError(
            f"{where}: the voltage does not explain the motion (fit {fitted:.0f} %); check that "
            "voltage and encoder belong to the same motor, and that nothing else drives it"
        )
    loose = [
        n
        for n in ("dc_gain", "time_constant")
        if (q := result.combinations.get(n)) and (q.std or 0) > 0.5 * abs(q.value or 1)
    ]
    if loose:
        raise InsufficientExcitationError(
            f"{where}: the data do not tell {' and '.join(loose)}; record a longer excitation "
            "with several frequencies, in both directions and well above the friction"
        )


def _refuse_offset(group: Sequence[Record], fit: Fit) -> None:
    offset = abs(fit.z[models.OFFSET])
    if not fit.structure.offset or not fit.structure.current:
        return
    largest = max(float(np.nanmax(np.abs(r.current))) for r in group if r.current is not None)
    if offset > LARGEST_OFFSET * max(largest - offset, 1e-12):
        raise SignalError(
            f"{_where(group)}: current has an offset of {fit.z[models.OFFSET]:.3g} A where it "
            f"reaches {largest:.3g} A; zero the current sensor at rest and record again"
        )


def _validation(
    group: Sequence[Record],
    validation: Sequence[Record] | None,
    fit: Fit,
    options: Options,
    hold: str,
) -> float | None:
    if validation is not None:
        value = validate.held_out(list(validation), fit, hold)
    else:
        fitted, kept = validate.split(group)
        if not kept:
            return None
        data = _for_final(prepare(fitted, fit.structure.current, hold=hold), fit)
        if np.ptp(data.hold_value) == 0 or all(np.ptp(r.voltage) == 0 for r in kept):
            return None
        start = Fit(**{**vars(fit), "initial": data.initial})
        value = validate.held_out(kept, refine(data, fit.structure, start, fit.z, options), hold)
    return value if np.isfinite(value) else None


def _candidates(
    candidates: Sequence[FittedCandidate], chosen: Fit, group: Sequence[Record], data: Experiments
) -> tuple[Candidate, ...]:
    out = []
    for n, candidate in enumerate(candidates):
        last = n == len(candidates) - 1
        fit = chosen if last else candidate.fit
        value = validate.speed_fit(group, _for_final(data, fit), fit)
        if value < LEAST_FIT and not last:
            value = float("nan")  # a descent that left the motor behind has no fit to speak of
        out.append(
            Candidate(
                candidate.label,
                value if np.isfinite(value) else None,
                candidate.bic,
                last,
                candidate.reason,
            )
        )
    return tuple(out)
