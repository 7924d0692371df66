"""Whether the model suffices: its error regressed on what real drives do beside it.

Model-error modelling: the innovations e are regressed on the sensitivities S of the model to
its own coordinates, and on the responses Z of the model to an effect that it lacks,

    e = S d + Z c,   c = (Z' M Z)^-1 Z' M e,   M = I - S (S' S)^-1 S',

tested by a Wald statistic whose covariance allows for correlated errors (sums over blocks of
samples).  What the effect did to the estimate is ``(S' S)^-1 S' Z c``: where that exceeds the
interval of a stated number, the number is unreliable.  An effect that is not shown so surely, but
that a test of the intervals' own level rejects to be nothing, is in the intervals.

References
----------
L. Ljung, System Identification, 2nd ed., section 16.6; C. Bester, T. Conley, C. Hansen,
Inference with dependent data using cluster covariance estimators, J. Econometrics 165 (2011).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import fdtrc

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis import limits
from smp_motor_ident.diagnosis.effect_regression import Regression
from smp_motor_ident.diagnosis.effects import EFFECTS, Effect
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.prediction import inverse
from smp_motor_ident.estimation.quantities import Answer
from smp_motor_ident.finding import Finding
from smp_motor_ident.model.physical import physical_gradients
from smp_motor_ident.result import Estimate, Quantity

Stated = tuple[str, Quantity, Array]
"""Name, value and gradient by the free coordinates of a number that is stated."""

INTERFACE = ("delay", "averaging_window", "current_lag")
ROUNDS = 3  # effects that are named at most


@dataclass(frozen=True, eq=False)
class Evidence:
    """One effect held against the model's error."""

    effect: Effect  # what was tried
    p_value: float  # of no such effect
    gain: float  # deviance that the effect explains
    shift: Array  # shape (f,): what it did to the free coordinates
    columns: tuple[int, ...]  # of the regressors
    size: Array = field(default_factory=lambda: np.zeros(0))  # of each


def lacking(errors: Regression | None, white: bool) -> tuple[list[list[Evidence]], list[Evidence]]:
    """Return the effects that are shown, the likeliest first, one after the other beside the ones
    before it, and what is then not excluded.
    """
    out: list[list[Evidence]] = []
    named: list[int] = []
    for _ in range(ROUNDS if errors is not None else 0):
        assert errors is not None
        left = _without(errors, named)
        tried = (_test(left, effect, columns, white) for effect, columns in left.members)
        evidence = [e for e in tried if e is not None]
        level = limits.EFFECT_LEVEL.value / max(len(evidence), 1)
        shown = [e for e in evidence if e.p_value < level]
        if not shown:
            level = limits.EFFECT_COVERED.value / max(len(evidence), 1)
            return out, [e for e in evidence if e.p_value < level]
        out.append(sorted(shown, key=lambda e: 2 * len(e.columns) - e.gain))
        named += out[-1][0].columns
    return out, []


def hidden(errors: Regression | None) -> list[Evidence]:
    """Return effects that hide in the model's own coordinates, of the size that they may have.

    That is the root of its mean square where the ordinary size is a deviation known beforehand, and
    no more than that: a misfit that is like what is left of it shows another effect as well.
    """
    return [] if errors is None else [_hidden(errors, *one) for one in errors.hidden]


def _hidden(errors: Regression, effect: Effect, column: int, ordinary: float) -> Evidence:
    z, e = errors.regressors[:, column], errors.residual
    normal = max(float(z @ z), 1e-300)
    found = float(z @ e) / normal
    scores = np.bincount(errors.block, z * (e - found * z))
    variance = max(float(e @ e) / max(np.count_nonzero(e), 1) * normal, float(scores @ scores))
    variance /= normal * normal
    kept = ordinary**2 / (ordinary**2 + variance)
    size = min(math.sqrt(kept * variance + (kept * found) ** 2), ordinary)
    chance = math.erfc(abs(found) / math.sqrt(2 * variance))
    return Evidence(
        effect, chance, 0.0, errors.shifts[:, column] * size, (column,), np.array([size])
    )


