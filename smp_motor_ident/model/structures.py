"""Candidate structures of the motor: coordinates, what each can separate, and physical meaning.

All structures are the one motor

    te q' = v(t - delay) - q - K w,    tm w' = q - be w - F(w),    F = Vc sign(w) + load

in the coordinates ``z`` below (te = L/R, tm = R J/K, be = R b/K, q = R i), with

    a0 = K + be,   a1 = tm + te be,   a2 = te tm:   w/v = 1 / (a2 s^2 + a1 s + a0).

References
----------
docs/derivations.md, section 1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident._compile import compiled

Array = NDArray[np.float64]

Z_NAMES = (
    "ln_a0",
    "ln_a1",
    "ln_a2",
    "ln_te",
    "vc_plus",
    "vc_minus",
    "load",
    "ln_r",
    "current_offset",
    "delay",
    "window",
    "current_lag",
)
"""Coordinates of the fit: logarithms of the coefficients of the response, of te and R; volts
of Coulomb friction in both directions and of load; the current's offset [A]; delay and
averaging window of the speed, mean lag of the current's sensor [s]."""
A0, A1, A2, TE, VC_PLUS, VC_MINUS, LOAD, LN_R, OFFSET, DELAY, WINDOW, CURRENT_LAG = range(12)
LOGARITHMS = (A0, A1, A2, TE, LN_R)

PHYSICAL = (
    "resistance",
    "inductance",
    "motor_constant",
    "inertia",
    "viscous_friction",
    "coulomb_friction",
)
SENSORS = ("", "averaged", "low_passed")
"""What a sensor shows of the current: its value, its mean over a trailing window of twice
`current_lag`, or a first-order low-pass of it of that time constant."""
MODELS = ("static_gain", "first_order", "second_order", "electromechanical")
"""The candidate structures, simplest first; ``_asymmetric`` may follow each name."""


@dataclass(frozen=True)
class Structure:
    """Which coordinates are free, and how the others hang on them."""

    name: str  # name of the candidate structure
    order: int = 2  # 1 (no inductance) or 2
    friction: str = "symmetric"  # coulomb friction
    current: bool = False  # whether current is an output; R is a coordinate then
    # Whether te is a coordinate; if not, be = 0 (te = a2/a1), the motor of equal response
    shape: bool = False
    # load, delay, window, offset: whether these are coordinates
    load: bool = False
    delay: bool = False
    window: bool = False
    offset: bool = False
    current_sensor: str = ""  # one of `SENSORS`
    # How the command ran: a row's value before it, after it, or interpolated from row to row
    held: str = "before"
    own_load: bool = False  # whether every segment has a constant load of its own
    # Coordinates fixed at a value (by name of `Z_NAMES`)
    fixed: Mapping[str, float] = field(default_factory=dict)

    @property
    def lags(self) -> bool:
        """Whether the measured current lags behind the current."""
        return self.current and self.current_sensor != ""

    def free(self) -> tuple[int, ...]:
        """Return the indices of the free coordinates."""
        return self._free

    @cached_property
    def _free(self) -> tuple[int, ...]:
        wanted = [A0] if self.name.startswith("static_gain") else [A0, A1]
        if self.order == 2:
            wanted += [A2] + ([TE] if self.shape or self.current else [])
        wanted += {"none": [], "symmetric": [VC_PLUS], "asymmetric": [VC_PLUS, VC_MINUS]}[
            self.friction
        ]
        for flag, index in (
            (self.load, LOAD),
            (self.current, LN_R),
            (self.offset and self.current, OFFSET),
            (self.delay, DELAY),
            (self.window, WINDOW),
            (self.lags, CURRENT_LAG),
        ):
            wanted += [index] if flag else []
        return tuple(i for i in wanted if Z_NAMES[i] not in self.fixed)

    def matrix(self) -> Array:
        """Return dz/dfree, shape (12, free), read-only: the ties between the coordinates."""
        return self._matrix

    @cached_property
    def _matrix(self) -> Array:
        free = self.free()
        m = np.zeros((len(Z_NAMES), len(free)))
        for j, i in enumerate(free):
            m[i, j] = 1.0
        if self.friction == "symmetric":
            m[VC_MINUS] = m[VC_PLUS]
        if self.order == 2 and TE not in free and "ln_te" not in self.fixed:
            m[TE] = m[A2] - m[A1]
        m.flags.writeable = False
        return m

    def complete(self, z: Array) -> Array:
        """Return z with fixed and tied coordinates put to their values."""
        z = z.copy()
        for there, index in (
            (self.load, LOAD),
            (self.offset, OFFSET),
            (self.delay, DELAY),
            (self.lags, CURRENT_LAG),
        ):
            z[index] = z[index] if there else 0.0
        for name, value in self.fixed.items():
            z[Z_NAMES.index(name)] = value
        if self.friction == "none":
            z[VC_PLUS] = z[VC_MINUS] = 0.0
        elif self.friction == "symmetric":
            z[VC_MINUS] = z[VC_PLUS]
        if self.name.startswith("static_gain"):
            z[A1] = z[A0] - 30.0
        if self.order == 2 and TE not in self.free() and "ln_te" not in self.fixed:
            z[TE] = z[A2] - z[A1]
        return z

    def with_(self, **changes: object) -> Structure:
        """Return a copy with some attributes changed."""
        return replace(self, **changes)  # type: ignore[arg-type]


