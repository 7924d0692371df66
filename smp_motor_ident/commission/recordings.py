# SPDX-License-Identifier: Apache-2.0
"""Judge recordings: the temperature of a winding between them, and the model on a held-out run.

The equation of the winding is integrated over blocks of time, to avoid differentiation:

    int v dt = R int i dt + K dtheta + L di + c T,

so a regression over the blocks of a recording gives R, whatever the friction.  The course of the
current between its samples, while the held voltage steps, adds a share of the change of both over
the block.  That change carries the noise of the current, so instrumental variables free of it
weigh the sums: voltage, angle and the change of speed.  Copper's resistance grows by 0.39 %/K;
the parts of driver and brushes do not.

References
----------
L. Ljung, *System Identification*, 2nd ed. (1999), section 7.6 for the instruments.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import stats

from smp_motor_control.arrays import Array
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import MAX_RESISTANCE_RISE, VALIDATION_LEVEL, VALIDATION_TOLERANCE
from smp_motor_ident.live.monitor import BLOCK_S, COPPER_COEFFICIENT
from smp_motor_ident.record import Record

MIN_DEVIATIONS = 3.0  # required excess over the limit [standard deviations]


MAX_CONDITION = 1e6  # condition number beyond which the columns of a recording are collinear


class Resistance(NamedTuple):
    """Of a winding and its driver [ohm]."""

    value: float
    std: float


def resistance(record: Record) -> Resistance | None:
    """Return the winding's resistance; None without a current or with too little motion."""
    motion = record.count if record.position is None else record.position
    if record.current is None or motion is None:
        return None
    dt = np.diff(record.time)
    current, voltage = record.current, record.voltage
    turned = np.diff(np.asarray(motion, dtype=np.float64))
    block = (record.time[1:] / BLOCK_S).astype(np.int64) * len(record.starts)
    block += np.searchsorted(record.starts, np.arange(1, len(record)), side="right")
    speeding = np.diff(turned / dt, prepend=0.0)
    changes = np.diff(current), np.diff(voltage)
    rows = np.stack([voltage[1:] * dt, current[1:] * dt, turned, *changes, dt, speeding])
    good = np.isfinite(rows).all(axis=0)
    good[np.asarray(record.starts[1:], dtype=np.int64) - 1] = False
    sums = np.stack([np.bincount(block[good], weights=row[good]) for row in rows])
    moves = (sums[5] > 0.5 * BLOCK_S) & (sums[2] != 0.0)
    volts, amps, angle, surge, step, spent, run_up = sums[:, moves]
    table = np.stack([amps, angle, surge, step, spent])
    known = np.stack([volts, angle, run_up, step, spent])  # free of the current's noise
    spare = volts.size - len(table)
    sizes, tools = np.linalg.norm(table, axis=1), np.linalg.norm(known, axis=1)
    if spare < len(table) or not (sizes > 0).all() or not (tools > 0).all():
        return None
    normal = (known / tools[:, None]) @ (table / sizes[:, None]).T
    if np.linalg.cond(normal) > MAX_CONDITION:
        return None
    inverse = np.linalg.inv(normal) / sizes[:, None]
    solved = inverse @ (known / tools[:, None] @ volts)
    noise = float(np.square(volts - solved @ table).sum()) / spare
    alike = known @ known.T / np.outer(tools, tools)
    return Resistance(
        float(solved[0]), math.sqrt(noise * float((inverse @ alike @ inverse.T)[0, 0]))
    )


def report_heated_winding(wheel: str, earlier: Sequence[Record], last: Record) -> list[Finding]:
    """Return a finding where a winding is much hotter than in the best earlier recording."""
    known = [r for one in earlier if (r := resistance(one)) is not None and r.value > 0]
    now = resistance(last)
    if not known or now is None:
        return []
    cold = min(known, key=lambda r: r.std / r.value)
    rise = now.value / cold.value - 1.0
    std = math.hypot((1.0 + rise) * cold.std, now.std) / cold.value
    if rise - MIN_DEVIATIONS * std <= MAX_RESISTANCE_RISE:
        return []
    warmer = rise / COPPER_COEFFICIENT
    return [Finding(
        "winding_hot", "refused",
        f"{wheel}: its resistance rose by {100 * rise:.0f} % from signal to signal: the winding "
        f"is {warmer:.0f} K hotter",
        {"wheel": wheel, "rise": rise, "warmer": warmer},
        "let it cool and continue with --resume; check that the wheel turns freely, or start again "
        "with a smaller --amplitude",
    )]  # fmt: skip


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
