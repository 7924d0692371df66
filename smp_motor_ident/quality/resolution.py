# SPDX-License-Identifier: Apache-2.0
"""Estimate the resolution of sensors from their readings: steps of angle, speed and current."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from smp_motor_control.arrays import Array, Flags, Integers
from smp_motor_ident.record import Record

MIN_REST_SAMPLES = 10  # samples of an unchanged count that are a standstill
MIN_ENCODER_STEP = 2 * np.pi / 2**17
"""Resolution [rad] of servo encoders, finer than that of any wheel."""
MIN_SENSOR_STEP_SHARE = 1e-4  # share of the range: best linearity of amplifiers and tachometers
MAX_SAMPLED_READINGS = 2_000  # to decide whether a speed repeats its values
MIN_LEVELS = 30
"""Levels whose mean distance from multiples of a step shows it: five deviations from chance."""
UNIFORM_DISTANCE = 0.25  # mean distance of a random number from the nearest whole number


def select_angle(record: Record) -> tuple[Array, float] | None:
    """Return a record's angle relative to the first one [rad] and its step, None without angle."""
    per_turn = record.hardware.counts_per_revolution
    if record.count is not None and per_turn:
        quantum = 2 * np.pi / per_turn
        return (record.count - record.count[0]) * quantum, quantum
    if record.position is not None and np.isfinite(record.position).sum() > 2:
        angle = record.position - record.position[np.isfinite(record.position)][0]
        return angle, angle_quantum(angle)
    return None


def mark_repeats(count: Integers, starts: Sequence[int]) -> Flags:
    """Mark repeated readings of an encoder at rest, which all have the same error.

    Treated as independent readings, they would determine the angle far better than to the unknown
    fraction of a count.  Of a long run the sample in the middle is kept, and of a run that begins
    a segment the first.
    """
    first = np.zeros(count.size, dtype=np.bool_)  # of each segment
    first[[0, *starts]] = True
    begins = first.copy()
    begins[1:] |= count[1:] != count[:-1]
    begin = np.flatnonzero(begins)
    length = np.diff(np.append(begin, count.size))
    rests = length >= MIN_REST_SAMPLES
    if not rests.any():
        return np.zeros(count.size, dtype=np.bool_)
    repeats = np.repeat(rests, length)
    stays = begin[rests]
    repeats[stays + np.where(first[stays], 0, length[rests] // 2)] = False
    return repeats


def angle_quantum(angle: Array) -> float:
    """Return the step [rad] of an angle by counts or rounding; 0 without steps."""
    every = np.abs(np.diff(angle))
    # A slow motor moves once in a hundred rows; lost samples compare as smaller.
    moves = np.sort(every[every > MIN_ENCODER_STEP][:20_000])
    rests = moves.size < 0.5 * every.size
    if moves.size < 50:
        return 0.0
    moves = moves[:: -(-moves.size // MAX_SAMPLED_READINGS)]
    for parts in (1, 2, 3):  # a motor that is fast in every sample may show no single step
        quantum = float(moves[0]) / parts
        for reach in (4.0, 20.0, 100.0, np.inf):  # longer moves determine it more accurately
            near = moves[moves < reach * quantum]
            whole = np.round(near / quantum)
            quantum = float(near @ whole / (whole @ whole))
        whole = np.round(moves / quantum)
        levels = np.unique(whole).size
        off = np.abs(moves / quantum - whole)
        single = levels == 2 or (levels == 1 and rests)
        if (levels > 2 and np.mean(off < 0.05) > 0.95) or (single and off.max() < 0.005):
            return quantum
        if levels > MIN_LEVELS and _average_levels(whole, off) < 0.5 * UNIFORM_DISTANCE:
            return quantum
    return 0.0


def _average_levels(level: Array, off: Array) -> float:
    """Average over levels, so that a constant speed counts once."""
    _, which, often = np.unique(level, return_inverse=True, return_counts=True)
    return float(np.mean(np.bincount(which, off) / often))


def speed_quantum(velocity: Array) -> float:
    """Return the step of a speed, 0 without steps.

    A coarse step means that the speed is a difference of counts, so a mean over a window.
    """
    x = velocity[:20_000]
    x = x[np.isfinite(x)]
    if x.size < 50:
        return 0.0
    span = float(np.ptp(x))
    # Steps of a five-hundredth of the span or more repeat; a speed without steps hardly does.
    few = np.sort(x[:: -(-x.size // MAX_SAMPLED_READINGS)])
    if few.size > MAX_SAMPLED_READINGS // 2 and np.mean(np.diff(few) <= 1e-6 * span) < 0.2:
        return 0.0
    levels = np.unique(x)
    steps = np.diff(levels)
    steps = steps[steps > 1e-6 * max(span, 1e-300)]
    if steps.size == 0:
        return 0.0
    # Published logs are rounded: allow a twentieth of a step.  Fit a line through all levels, so
    # that the rounding of single steps does not add up.
    count = np.concatenate([[0.0], np.cumsum(np.round(steps / np.median(steps)))])
    levels = levels[0] + np.concatenate([[0.0], np.cumsum(steps)])
    if np.ptp(count) == 0:
        return 0.0
    quantum, first = (float(x) for x in np.polyfit(count, levels, 1))
    whole = (levels - first) / quantum
    regular = np.mean(np.abs(whole - np.round(whole)) < 0.05)
    return quantum if regular > 0.95 and quantum > 2e-3 * span else 0.0
