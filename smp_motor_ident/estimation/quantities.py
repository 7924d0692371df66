"""From a fit to quantities: values with their certainty, or the statement that there is none.

Derivation: docs/derivations.md, sections 9 and 11.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_control.motor.parameters import PHYSICAL
from smp_motor_ident.diagnosis import limits
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.coordinates import Coordinates, direction
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.model.physical import physical, physical_gradients
from smp_motor_ident.model.structure import Gradients
from smp_motor_ident.model.structures import Structure
from smp_motor_ident.result import NORMAL_95, UNITS, Quantity

TRADED = ("dc_gain", "static_voltage", "static_voltage_reverse", "load_voltage")
"""Of a steady speed at one level of voltage only ``dc_gain (level - static_voltage)`` is known."""
FILTERS = ("averaging_window", "sensor_lag")
"""What the record, the user or a difference of counts may give of a speed's filter."""


@dataclass(frozen=True, eq=False)
class Answer:
    """Quantities of one fit."""

    # parameters, combinations: as in `result.Estimate`
    parameters: dict[str, Quantity]
    combinations: dict[str, Quantity]
    names: tuple[str, ...]  # of the covariance
    covariance: Array  # shape (p, p): joint, over parameters and combinations
    # Parameters that the structure has but these data do not identify
    loose: tuple[str, ...] = field(default=())
    # The voltage [V] that ``steady_speed`` belongs to, 0 where that is not reported
    level: float = 0.0


@dataclass(frozen=True, eq=False)
class _Values:
    """Values, gradients by the free coordinates, and differences to both ends of each profile."""

    value: dict[str, float]
    row: dict[str, Array]
    ends: dict[str, list[tuple[float, float]]]

    def covariance(self, conditional: Array) -> Array:
        """Return the joint covariance: linear beside the profiles, their secants along them."""
        rows = np.array([self.row[n] for n in self.value]).reshape(len(self.value), -1)
        joint = rows @ conditional @ rows.T
        for k in range(len(next(iter(self.ends.values()), []))):
            pairs = np.array([self.ends[n][k] for n in self.value])
            # Each quantity to the end at which it moves most; the ends lie on opposite sides.
            farther = np.argmax(np.abs(pairs), axis=1)
            secant = pairs[np.arange(len(pairs)), farther] * (1.0 - 2.0 * farther) / NORMAL_95
            joint = joint + np.outer(secant, secant)
        return np.asarray(joint)

    def interval(self, name: str, conditional: Array) -> tuple[float, float]:
        """Return the 95 % interval: the ends of all profiles and the rest, in quadrature."""
        rest = NORMAL_95**2 * max(float(self.row[name] @ conditional @ self.row[name]), 0.0)
        low = high = rest
        for pair in self.ends[name]:
            low += min(0.0, *pair) ** 2
            high += max(0.0, *pair) ** 2
        return self.value[name] - float(np.sqrt(low)), self.value[name] + float(np.sqrt(high))


