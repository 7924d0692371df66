# SPDX-License-Identifier: Apache-2.0
"""Check whether the recent samples of a running motor suffice for identification."""

from dataclasses import dataclass

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_control.fields import described
from smp_motor_ident.record import Record

ROUNDING = 1e-9  # relative rounding error of equal voltages computed in different ways


@dataclass(frozen=True)
class Demands:
    """Minimum contents of a window for an estimate."""

    duration: float = described(5.0, "Minimum time in the window [s].")
    moving: float = described(3.0, "Minimum time of motion in the window [s].")
    bins: int = described(8, "Number of levels that divide the range of voltages.")
    filled: int = described(3, "Minimum number of levels with 2 % of the samples each.")
    changes: int = described(6, "Minimum number of crossings of the mean voltage.")
    both_directions: bool = described(
        True, "Whether the motor must have turned in both directions."
    )


def missing(record: Record | None, demands: Demands) -> list[str]:
    """Return descriptions of missing excitation; empty if an estimate is possible."""
    if record is None:
        return ["no motor_state yet"]
    voltage, speed = record.voltage, _speed(record)
    step = record.sample_time
    threshold = 0.02 * max(float(np.nanmax(np.abs(speed))), 1e-9)
    forward, backward = float(np.mean(speed > threshold)), float(np.mean(speed < -threshold))
    moving = (forward + backward) * speed.size * step
    filled = int(np.sum(_shares(voltage, demands.bins) >= 0.02))
    above = voltage > voltage.mean()
    changes = int(np.sum(above[1:] != above[:-1]))
    checks: list[tuple[bool, str]] = [
        (record.duration >= demands.duration, f"{record.duration:.1f} of {demands.duration:g} s"),
        (moving >= demands.moving, f"turned for {moving:.1f} of {demands.moving:g} s"),
        (filled >= demands.filled, f"{filled} of {demands.filled} levels of voltage"),
        (changes >= demands.changes, f"{changes} of {demands.changes} changes of voltage"),
        (
            not demands.both_directions or min(forward, backward) > 0.1,
            f"forward {100 * forward:.0f} %, backward {100 * backward:.0f} % of the time, "
            "10 % each are needed",
        ),
    ]
    return [text for met, text in checks if not met]


def _shares(voltage: Array, bins: int) -> Array:
    """Return the shares of the samples in each of the levels of voltage."""
    low, span = voltage.min(), np.ptp(voltage)
    if span <= ROUNDING * np.abs(voltage).max():
        return np.ones(1)
    level = np.minimum((voltage - low) / span * bins, bins - 1).astype(np.int64)
    return np.bincount(level, minlength=bins) / voltage.size


def _speed(record: Record) -> Array:
    """Return the motor's speed, from counts where they are known, in any unit."""
    counts = record.count if record.hardware.counts_per_revolution else None
    if counts is None and record.velocity is not None:
        return record.velocity
    turned = counts if counts is not None else record.position
    turned = record.count if turned is None else turned
    assert turned is not None  # a record has one of the three
    return np.asarray(np.gradient(turned.astype(np.float64), record.time))