def to_internal(z: Array, order: int) -> tuple[Array, Array]:
    """Map coordinates to the recursion's parameters.

    ``tm = a2/te``, ``be = a1/te - a2/te^2``, ``K = a0 - be``; first order: tm = a1, K = a0.
    """
    par = np.array(z, dtype=np.float64)
    slope = np.zeros((len(Z_NAMES), len(Z_NAMES)))
    _fill_internal(par, slope, order)
    return par, slope


@compiled
def _fill_internal(par: Array, slope: Array, order: int) -> None:
    """Turn z in par into internal parameters; what overflows becomes infinite."""
    for i in range(4, par.shape[0]):
        slope[i, i] = 1.0
    a0, a1 = math.exp(par[A0]), math.exp(par[A1])
    a2, te = math.exp(par[A2]), math.exp(par[TE])
    par[LN_R] = math.exp(par[LN_R])
    slope[2, A0] = a0
    if order == 1:
        par[0], par[1], par[2], par[3] = 0.0, a1, a0, 0.0
        slope[1, A1] = 1.0
        return
    be = (a1 - a2 / te) / te
    par[0], par[1], par[2], par[3] = te, a2 / te, a0 - be, be
    slope[0, TE] = slope[1, A2] = 1.0
    slope[1, TE] = -1.0
    slope[3, A1], slope[3, A2] = a1 / te, -a2 / te**2
    slope[3, TE] = -a1 / te + 2 * a2 / te**2
    slope[2, A1], slope[2, A2], slope[2, TE] = -slope[3, A1], -slope[3, A2], -slope[3, TE]


def combinations(z: Array, order: int) -> tuple[dict[str, float], dict[str, Array]]:
    """Return what voltage and speed tell, and its gradients by z."""
    unit = np.eye(len(Z_NAMES))
    tau = np.exp(z[A1] - z[A0])
    gain = np.exp(-z[A0])
    values = {"dc_gain": gain, "time_constant": tau}
    gradients = {"dc_gain": -gain * unit[A0], "time_constant": tau * (unit[A1] - unit[A0])}
    if order == 2:
        product = np.exp(z[A2] - z[A0])
        values["time_constant_product"] = product
        gradients["time_constant_product"] = product * (unit[A2] - unit[A0])
    for name, index in (
        ("static_voltage", VC_PLUS),
        ("static_voltage_reverse", VC_MINUS),
        ("load_voltage", LOAD),
        ("delay", DELAY),
        ("averaging_window", WINDOW),
        ("current_lag", CURRENT_LAG),
    ):
        values[name] = z[index]
        gradients[name] = unit[index]
    return {n: float(v) for n, v in values.items()}, gradients


def physical(z: Array) -> tuple[dict[str, float], dict[str, Array]]:
    """Return the physical parameters of a second-order structure and their gradients by z.

    ``L = R te``, ``K = a0 - be``, ``J = tm K/R``, ``b = be K/R``, ``Tc = Vc K/R``.
    """
    par, slope = to_internal(z, 2)
    te, tm, k, be = par[:4]
    r = par[7]
    unit = np.eye(len(Z_NAMES))
    dln_r, dk, dbe = unit[LN_R], slope[2], slope[3]
    per = k / r
    dper = dk / r - per * dln_r
    values = {
        "resistance": r,
        "inductance": r * te,
        "motor_constant": k,
        "inertia": tm * per,
        "viscous_friction": be * per,
        "coulomb_friction": z[VC_PLUS] * per,
        "coulomb_friction_reverse": z[VC_MINUS] * per,
    }
    gradients = {
        "resistance": r * dln_r,
        "inductance": r * te * (dln_r + unit[TE]),
        "motor_constant": dk,
        "inertia": tm * per * slope[1] + tm * dper,
        "viscous_friction": dbe * per + be * dper,
        "coulomb_friction": unit[VC_PLUS] * per + z[VC_PLUS] * dper,
        "coulomb_friction_reverse": unit[VC_MINUS] * per + z[VC_MINUS] * dper,
    }
    return {n: float(v) for n, v in values.items()}, gradients


def from_physical(
    resistance: float,
    inductance: float,
    motor_constant: float,
    inertia: float,
    viscous_friction: float,
    coulomb_friction: float = 0.0,
) -> Array:
    """Return the coordinates z of a motor."""
    z = np.zeros(len(Z_NAMES))
    r, k = resistance, motor_constant
    te, tm, be = inductance / r, r * inertia / k, r * viscous_friction / k
    z[A0], z[A1] = np.log(k + be), np.log(tm + te * be)
    z[A2] = np.log(max(te * tm, 1e-300))
    z[TE] = np.log(max(te, 1e-300))
    z[LN_R] = np.log(r)
    z[VC_PLUS] = z[VC_MINUS] = r * coulomb_friction / k
    return z
