"""Physical parameters from the response's coefficients, where what is fixed leaves one solution.

Derivation: docs/derivations.md, section 11.
"""

from collections.abc import Mapping

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_control.motor.parameters import PHYSICAL
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.model.coordinates import direction

RESPONSE = ("ln_a0", "ln_a1", "ln_a2")


def solved_for(
    fit: Fit, fixed: Mapping[str, float], matrix: Array, covariance: Array
) -> dict[str, tuple[float, Array]]:
    """Solve ``a(R, L, K, J, b) = a`` for what the user has not fixed, where that is unique."""
    from scipy.optimize import least_squares  # takes a while to load, and is seldom needed

    free = [n for n in PHYSICAL[:5] if n not in fixed]
    if len(free) > len(RESPONSE) or not free:
        return {}
    rows = np.array([direction(**{n: 1.0}) for n in RESPONSE]) @ matrix
    spread = rows @ covariance @ rows.T
    weight = np.asarray(np.linalg.pinv(spread, hermitian=True), dtype=np.float64)
    half = np.linalg.cholesky(weight + 1e-12 * np.trace(weight) * np.eye(len(RESPONSE))).T
    target = np.array([fit.z.value(n) for n in RESPONSE])
    furthest = max(0.02, 5 * float(np.sqrt(np.trace(spread))))
    # The equations are quadratic: with R and b known, say, two motors answer the same.
    found: list[tuple[Array, Array]] = []
    for guess in _guesses(fit, fixed, free):
        end = least_squares(  # type: ignore[operator]
            lambda x: half @ (_log_coefficients(free, x, fixed) - target), guess
        )
        miss = float(np.abs(_log_coefficients(free, end.x, fixed) - target).max())
        if miss <= furthest and not any(np.abs(end.x - x).max() < 1e-3 for x, _ in found):
            found.append((end.x, np.linalg.solve(half, end.jac)))
    if len(found) != 1:
        return {}
    x, jacobian = found[0]
    scaled = np.linalg.svd(jacobian, compute_uv=False)
    if scaled.min() < 1e-6 * scaled.max():
        return {}
    back = np.linalg.pinv(jacobian.T @ weight @ jacobian) @ jacobian.T @ weight @ rows
    out = {n: (float(np.exp(x[j])), float(np.exp(x[j])) * back[j]) for j, n in enumerate(free)}
    if "coulomb_friction" not in fixed:
        every = {**{n: v for n, (v, _) in out.items()}, **fixed}
        per = every["motor_constant"] / every["resistance"]
        row = direction(vc_plus=per) @ matrix
        value = fit.z.vc_plus * per
        for name, sign in (("motor_constant", 1), ("resistance", -1)):
            if name in out:
                row = row + sign * value * out[name][1] / out[name][0]
        out["coulomb_friction"] = (float(value), row)
    return out


def _guesses(fit: Fit, fixed: Mapping[str, float], free: list[str]) -> list[Array]:
    a0, a1, a2 = fit.z.a0, fit.z.a1, fit.z.a2
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
    p = {**{n: float(np.exp(v)) for n, v in zip(free, x, strict=True)}, **fixed}
    r, el, k = p["resistance"], p["inductance"], p["motor_constant"]
    j, b = p["inertia"], p["viscous_friction"]
    a = np.array([(r * b + k * k) / k, (r * j + el * b) / k, el * j / k])
    return np.asarray(np.log(np.maximum(a, 1e-300)))
