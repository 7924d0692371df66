# SPDX-License-Identifier: Apache-2.0
"""Check whether the recent samples of a running motor suffice for identification."""

from dataclasses import replace

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.quality.screen import measured_speed
from smp_motor_ident.record import Record

MIN_DURATION_S, MIN_MOTION_S = 5.0, 3.0  # least length of a window, and time of motion in it
LEVELS, MIN_LEVELS, MIN_CHANGES = 8, 3, 6
"""Levels that divide the range of voltages, least number of them with 2 % of the samples each, and
least number of crossings of the mean voltage."""

ROUNDING = 1e-9  # relative rounding error of equal voltages computed in different ways


def find_missing_excitation(record: Record | None) -> list[str]:
    """Return descriptions of missing excitation; empty if an estimate is possible."""
    if record is None:
        return ["no motor_state yet"]
    hardware = record.hardware  # the unit of the speed does not matter
    hardware = replace(hardware, counts_per_revolution=hardware.counts_per_revolution or 1.0)
    voltage, speed = record.voltage, measured_speed(replace(record, hardware=hardware))
    step = record.sample_time
    threshold = 0.02 * max(float(np.nanmax(np.abs(speed))), 1e-9)
    forward, backward = float(np.mean(speed > threshold)), float(np.mean(speed < -threshold))
    moving = (forward + backward) * speed.size * step
    filled = int(np.sum(_shares(voltage) >= 0.02))
    above = voltage > voltage.mean()
    changes = int(np.sum(above[1:] != above[:-1]))
    checks: list[tuple[bool, str]] = [
        (record.duration >= MIN_DURATION_S, f"{record.duration:.1f} of {MIN_DURATION_S:g} s"),
        (moving >= MIN_MOTION_S, f"turned for {moving:.1f} of {MIN_MOTION_S:g} s"),
        (filled >= MIN_LEVELS, f"{filled} of {MIN_LEVELS} levels of voltage"),
        (changes >= MIN_CHANGES, f"{changes} of {MIN_CHANGES} changes of voltage"),
        (
            min(forward, backward) > 0.1,
            f"forward {100 * forward:.0f} %, backward {100 * backward:.0f} % of the time, "
            "10 % each are needed",
        ),
    ]
    return [text for met, text in checks if not met]


def _shares(voltage: Array) -> Array:
    """Return the shares of the samples in each of the levels of voltage."""
    if np.ptp(voltage) <= ROUNDING * np.abs(voltage).max():
        return np.ones(1)
    return np.histogram(voltage, LEVELS)[0] / voltage.size
