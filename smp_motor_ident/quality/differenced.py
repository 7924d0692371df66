# SPDX-License-Identifier: Apache-2.0
"""Recover the counts of a speed that is their difference over one sample.

The rounding error of a count enters two neighbouring speeds with opposite signs, so their errors
are correlated by -1/2 and sum up to that of one count.  Treated as independent errors of the speed
they would be far overestimated, and a loop that responds to them would bias the fit.  Differences
over m samples sum up to m counts in a row with m times the error; a fitted motor whose residual is
one count's rounding identifies m.

A count divided by the nominal period of a loop instead of the actual interval is wrong in
proportion to that interval: neighbouring speeds then differ as their intervals do.

References
----------
L. Ljung, System Identification, 2nd ed. (1999), section 13.4 (noise that a loop feeds back).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import (
    BEAT_JITTER,
    MAX_COUNTS_PER_SAMPLE,
    MAX_NEIGHBOUR_CORRELATION,
    MAX_ONE_COUNT_VARIANCE,
    MIN_INTERVAL_SLOPE,
    MIN_SAMPLES,
    MIN_SIGN_STDS,
)
from smp_motor_ident.quality.resolution import speed_quantum
from smp_motor_ident.record import Record

SMOOTHING_SAMPLES = 9  # length of a moving mean that removes the rounding
CUBIC_SAMPLES = 15  # samples over which a motion is a cubic
MAX_STEPPED_COUNTS = 100  # largest counts per interval at which a speed shows its steps
MIN_GAP_RATIO = 2.0  # ratio of a gap to the usual interval
MAX_INTERVAL_ERROR = 0.5  # share of the usual interval; a larger one may hide a lost sample


def recover_counts(group: Sequence[Record]) -> list[Record]:
    """Return records with angles in place of differenced speeds, if all speeds are such."""
    summed = [_sum_speed(r) for r in group]
    return list(group) if any(s is r for s, r in zip(summed, group, strict=True)) else summed


def _sum_speed(record: Record) -> Record:
    velocity = record.velocity
    if velocity is None or record.count is not None or record.position is not None:
        return record
    quantum, step = speed_quantum(velocity), record.sample_time
    if quantum == 0.0 or not np.isfinite(velocity).all():
        return record
    intervals = np.delete(np.diff(record.time), [s - 1 for s in record.starts if s > 0])
    moved = np.rint(velocity / quantum)
    if np.abs(intervals - step).max() > MAX_INTERVAL_ERROR * step or not _has_alternating_errors(
        moved
    ):
        return record
    if not _is_smooth_within_one_count(moved):
        return record
    found = Finding(
        "speed_summed",
        "note",
        f"the speed has steps of {quantum:.4g} rad/s, one count per sample: it is a difference of "
        "counts, which are used instead",
        {"quantum": quantum},
        "record the encoder's counts",
    )
    angle, findings = np.cumsum(moved) * quantum * step, (*record.findings, found)
    return replace(record, position=angle, velocity_window=step, findings=findings)


def read_count_rounding(record: Record) -> float:
    """Return the rounding [rad] of the counts behind a recovered angle, 0 for others."""
    found = next((f for f in record.findings if f.code == "speed_summed"), None)
    if found is None:
        return 0.0
    return float(found.evidence["quantum"] or 0.0) * record.velocity_window / 12**0.5


def _is_smooth_within_one_count(moved: Array) -> bool:
    """Return whether changing counts differ from a local cubic by the rounding of one count.

    With more than a few counts per sample the speed itself can be used.
    """
    if moved.size < CUBIC_SAMPLES or np.abs(moved).max() > MAX_COUNTS_PER_SAMPLE:
        return False
    count = np.cumsum(moved)
    from scipy.signal import savgol_coeffs, savgol_filter  # takes a while to load

    rest = count - savgol_filter(count, CUBIC_SAMPLES, 3)
    turns = np.convolve(moved != 0, np.ones(CUBIC_SAMPLES), "same") > 1
    left = 1 - float(savgol_coeffs(CUBIC_SAMPLES, 3)[CUBIC_SAMPLES // 2])  # of a white error
    return bool(
        turns.any() and np.mean(np.square(rest[turns])) < MAX_ONE_COUNT_VARIANCE * left / 12
    )


def _has_alternating_errors(moved: Array) -> bool:
    """Return whether neighbours have errors of opposite sign, after removing the motion."""
    smooth = np.convolve(moved, np.full(SMOOTHING_SAMPLES, 1 / SMOOTHING_SAMPLES), "same")
    rest = (moved - smooth)[SMOOTHING_SAMPLES:-SMOOTHING_SAMPLES]
    size = float(rest @ rest)
    return size > 0.0 and float(rest[1:] @ rest[:-1]) < MAX_NEIGHBOUR_CORRELATION * size


def correct_nominal_period(record: Record) -> Record:
    """Correct a speed that was divided by a nominal period instead of the real intervals.

    The period follows from the counts per revolution if known, else it is the mean interval.
    """
    velocity, interval = record.velocity, np.diff(record.time, prepend=np.nan)
    if velocity is None or record.count is not None or record.position is not None:
        return record
    interval[list(record.starts)] = np.nan
    if not _follows_intervals(velocity, interval):
        return record
    mean, shortest = float(np.nanmean(interval)), float(np.nanpercentile(interval, 5))
    counted = _find_nominal_period(velocity, record.hardware.counts_per_revolution, mean)
    known = shortest / MIN_GAP_RATIO < counted < mean * MIN_GAP_RATIO
    period = counted if known else mean
    words = "the speed is counts over a nominal period instead of the actual intervals"
    found = Finding(
        "nominal_period",
        "warning" if known else "unreliable",
        f"{words}: it was corrected for a period of {1e3 * period:.4g} ms"
        + ("" if known else f", the mean one; for {1e3 * shortest:.4g} ms it would be "
           f"{100 * (1 - shortest / mean):.0f} % less"),
        {"period": period, "shortest": shortest},
        "record the encoder's counts" + ("" if known else ", or map counts_per_revolution=N"),
    )  # fmt: skip
    real = velocity * period / interval
    return replace(record, velocity=real, velocity_window=mean, findings=(*record.findings, found))


def _find_nominal_period(velocity: Array, per_turn: float | None, usual: float) -> float:
    """Return the period over which one count is the step of slow speeds, 0 if unknown."""
    if not per_turn:
        return 0.0
    slow = np.abs(velocity) < MAX_STEPPED_COUNTS * 2 * np.pi / per_turn / usual
    quantum = speed_quantum(velocity[slow])
    return 2 * np.pi / per_turn / quantum if quantum else 0.0


def _follows_intervals(velocity: Array, interval: Array) -> bool:
    """Return whether deviations of speeds from their neighbours' mean follow their intervals.

    The slope is one for counts over a nominal period, and zero for a motor's speed.
    """
    known = np.isfinite(velocity) & np.isfinite(interval)
    speed, took = velocity[known], interval[known]
    if speed.size < MIN_SAMPLES or np.std(took) < BEAT_JITTER * np.median(took):
        return False
    took = np.minimum(took, MIN_GAP_RATIO * np.median(took))  # the motion in a gap is unknown
    window = np.full(SMOOTHING_SAMPLES, 1 / SMOOTHING_SAMPLES)
    mean, usual = (np.convolve(x, window, "same") for x in (speed, took))
    inner = slice(SMOOTHING_SAMPLES, -SMOOTHING_SAMPLES)
    x, y = (mean * (took / usual - 1))[inner], (speed - mean)[inner]
    power = float(x @ x)
    if power <= 0:
        return False
    slope = float(x @ y) / power
    std = float(np.linalg.norm((y - slope * x) * x)) / power
    return slope - MIN_SIGN_STDS * std > MIN_INTERVAL_SLOPE