def answer(
    fit: Fit,
    fixed: Mapping[str, float],
    friction_std: float = 0.0,
    level: float = 0.0,
    turns: Array | None = None,
) -> Answer:
    """Turn a fit into quantities.

    ``level``: the voltage [V] at which the motor was driven longest; ``turns``: the `ways` in which
    it turned.
    """
    structure, conditional = fit.structure, fit.conditional()
    reported = list(structure.separates())
    values = _values(fit, fixed, reported, level)
    joint = values.covariance(conditional)
    if friction_std > 0:
        joint += np.diag(np.square([_friction(n, fit) * friction_std for n in values.value]))
    if "delay" in values.value:  # whole intervals are known no better than instants are
        at = list(values.value).index("delay")
        joint[at, at] += (limits.INSTANT.value * structure.shift) ** 2
    spread = dict(zip(values.value, np.sqrt(np.maximum(np.diag(joint), 0.0)), strict=True))
    # Where each segment turns one way, of friction and its own load only the sum is known.
    held = turns is not None and structure.own_load and bool(turns.all())
    # At the upper end of what it may be, a gain of any size seems known: the middle tells, too.
    gain = min(values.value["dc_gain"], float(np.mean(values.interval("dc_gain", conditional))))
    one_level = spread["dc_gain"] > limits.LOOSE_QUANTITY.value * gain
    combinations = {}
    for name in reported:
        of_counts = name == "averaging_window" and structure.mean > 0
        if (name in FILTERS and "window" in structure.fixed) or of_counts:
            combinations[name] = Quantity(values.value[name], unit=UNITS[name], status="fixed")
            continue
        interval = values.interval(name, conditional)
        if held and turns is not None and name == "static_voltage":
            most = fit.z.vc_plus + float(np.max(turns * fit.initial[:, 3]))
            share = NORMAL_95 * spread["dc_gain"] / values.value["dc_gain"]  # of the voltage
            interval = 0.0, max(most, 0.0) + share * abs(level)
        elif friction_std > 0 or (name == "delay" and structure.shift > 0):
            reach = NORMAL_95 * spread[name]
            interval = values.value[name] - reach, values.value[name] + reach
        lost = (one_level and name in TRADED) or (held and name == "static_voltage")
        if lost or _hidden(name, values.value[name], spread[name], fit):
            combinations[name] = Quantity(None, None, _positive(name, interval), UNITS[name],
                                          "unidentifiable")  # fmt: skip
        elif name != "steady_speed" or one_level:
            combinations[name] = _quantity(name, values.value[name], spread[name], interval)
    mixed = ("coulomb_friction",) if held else ()
    parameters, loose = _parameters(fit, fixed, values, spread, combinations, mixed)
    keep = [
        i
        for i, n in enumerate(values.value)
        if (q := combinations.get(n) or parameters.get(n)) is not None and q.status == "estimated"
    ]
    names = tuple(values.value)
    return Answer(
        parameters,
        combinations,
        tuple(names[i] for i in keep),
        joint[np.ix_(keep, keep)],
        loose,
        level if one_level else 0.0,
    )


def without_lag(result: Answer) -> Answer:
    """Return an answer that leaves open how slow the motor is."""
    hidden: dict[str, Quantity] = {
        name: Quantity(None, None, result.combinations[name].ci95, UNITS[name], "unidentifiable")
        for name in ("time_constant", "time_constant_product")
        if name in result.combinations
    }
    keep = [i for i, n in enumerate(result.names) if n not in hidden]
    return replace(
        result,
        combinations={**result.combinations, **hidden},
        names=tuple(result.names[i] for i in keep),
        covariance=result.covariance[np.ix_(keep, keep)],
    )


def _values(fit: Fit, fixed: Mapping[str, float], reported: list[str], level: float) -> _Values:
    matrix = fit.structure.matrix
    there = _at(fit.z, fit.structure, level)
    value = {n: there[n][0] for n in reported}
    row = {n: there[n][1] @ matrix for n in reported}
    known = _physical_rows(fit, fixed, matrix)
    value |= {n: v for n, (v, _) in known.items()}
    row |= {n: r for n, (_, r) in known.items()}
    ends: dict[str, list[tuple[float, float]]] = {n: [] for n in value}
    for profile in fit.profiles:
        sides = []
        for z in profile.ends:
            moved = {n: v for n, (v, _) in _at(z, fit.structure, level).items()}
            if fit.structure.current:
                moved |= physical(z)
            step = fit.structure.of_free(z.array - fit.z.array)
            sides.append({n: moved[n] - value[n] if n in moved else row[n] @ step
                          for n in value})  # fmt: skip
        for n in value:
            ends[n].append((float(sides[0][n]), float(sides[1][n])))
    return _Values(value, row, ends)


def _at(z: Coordinates, structure: Structure, level: float) -> Gradients:
    """Return the combinations of coordinates, the steady speed at a level among them."""
    found = structure.combinations(z)
    friction = "vc_plus" if level >= 0 else "vc_minus"
    sign = float(np.copysign(1.0, level))
    net = level - sign * z.value(friction) - z.load
    gradient = net * found["dc_gain"][1] - z.dc_gain * direction(**{friction: sign, "load": 1.0})
    return {**found, "steady_speed": (z.dc_gain * net, gradient)}


