# SPDX-License-Identifier: Apache-2.0
"""Describe an estimate's records, their noise, and the candidate chains."""

from __future__ import annotations

from typing import Any

import numpy as np

from smp_motor_ident.infer.findings import Judged
from smp_motor_ident.quality.differenced import rounding
from smp_motor_ident.quality.resolution import speed_quantum
from smp_motor_ident.result import Candidate


def provenance(judged: Judged) -> dict[str, Any]:
    """Return the fields of an `Estimate` that are of its records and its model."""
    group, data = judged.group, judged.data
    return {
        "wheel": group[0].wheel,
        "model": model_name(judged),
        "duration": float(sum(r.duration for r in group)),
        "largest_voltage": max(float(np.abs(r.voltage).max()) for r in group),
        "sources": tuple(dict.fromkeys(r.source for r in group if r.source)),
        "hardware": group[0].hardware,
        "samples": len(data),
        "sample_time": data.rows.step,
        "speed_noise": 0.0 if data.is_angle else float(judged.found.noise[0].deviation[-1]),
        "speed_step": _speed_step(judged),
        "angle_noise": _angle_noise(judged),
    }


def model_name(judged: Judged) -> str:
    """Return the structure of the motor that the data determine."""
    if judged.data.current is not None:
        return "electromechanical"
    if judged.quantity("time_constant") is None:
        return "static_gain"
    return "first_order" if judged.quantity("time_constant_product") is None else "second_order"


def candidates_of(judged: Judged) -> tuple[Candidate, ...]:
    """Return the chosen chain."""
    chosen = " + ".join(judged.found.chain.codes)
    return (Candidate(chosen, judged.percent.estimation, judged.found.deviance, True),)


def _speed_step(judged: Judged) -> float:
    """Return the largest step in which a recorded speed comes [rad/s]."""
    if judged.data.is_angle:
        return 0.0
    speeds = [r.velocity for r in judged.group if r.velocity is not None]
    return max(map(speed_quantum, speeds), default=0.0)


def _angle_noise(judged: Judged) -> float:
    """Return the noise of a recorded angle [rad], 0 where counts or a speed were recorded."""
    group = judged.group
    counted = any(r.count is not None and r.hardware.counts_per_revolution for r in group)
    if not judged.data.is_angle or counted:
        return 0.0
    return max(map(rounding, group)) or float(judged.found.noise[0].deviation[-1])
