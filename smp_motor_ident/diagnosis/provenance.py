"""What an estimate says of its records, and of the noise that was in them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from smp_motor_ident.diagnosis.differenced import rounding
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.likelihood.experiments import Experiments, speed_quantum
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.record import Record


def provenance(group: Sequence[Record], data: Experiments, fit: Fit) -> dict[str, Any]:
    """Return the fields of an `Estimate` that are of its records."""
    return {
        "wheel": group[0].wheel,
        "duration": float(sum(r.duration for r in group)),
        "largest_voltage": max(float(np.abs(r.voltage).max()) for r in group),
        "sources": tuple(dict.fromkeys(r.source for r in group if r.source)),
        "hardware": group[0].hardware,
        "samples": data.size,
        "sample_time": data.step,
        "speed_noise": _speed_noise(data, fit),
        "speed_step": _speed_step(group, data),
        "angle_noise": _angle_noise(group, data, fit),
    }


def _speed_noise(data: Experiments, fit: Fit) -> float:
    """Return the noise of the speed that was recorded [rad/s], 0 where only an angle was."""
    return 0.0 if data.kind == ANGLE else float(np.sqrt(fit.noise[0, 0]))


def _speed_step(group: Sequence[Record], data: Experiments) -> float:
    """Return the largest step in which a speed that was recorded comes [rad/s]."""
    speeds = [] if data.kind == ANGLE else [r.velocity for r in group if r.velocity is not None]
    return max(map(speed_quantum, speeds), default=0.0)


def _angle_noise(group: Sequence[Record], data: Experiments, fit: Fit) -> float:
    """Return the noise of the angle that was recorded [rad], 0 where counts or a speed were.

    Of a speed that is the difference of counts it is their rounding, which no loop is given.
    """
    counted = any(r.count is not None and r.hardware.counts_per_revolution for r in group)
    if data.kind != ANGLE or counted:
        return 0.0
    return max(map(rounding, group)) or float(np.sqrt(fit.noise[0, 0]))
