# SPDX-License-Identifier: Apache-2.0
"""Describe an estimate's records, their noise, and the chosen chain."""

from __future__ import annotations

from typing import Any

import numpy as np

from smp_motor_ident.infer.findings import EstimateContext
from smp_motor_ident.quality.differenced import read_count_rounding
from smp_motor_ident.quality.resolution import speed_quantum
from smp_motor_ident.result import Candidate


def describe_provenance(context: EstimateContext) -> dict[str, Any]:
    """Describe the records and the model of an `Estimate`, field by field."""
    group, data, chain = context.group, context.data, " + ".join(context.found.chain.codes)
    return {
        "candidates": (Candidate(chain, context.percent.estimation, context.found.deviance, True),),
        "wheel": group[0].wheel,
        "model": name_model(context),
        "duration": float(sum(r.duration for r in group)),
        "largest_voltage": max(float(np.abs(r.voltage).max()) for r in group),
        "sources": tuple(dict.fromkeys(r.source for r in group if r.source)),
        "hardware": group[0].hardware,
        "samples": len(data),
        "sample_time": data.rows.step,
        "speed_noise": 0.0 if data.is_angle else float(context.found.noise[0].deviation[-1]),
        "speed_step": _find_speed_step(context),
        "angle_noise": _find_angle_noise(context),
    }


def name_model(context: EstimateContext) -> str:
    """Return the structure of the motor that the data determine."""
    if context.data.current is not None:
        return "electromechanical"
    if context.quantity("time_constant") is None:
        return "static_gain"
    return "first_order" if context.quantity("time_constant_product") is None else "second_order"


def _find_speed_step(context: EstimateContext) -> float:
    """Return the largest step in which a recorded speed comes [rad/s]."""
    if context.data.is_angle:
        return 0.0
    speeds = [r.velocity for r in context.group if r.velocity is not None]
    return max(map(speed_quantum, speeds), default=0.0)


def _find_angle_noise(context: EstimateContext) -> float:
    """Return the noise of a recorded angle [rad], 0 where counts or a speed were recorded."""
    group = context.group
    counted = any(r.count is not None and r.hardware.counts_per_revolution for r in group)
    if not context.data.is_angle or counted:
        return 0.0
    return max(map(read_count_rounding, group)) or float(context.found.noise[0].deviation[-1])
