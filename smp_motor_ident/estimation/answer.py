"""From a fit to the answer: values with their certainty, or the statement that there is none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.model import structures as models
from smp_motor_ident.model.structures import PHYSICAL
from smp_motor_ident.result import UNITS, Quantity

Array = NDArray[np.float64]

LOOSE = 0.5
"""A parameter whose standard deviation exceeds this fraction of it is not identifiable."""


@dataclass(frozen=True, eq=False)
class Answer:
    """Quantities of one fit.

    Attributes
    ----------
    parameters, combinations : dict of str to Quantity
        As in `result.Estimate`.
    names : tuple of str
        Of the covariance.
    covariance : ndarray, shape (p, p)
        Joint, over parameters and combinations.
    loose : tuple of str
        Parameters that the structure has but these data do not tell.
    """

    parameters: dict[str, Quantity]
    combinations: dict[str, Quantity]
    names: tuple[str, ...]
    covariance: Array
    loose: tuple[str, ...] = field(default=())


def answer(fit: Fit, fixed: Mapping[str, float], unseen_friction: float = 0.0) -> Answer:
    """Turn a fit into quantities.

    Parameters
    ----------
    fit : Fit
        Of any structure.
    fixed : mapping of str to float
        What the user gave.
    unseen_friction : float
        Standard deviation of a friction that the structure leaves out [V].

    Returns
    -------
    Answer
        Physical parameters are there for current, or where ``fixed`` leaves one solution.
    """
    structure = fit.structure
    matrix = structure.matrix()
    cov = fit.covariance()
    values: dict[str, float] = {}
    rows: dict[str, Array] = {}
    combination_values, gradients = models.combinations(fit.z, structure.order)
    reported = _reported(structure)
    for name in reported:
        values[name] = combination_values[name]
        rows[name] = gradients[name] @ matrix
    known, loose = _physical_rows(fit, fixed, matrix, cov)
    for name, (value, row) in known.items():
        values[name], rows[name] = value, row
    names = tuple(values)
    stacked = np.array([rows[n] for n in names]).reshape(len(names), matrix.shape[1])
    joint = stacked @ cov @ stacked.T
    if unseen_friction > 0:
        joint += np.diag(np.square([_friction(n, fit) * unseen_friction for n in names]))
    std = np.sqrt(np.maximum(np.diag(joint), 0.0))
    spread = dict(zip(names, std))
    combinations = {n: _quantity(n, values[n], spread[n]) for n in reported}
    parameters: dict[str, Quantity] = {}
    for name in PHYSICAL:
        if name in fixed:
            parameters[name] = Quantity(float(fixed[name]), unit=UNITS[name], status="fixed")
        elif name in known and not _too_loose(name, values[name], spread[name], fit):
            parameters[name] = _quantity(name, values[name], spread[name])
        else:
            if name in known:
                loose.append(name)
            parameters[name] = Quantity(None, unit=UNITS[name], status="unidentifiable")
    for name in ("coulomb_friction_reverse",):
        if name in known and structure.friction == "asymmetric":
            parameters[name] = _quantity(name, values[name], spread[name])
    if "delay" in reported:
        if "delay" in fixed:
            parameters["delay"] = Quantity(fixed["delay"], unit="s", status="fixed")
        else:
            parameters["delay"] = combinations["delay"]
    keep = [
        i
        for i, n in enumerate(names)
        if n in combinations or (n in parameters and parameters[n].status == "estimated")
    ]
    return Answer(
        parameters,
        combinations,
        tuple(names[i] for i in keep),
        joint[np.ix_(keep, keep)],
        tuple(loose),
    )


def _friction(name: str, fit: Fit) -> float:
    """Return how much of a quantity a volt of Coulomb friction is."""
    if name == "coulomb_friction" and fit.structure.current:
        values, _ = models.physical(fit.z)
        return values["motor_constant"] / values["resistance"]
    return float(name == "static_voltage")


def _reported(structure: models.Structure) -> list[str]:
    names = ["dc_gain"]
    if not structure.name.startswith("static_gain"):
        names.append("time_constant")
    if structure.order == 2:
        names.append("time_constant_product")
    names.append("static_voltage")
    if structure.friction == "asymmetric":
        names.append("static_voltage_reverse")
    if structure.load:
        names.append("load_voltage")
    if structure.delay or "delay" in structure.held:
        names.append("delay")
    if structure.window or "window" in structure.held:
        names.append("averaging_window")
    return names


def _physical_rows(
    fit: Fit, fixed: Mapping[str, float], matrix: Array, cov: Array
) -> tuple[dict[str, tuple[float, Array]], list[str]]:
    """Return value and gradient (by the free coordinates) of each parameter that is told."""
    # R and L known and L/R held: what is left follows from the coefficients one by one.
    electric = {"ln_r", "ln_te"} <= set(fit.structure.held)
    if (fit.structure.current or electric) and fit.structure.order == 2:
        values, gradients = models.physical(fit.z)
        if values["motor_constant"] <= 0:
            return {}, []
        return {n: (values[n], gradients[n] @ matrix) for n in values if n not in fixed}, []
    if fit.structure.order != 2:
        return {}, []
    return _from_combinations(fit, fixed, matrix, cov), []


def _from_combinations(
    fit: Fit, fixed: Mapping[str, float], matrix: Array, cov: Array
) -> dict[str, tuple[float, Array]]:
    """Solve ``a(R, L, K, J, b) = a`` for what the user has not fixed, where that is unique."""
    free = [n for n in PHYSICAL[:5] if n not in fixed]
    rows = np.eye(11)[[models.A0, models.A1, models.A2]] @ matrix
    if len(free) > 3 or not free:
        return {}
    weight = np.asarray(np.linalg.pinv(rows @ cov @ rows.T, hermitian=True), dtype=np.float64)
    target = fit.z[[models.A0, models.A1, models.A2]]
    # The equations are quadratic: with R and b known, say, two motors answer the same.
    found: list[tuple[Array, Array]] = []
    for guess in _guesses(fit, fixed, free):
        x, jacobian, miss = _newton(guess, target, weight, free, fixed)
        if miss > max(0.02, 5 * float(np.sqrt(np.trace(rows @ cov @ rows.T)))):
            continue
        if not any(np.abs(x - other).max() < 1e-3 for other, _ in found):
            found.append((x, jacobian))
    if len(found) != 1:
        return {}
    x, jacobian = found[0]
    scaled = np.linalg.svd(jacobian, compute_uv=False)
    if scaled.min() < 1e-6 * scaled.max():
        return {}
    back = np.linalg.pinv(jacobian.T @ weight @ jacobian) @ jacobian.T @ weight @ rows
    out = {n: (float(np.exp(x[j])), float(np.exp(x[j])) * back[j]) for j, n in enumerate(free)}
    every = {**{n: v for n, (v, _) in out.items()}, **fixed}
    if "coulomb_friction" not in fixed:
        per = every["motor_constant"] / every["resistance"]
        row = np.eye(11)[models.VC_PLUS] @ matrix * per
        value = fit.z[models.VC_PLUS] * per
        for name, sign in (("motor_constant", 1), ("resistance", -1)):
            if name in out:
                row = row + sign * value * out[name][1] / out[name][0]
        out["coulomb_friction"] = (float(value), row)
    return out


def _newton(
    x: Array, target: Array, weight: Array, free: list[str], fixed: Mapping[str, float]
) -> tuple[Array, Array, float]:
    """Return the logarithms that come nearest, the Jacobian there, and the largest miss."""
    jacobian = np.zeros((3, len(free)))
    for _ in range(60):
        have = _log_coefficients(free, x, fixed)
        for j in range(len(free)):
            step = np.zeros(len(free))
            step[j] = 1e-6
            jacobian[:, j] = (_log_coefficients(free, x + step, fixed) - have) / 1e-6
        normal = jacobian.T @ weight @ jacobian
        move = np.linalg.pinv(normal, rcond=1e-12) @ jacobian.T @ weight @ (target - have)
        x = x + np.clip(move, -1, 1)
        if np.abs(move).max() < 1e-10:
            break
    miss = np.abs(_log_coefficients(free, x, fixed) - target).max()
    return x, jacobian, float(miss) if np.isfinite(miss) else np.inf


def _guesses(fit: Fit, fixed: Mapping[str, float], free: list[str]) -> list[Array]:
    a0, a1, a2 = np.exp(fit.z[:3])
    r = fixed.get("resistance", 1.0)
    out = []
    for share in (0.03, 0.3, 0.7, 0.97):
        for part in (1.0, 0.2):
            k = fixed.get("motor_constant", share * a0)
            guess = {
                "resistance": r,
                "inductance": a2 * r / a1 / part,
                "motor_constant": k,
                "inertia": part * a1 * k / r,
                "viscous_friction": max(a0 - k, 0.03 * a0) * k / r,
            }
            out.append(np.log(np.array([guess[n] for n in free], dtype=np.float64)))
    return out


def _log_coefficients(free: list[str], x: Array, fixed: Mapping[str, float]) -> Array:
    p = {**{n: float(np.exp(v)) for n, v in zip(free, x)}, **fixed}
    r, el, k = p["resistance"], p["inductance"], p["motor_constant"]
    j, b = p["inertia"], p["viscous_friction"]
    a = np.array([(r * b + k * k) / k, (r * j + el * b) / k, el * j / k])
    return np.asarray(np.log(np.maximum(a, 1e-300)))


def _too_loose(name: str, value: float, std: float, fit: Fit) -> bool:
    """Decide from the certainty; friction near nothing, known to be so, is an answer."""
    if not np.isfinite(std) or not np.isfinite(value):
        return True
    if std < LOOSE * abs(value):
        return False
    values, _ = models.physical(fit.z)
    per = values["motor_constant"] / values["resistance"]
    if name.startswith("coulomb_friction"):
        return std > 0.05 * per * max(1.0, 0.0)
    if name == "viscous_friction":
        return std > 0.02 * per * float(np.exp(fit.z[models.A0]))
    return True


def _quantity(name: str, value: float, std: float) -> Quantity:
    half = 1.96 * std
    low = value - half
    if name != "load_voltage":
        low = max(low, 0.0)
    return Quantity(float(value), float(std), (float(low), float(value + half)), UNITS[name])
