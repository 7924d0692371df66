# SPDX-License-Identifier: Apache-2.0
"""From a chain's parameters to quantities of the motor, with their derivatives."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.chain.chain import Chain
from smp_motor_ident.simulate import lanes as at

REPORTED: Mapping[str, str] = {
    "delay": "delay", "load": "load_voltage", "sensor_lag": "sensor_lag",
    "window": "averaging_window", "dead_zone": "dead_zone", "least_command": "least_command",
    "clip_voltage": "clip_voltage",
    "source_resistance_ratio": "source_resistance_ratio", "brush_drop": "brush_drop",
    "current_limit_voltage": "current_limit_voltage", "quadratic_drag": "quadratic_drag",
    "fast_decay_ratio": "fast_decay_ratio", "coasting_share": "coasting_share",
    "current_lag": "current_lag", "eccentricity": "encoder_error",
}  # fmt: skip
"""Parameters that are reported as they are."""


HIDDEN = ("electrical_time_constant", "back_emf_constant")
"""Quantities that constraints use and no answer states."""


def quantities(
    chain: Chain, values: Mapping[str, float], level: float = 0.0, resistance: float = 0.0
) -> dict[str, float]:
    """Return all quantities of a motor, SI at the motor shaft.

    With a ``level`` [V] given, the steady speed at it is one of them.  With a ``resistance`` given,
    those that no current separates are.
    """
    lanes = chain.lanes({n: np.array([v]) for n, v in values.items()}, 1)[:, 0]
    te, tm, k, be = (float(lanes[n]) for n in (at.TE, at.TM, at.K, at.BE))
    a0 = k + be
    out = {
        "dc_gain": 1 / a0,
        "time_constant": (tm + te * be) / a0,
        "time_constant_product": te * tm / a0,
        "static_voltage": float(lanes[at.VC_PLUS]),
    }
    if chain.has("asymmetric_friction"):
        out["static_voltage_reverse"] = float(lanes[at.VC_MINUS])
    out |= {REPORTED[n]: v for n, v in values.items() if n in REPORTED}
    if level:
        held = math.copysign(float(lanes[at.VC_PLUS]), level) + float(lanes[at.LOAD])
        out["steady_speed"] = (level - held) / a0
    out |= {"electrical_time_constant": te, "back_emf_constant": k}
    if "ln_r" in values or resistance:
        r = float(np.exp(values["ln_r"])) if "ln_r" in values else resistance
        out |= {
            "resistance": r, "inductance": r * te, "motor_constant": k, "inertia": tm * k / r,
            "viscous_friction": be * k / r, "coulomb_friction": float(lanes[at.VC_PLUS]) * k / r,
        }  # fmt: skip
    return out


def jacobian(
    chain: Chain, level: float = 0.0, resistance: float = 0.0
) -> tuple[dict[str, float], Array]:
    """Return quantities and their derivatives by the free parameters, shape (quantities, p)."""
    base = quantities(chain, chain.values, level, resistance)
    rows = np.empty((len(base), len(chain.free)))
    for j, p in enumerate(chain.free):
        d = 1e-6 * max(abs(chain.values[p.name]), 1e-6) if p.unit != "ln" else 1e-6
        up, down = (
            quantities(chain, {**chain.values, p.name: chain.values[p.name] + s}, level, resistance)
            for s in (d, -d)
        )
        rows[:, j] = [(up[n] - down[n]) / (2 * d) for n in base]
    return base, rows