def _parameters(
    fit: Fit,
    fixed: Mapping[str, float],
    values: _Values,
    spread: Mapping[str, float],
    combinations: Mapping[str, Quantity],
    mixed: tuple[str, ...],
) -> tuple[dict[str, Quantity], tuple[str, ...]]:
    parameters: dict[str, Quantity] = {}
    loose = []
    conditional = fit.conditional()
    names = list(PHYSICAL)
    if fit.structure.friction == "asymmetric" and "coulomb_friction_reverse" in values.value:
        names.append("coulomb_friction_reverse")
    for name in names:
        if name in fixed:
            parameters[name] = Quantity(float(fixed[name]), unit=UNITS[name], status="fixed")
        elif (
            name in values.value
            and name not in mixed
            and not _too_loose(name, values.value[name], spread[name], fit)
        ):
            interval = values.interval(name, conditional)
            parameters[name] = _quantity(name, values.value[name], spread[name], interval)
        else:
            loose += [name] if name in values.value else []
            parameters[name] = Quantity(None, unit=UNITS[name], status="unidentifiable")
    if "delay" in fixed:
        parameters["delay"] = Quantity(fixed["delay"], unit="s", status="fixed")
    elif "delay" in combinations:
        parameters["delay"] = combinations["delay"]
    return parameters, tuple(loose)


def _hidden(name: str, value: float, std: float, fit: Fit) -> bool:
    """Tell whether a product of lags is that of an inductance that does not show.

    The logarithm of a second lag of next to nothing ends where the descent stopped, far below all
    that the data could tell.
    """
    if name != "time_constant_product" or not std > limits.LOOSE_QUANTITY.value * abs(value):
        return False
    return fit.structure.current or value < limits.HIDDEN_LAG.value * fit.z.time_constant**2


def _friction(name: str, fit: Fit) -> float:
    """Return how much of a quantity a volt of Coulomb friction is."""
    if name == "coulomb_friction" and fit.structure.current:
        values = physical(fit.z)
        return values["motor_constant"] / values["resistance"]
    return float(name == "static_voltage")


def _physical_rows(
    fit: Fit, fixed: Mapping[str, float], matrix: Array
) -> dict[str, tuple[float, Array]]:
    """Return value and gradient (by the free coordinates) of each identifiable parameter."""
    # R and L known and L/R fixed: what is left follows from the coefficients one by one.
    electric = {"ln_r", "ln_te"} <= set(fit.structure.fixed)
    if fit.structure.order != 2:
        return {}
    if fit.structure.current or electric:
        known = physical_gradients(fit.z)
        if known["motor_constant"][0] <= 0:
            return {}
        return {n: (value, row @ matrix) for n, (value, row) in known.items() if n not in fixed}
    return solved_for(fit, fixed, matrix, fit.covariance())


def _too_loose(name: str, value: float, std: float, fit: Fit) -> bool:
    """Decide from the certainty; friction near nothing, known to be so, is an answer."""
    if not np.isfinite(std) or not np.isfinite(value):
        return True
    if std < limits.LOOSE_QUANTITY.value * abs(value):
        return False
    values = physical(fit.z)
    per = values["motor_constant"] / values["resistance"]
    if name.startswith("coulomb_friction"):
        return std > limits.NEGLIGIBLE_FRICTION.value * per
    if name == "viscous_friction":
        return std > 0.02 * per * fit.z.a0
    return True


def _positive(name: str, interval: tuple[float, float]) -> tuple[float, float]:
    """Return an interval without what a quantity cannot be."""
    if name in ("load_voltage", "steady_speed"):
        return interval
    return max(interval[0], 0.0), interval[1]


def _quantity(name: str, value: float, std: float, interval: tuple[float, float]) -> Quantity:
    return Quantity(float(value), float(std), _positive(name, interval), UNITS[name])


def driven_longest(data: Experiments) -> float:
    """Return the voltage [V] at which the motor was driven longest."""
    value = np.abs(data.hold_value)
    driven = data.hold_value[value > 0.5 * value.max()]
    return float(np.copysign(np.median(np.abs(driven)), driven.sum()))


def ways(data: Experiments) -> Array:
    """Return which way the motor turns in each segment, shape (g,): 1, -1, or 0 where both ways."""
    moved = [
        np.nan_to_num(np.diff(data.output[a:b]) if data.kind == ANGLE else data.output[a:b])
        for a, b in pairwise(data.starts)
    ]
    net, gross = (np.array([f(m).sum() for m in moved]) for f in (np.asarray, np.abs))
    return np.where(np.abs(net) >= (1 - 2 * limits.REST.value) * gross, np.sign(net), 0.0)


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
