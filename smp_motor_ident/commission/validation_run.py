# SPDX-License-Identifier: Apache-2.0
"""Validate a model on a run that was not fitted."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from smp_motor_control.arrays import Array
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import VALIDATION_LEVEL, VALIDATION_TOLERANCE

BLOCK = 0.5
"""Correlation time of simulation errors [s]; a longer stretch counts as an independent error."""


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """Measured and simulated motor speed of one stretch of data."""

    time: Array  # [s]
    measured: Array  # [rad/s]; NaN if not measured
    simulated: Array  # [rad/s]

    def powers(self) -> Array:
        """Return the mean square of the error in each block [(rad/s)^2]."""
        error = np.square(self.measured - self.simulated)
        block = ((self.time - self.time[0]) / BLOCK).astype(np.int64)
        kept = np.isfinite(error)
        count = np.bincount(block[kept])
        total = np.bincount(block[kept], weights=error[kept])
        return np.asarray(total[count > 0] / count[count > 0])


def judge(wheel: str, fitted: Sequence[SimulatedRun], held_out: Sequence[SimulatedRun]) -> Finding:
    """Return the fit to held-out data, refused if it is significantly and clearly worse."""
    before = np.concatenate([one.powers() for one in fitted])
    after = np.concatenate([one.powers() for one in held_out])
    speed = np.concatenate([one.measured for one in held_out])
    scatter = float(np.nanstd(speed))
    share = math.sqrt(after.mean()) / scatter if scatter > 0 else math.inf
    expected = math.sqrt(before.mean()) / scatter if scatter > 0 else math.inf
    ratio = float(after.mean() / max(before.mean(), 1e-300))
    limit = float(stats.f.isf(VALIDATION_LEVEL, after.size, before.size))
    text = (
        f"{wheel}: {100 * (1 - share):.2f} % of the speed explained in the validation run; "
        f"the fit predicts {100 * (1 - expected):.2f} %"
    )
    evidence: dict[str, float | str | None] = {
        "fit_percent": 100 * (1 - share) if math.isfinite(share) else None,
        "expected_fit_percent": 100 * (1 - expected) if math.isfinite(expected) else None,
        "variance_ratio": ratio,
        "limit": limit,
    }
    if ratio > limit and share > VALIDATION_TOLERANCE:
        return Finding(
            "validation_run",
            "refused",
            text + ": the motor, its load or its supply has changed since the recording",
            evidence,
            "see that nothing touches the wheels, the battery is full and the gearbox warm, then "
            "commission again",
        )
    return Finding("validation_run", "note", text, evidence)