def hinted(imitated: Sequence[Evidence]) -> list[Finding]:
    """Say which effect the error asks for though the model's own coordinates nearly imitate it."""
    level = limits.EFFECT_COVERED.value / max(len(imitated), 1)
    first = min(imitated, key=lambda e: e.p_value, default=None)
    if first is None or first.p_value > level:
        return []
    message = (
        f"neither shown nor excluded: {first.effect.cause}; the motor's own numbers imitate it"
    )
    evidence: dict[str, float | str | None] = {"p_value": first.p_value}
    return [Finding(first.effect.code, "note", message, evidence, first.effect.advice)]


def farthest_possible(
    possible: Sequence[Evidence], numbers: Sequence[Stated], step: float
) -> tuple[list[Finding], Array | None]:
    """Return the move by the effect that moves a number farthest, and say so, if any does."""
    moves = [(_farthest(e, numbers, step), e) for e in possible]
    (name, times, share), far = max(moves, key=lambda m: m[0][1], default=(("", 0.0, 0.0), None))
    if far is None or times < limits.HALF_WIDTH.value:
        return [], None
    found = Finding(
        far.effect.code,
        "note",
        f"neither shown nor excluded: {far.effect.cause}; it would move {name} by {share:.2g} of "
        "its value: the intervals cover that",
        {"p_value": far.p_value, "quantity": name, "shift_share": share},
        far.effect.advice,
    )
    return [found], far.shift


def matters(shown: Evidence, numbers: Sequence[Stated], step: float) -> bool:
    """Tell whether an effect moves a number beyond its interval, by what matters."""
    return _farthest(shown, numbers, step)[1] >= limits.HALF_WIDTH.value


def _test(
    errors: Regression, effect: Effect, columns: tuple[int, ...], white: bool
) -> Evidence | None:
    """Return the Wald test of one effect; None where the data cannot tell."""
    several = list(columns)
    scale = np.sqrt(np.diag(errors.normal)[several])
    if not np.all(scale > 0):
        return None
    unit = np.outer(scale, scale)
    normal = errors.normal[np.ix_(several, several)] / unit
    values = np.linalg.eigvalsh(normal)
    if values[-1] > 1e8 * values[0]:
        return _test(errors, effect, columns[:1], white) if len(columns) > 1 else None
    moved = errors.moved[several] / scale
    size = np.linalg.solve(normal, moved)
    own = moved @ size
    whole = errors.whole[:, several] @ (size / scale)
    if own <= limits.EFFECT_OWN.value * float(
        whole @ whole
    ):  # nothing of nothing where no error is in its rows
        return None  # what is left of it is smaller than what is not known of its shape
    z = errors.regressors[:, several]
    left = errors.residual - z @ (size / scale)
    n, q = np.count_nonzero(errors.known), len(several)
    variance = float(left @ left) / max(n - q, 1)
    weights = errors.weights[:, several]
    stretches = float(np.min(weights.sum(axis=0) ** 2 / np.square(weights).sum(axis=0)))
    if stretches - q < limits.EFFECT_BLOCKS.value and not white:
        return None  # what shows it lies in a few stretches: chance cannot be excluded
    scores = errors.by_block(z * left[:, None]) / scale
    blocks = len(scores)
    robust = float(moved @ inverse(scores.T @ scores) @ moved) * (blocks - 1) / blocks / q
    plain = float(own) / variance / q
    freedom = max(stretches - q, 1.0)
    p_robust = float(fdtrc(q, freedom, robust * freedom / (freedom + q - 1)))
    p_plain = float(fdtrc(q, max(n - q, 1), plain))
    p = p_plain if stretches - q < limits.EFFECT_BLOCKS.value else max(p_robust, p_plain)
    size = size / scale
    return Evidence(effect, p, plain * q, errors.shifts[:, several] @ size, columns, size)


def _without(errors: Regression, named: Sequence[int]) -> Regression:
    """Return the regression with what was named projected out."""
    if not named:
        return errors
    q, _ = np.linalg.qr(errors.regressors[:, named])
    rest = errors.regressors - q @ (q.T @ errors.regressors)
    before = np.square(errors.regressors).sum(axis=0)
    kept = np.square(rest).sum(axis=0) > limits.EFFECT_OWN.value * before
    members = [
        (effect, columns)
        for effect, columns in errors.members
        if all(kept[c] for c in columns) and not set(columns) & set(named)
    ]
    residual = errors.residual - q @ (q.T @ errors.residual)
    return replace(errors, residual=residual, regressors=rest, members=members)


def as_finding(
    first: Evidence, shown: Sequence[Evidence], numbers: Sequence[Stated], step: float
) -> Finding:
    """Say what an effect that is shown does to the stated numbers, and what it may be else."""
    worst, times, share = _farthest(first, numbers, step)
    also = [e.effect.cause for e in shown if e is not first and e.gain > 0.8 * first.gain]
    words = " or ".join([first.effect.cause, *also[:2]])
    evidence: dict[str, float | str | None] = {
        "p_value": first.p_value,
        "explained_deviance": first.gain,
        "quantity": worst,
        "shift_std": times,
        "shift_share": share,
        "alternatives": ", ".join(e.effect.code for e in shown if e is not first) or None,
    }
    if times < limits.HALF_WIDTH.value:
        message = f"the model's error shows {words}; it moves no stated number by what matters"
        return Finding(first.effect.code, "note", message, evidence)
    return Finding(
        first.effect.code,
        "unreliable",
        f"the model's error shows {words}: it moves {worst} by {share:.2g} of its value, "
        f"{times:.1f} standard deviations",
        evidence,
        first.effect.advice,
    )


def _farthest(shown: Evidence, numbers: Sequence[Stated], step: float) -> tuple[str, float, float]:
    """Return which number an effect moves most by what matters: its deviations, and the share."""
    worst, times, share = "", 0.0, 0.0
    friction = {n: abs(q.value or 0.0) for n, q, _ in numbers}.get("static_voltage", 0.0)
    # Beside what a number that may be nothing matters: times of the interface beside the sampling
    # interval, however small they are, a load beside the friction that it adds to, and a friction
    # beside one that is next to none.
    least = {**dict.fromkeys(INTERFACE, step), "load_voltage": friction}
    least["static_voltage"] = limits.NEGLIGIBLE_FRICTION.value
    for name, quantity, row in numbers:
        if quantity.value is None or not quantity.std:
            continue
        shift = abs(float(row @ shown.shift))
        size = max(abs(quantity.value), least.get(name, 0.0), 1e-300)
        if shift > limits.RELEVANT_BIAS.value * size and shift / quantity.std > times:
            worst, times, share = name, shift / quantity.std, shift / size
    return worst, times, share


def lacks_something(estimate: Estimate) -> bool:
    """Tell whether an estimate's findings leave room for what the model lacks."""
    misfits = {effect.code for effect in EFFECTS} | {"conditions", "command_jitter"}
    return estimate.unreliable or any(f.code in misfits for f in estimate.findings)


def is_moved(estimate: Estimate) -> bool:
    """Tell whether a stated number is moved by what the model lacks, in its interval or not."""
    moved = (f.severity == "warning" and "shift_std" in f.evidence for f in estimate.findings)
    return estimate.unreliable or any(moved)


def stated(fit: Fit, result: Answer) -> list[Stated]:
    """Return the numbers that are stated, with their gradients by the free coordinates."""
    matrix = fit.structure.matrix
    known = fit.structure.combinations(fit.z)
    if fit.structure.current:
        known |= physical_gradients(fit.z)
    quantities = {**result.combinations, **result.parameters}
    return [(n, q, known[n][1] @ matrix) for n, q in quantities.items() if n in known]
