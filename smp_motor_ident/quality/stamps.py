# SPDX-License-Identifier: Apache-2.0
"""Repair stamps: fit the sender's period, merge equal stamps, interpolate lost rows.

Sample k of a regular sender arrives at ``a + T n_k + latency_k`` with a latency that is never
negative, and ``n_k - k`` samples lost before it.  The line of least latencies under all arrivals is
an edge of their lower convex hull (the linear programme ``min sum(latency), latency >= 0``): the
beat is the lower envelope of the arrivals, whatever the distribution of the latency is.  Coarse or
repeated stamps, which round a regular time down, lie above such a line, too.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident._compile import compiled
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import (
    BEAT_FLOOR,
    BEAT_JITTER,
    BEAT_LOST,
    MAX_BRIDGED_ROWS,
    MAX_BUNCHED_INTERVAL,
    MIN_SMOOTHER_STDS,
)
from smp_motor_ident.record import Record

_MIN_PAUSE_NS = 20_000_000  # shortest pause between groups of arrivals
JACKKNIFE_BLOCKS = 8
_MIN_BEAT_SAMPLES = 50


@dataclass(frozen=True, eq=False)
class Beat:
    """A regular clock behind arrivals.

    ``time`` are the instants [ns], ``period`` the interval [ns] and ``deviation`` its standard
    deviation, ``latency`` the median delay [ns] behind the fastest, ``repeated`` whether arrivals
    came several at once.
    """

    time: Integers
    period: float
    deviation: float
    latency: float
    repeated: bool


def find_beat(arrival: Integers) -> Beat | None:
    """Return the regular clock behind arrivals; None without one, or if they are regular."""
    if arrival.size < _MIN_BEAT_SAMPLES or np.any(np.diff(arrival) < 0):
        return None
    # Pauses divide the arrivals: each part has a phase of its own.
    usual = (arrival[-1] - arrival[0]) / (arrival.size - 1)
    pause = max(20 * usual, _MIN_PAUSE_NS)
    edges = [0, *(np.flatnonzero(np.diff(arrival) > pause) + 1).tolist(), arrival.size]
    time, periods, deviations, late = arrival.copy(), [], [], []
    for begin, end in pairwise(edges):
        if end - begin < _MIN_BEAT_SAMPLES:
            return None
        fitted = _fit_beat(arrival[begin:end])
        if fitted is None:
            return None
        time[begin:end] = arrival[begin] + np.rint(fitted[0]).astype(np.int64)
        periods.append(fitted[1])
        deviations.append(fitted[2])
        late.append((arrival[begin:end] - time[begin:end]).astype(np.float64))
    latency, period = np.concatenate(late), float(np.median(periods))
    if np.std(latency) < BEAT_JITTER * period or np.any(np.diff(time) <= 0):
        return None
    repeated = float(np.mean(np.diff(arrival) < MAX_BUNCHED_INTERVAL * period)) > BEAT_LOST
    return Beat(time, period, max(deviations), float(np.median(latency)), repeated)


def _fit_beat(arrival: Integers) -> tuple[Array, float, float] | None:
    """Return the beat's instants from the first arrival [ns], its period and the uncertainty."""
    since = (arrival - arrival[0]).astype(np.float64)
    usual = since[-1] / (since.size - 1)
    if usual <= 0:
        return None
    apart = np.flatnonzero(
        np.diff(since, prepend=-np.inf, append=np.inf) > MAX_BUNCHED_INTERVAL * usual
    )
    longest = int(np.diff(apart).max(initial=1))  # samples that came at once
    window = max(32, 4 * longest)
    if 4 * window > since.size:
        return None
    number = np.arange(since.size, dtype=np.float64)
    begins = [part[0] for part in np.array_split(np.arange(since.size), since.size // window)]
    for lost in (0, 1):
        if lost:
            number += _count_lost(since, number, window)
            if number[-1] - (since.size - 1) > BEAT_LOST * since.size:
                return None
        begin, period = _fit_line(number, since)
        latency = since - begin - period * number
        highest_floor = np.minimum.reduceat(latency, begins).max()
        # Late messages catch up: the floor of a regular sender stays.
        if period > 0 and highest_floor <= BEAT_FLOOR * period * longest:
            return begin + period * number, period, _compute_period_std(number, since)
    return None


def _compute_period_std(number: Array, since: Array) -> float:
    """Return the standard deviation of the period, by a jackknife that deletes blocks."""
    parts = np.array_split(np.arange(number.size), JACKKNIFE_BLOCKS)
    periods = [_fit_line(np.delete(number, part), np.delete(since, part))[1] for part in parts]
    return float(np.sqrt((JACKKNIFE_BLOCKS - 1) * np.var(periods)))


def _count_lost(since: Array, number: Array, window: int) -> Array:
    """Return the number of samples lost up to each: a loss raises the floor by whole periods."""
    parts = np.array_split(np.arange(since.size), since.size // (2 * window))
    parts = parts[:: max(len(parts) // 200, 1)]
    period = float(np.median([_fit_line(number[p], since[p])[1] for p in parts]))
    lost = np.zeros(since.size)
    if period <= 0:
        return lost
    rest = since - period * number
    padded = np.pad(rest, (0, window - 1), mode="edge")
    floor = sliding_window_view(padded, window).min(axis=1)
    risen = np.flatnonzero(floor[window:] - floor[:-window] > 0.75 * period) + window
    at = 0
    for k in risen.tolist():
        if k >= at:
            lost[k:] += round(float(floor[k] - floor[k - window]) / period)
            at = k + window
    return lost


@compiled
def _fit_line(number: Array, value: Array) -> tuple[float, float]:
    """Return offset and slope of the line of least sum under the points.

    It is the edge of their lower hull that lies above the mean number (Andrew's monotone chain).
    """
    n = number.size
    hull = np.empty(n, dtype=np.int64)
    size, middle = 0, 0.0
    for k in range(n):
        middle += number[k] / n
        while size > 1:
            i, j = hull[size - 2], hull[size - 1]
            run, rise = number[j] - number[i], value[j] - value[i]
            if rise * (number[k] - number[i]) < (value[k] - value[i]) * run:
                break
            size -= 1
        hull[size] = k
        size += 1
    edge = 0
    while edge < size - 2 and number[hull[edge + 1]] < middle:
        edge += 1
    i, j = hull[edge], hull[min(edge + 1, size - 1)]
    slope = (value[j] - value[i]) / max(number[j] - number[i], 1.0)
    return value[i] - slope * number[i], slope


def is_on_beat(beat: Beat, arrival: Integers, motion: Array) -> bool:
    """Return whether a motion was sampled on the beat rather than at its arrivals.

    A sample whose two instants lie clearly apart on the motion is nearer to the line between its
    neighbours at the true one: a sign test over these samples decides.  Most samples arrive
    punctually and tell nothing, and steps of an encoder are smooth on any regular time.
    """
    kept, put_back = _measure_curvature(arrival, motion), _measure_curvature(beat.time, motion)
    good = np.isfinite(kept + put_back)
    kept, put_back = kept[good], put_back[good]
    if kept.size < _MIN_BEAT_SAMPLES // 2:
        return False
    nearer = np.minimum(kept, put_back)
    apart = np.abs(kept - put_back) > 2.0 * np.quantile(nearer, 0.95)
    votes = np.sign(kept - put_back)[apart]
    return bool(votes.sum() > MIN_SMOOTHER_STDS * np.sqrt(votes.size))


def _measure_curvature(time: Integers, value: Array) -> Array:
    """Return the distance of samples from the line between their neighbours; NaN if undefined."""
    since = (time - time[0]).astype(np.float64)
    span = since[2:] - since[:-2]
    weight = (since[1:-1] - since[:-2]) / np.where(span > 0, span, np.nan)
    off = np.abs(value[1:-1] - value[:-2] * (1 - weight) - value[2:] * weight)
    return np.asarray(off)


def move_to_beat(record: Record) -> Record:
    """Move late stamps of a record to the beat of its sender; return other records unchanged.

    Irregular stamps may be the true sampling instants: the motion decides, unless they differ by
    their rounding only.
    """
    steps = np.diff(record.time)
    if np.ptp(steps) < BEAT_JITTER * record.sample_time:
        return record
    arrival = np.rint(record.time * 1e9).astype(np.int64)
    motion = next(
        np.asarray(m, dtype=np.float64)
        for m in (record.count, record.position, record.velocity)
        if m is not None
    )
    beat = find_beat(arrival)
    if beat is None:
        return record
    multiple = np.gcd.reduce(np.diff(arrival))  # common to all stamps, where they are rounded
    rounded = np.ptp(arrival - beat.time) <= multiple
    if not (beat.repeated or rounded or is_on_beat(beat, arrival, motion)):
        return record
    period, latency = beat.period * 1e-9, beat.latency * 1e-9
    finding = Finding(
        "arrival_beat",
        "note",
        f"stamps scattered with the transport (median latency {1e3 * latency:.3g} ms); they were "
        f"fitted to their period of {1e3 * period:.5g} ms",
        {"period": period, "deviation": beat.deviation * 1e-9, "latency": latency},
        "stamp each sample where it is measured",
    )
    time = (beat.time - beat.time[0]) * 1e-9
    return replace(record, time=time, findings=(*record.findings, finding))


def merge_bunches(record: Record) -> Record:
    """Merge samples with (nearly) equal stamps where most of a record's samples are such.

    A clock too coarse for the rate, or a transport that delivers many messages at once, stamps
    several samples alike.  The last of a bunch was measured next to its stamp; the voltage is
    the mean of the bunch's, for the bunch spans the time since the one before.
    """
    starts = np.array(record.starts)
    step = np.diff(record.time)
    within = np.ones(step.size, dtype=bool)
    within[starts[1:] - 1] = False
    if not within.any():
        return record
    near = MAX_BUNCHED_INTERVAL * float(step[within].mean())
    usual = record.sample_time if within.all() else float(np.median(step[within]))
    if usual >= near:
        return record
    last = np.append((step >= near) | ~within, True)
    kept = np.flatnonzero(last)
    first = np.append(0, kept[:-1] + 1)
    if kept.size < 2:
        return record
    share = 1.0 - kept.size / len(record)
    finding = Finding(
        "stamps_equal",
        "warning",
        f"{100 * share:.0f} % of the samples have the stamp of the sample before; the last of each "
        "group with one stamp was used",
        {"share": share, "samples": float(kept.size)},
        "stamp each sample where it is measured, with a clock finer than the sampling interval",
    )
    return replace(
        record.take(kept),
        voltage=np.add.reduceat(record.voltage, first) / np.diff(np.append(first, len(record))),
        starts=tuple(int(k) for k in np.searchsorted(kept, starts)),
        findings=(*record.findings, finding),
    )


INTERVAL_TOLERANCE = 0.1  # tolerance of whole multiples of an interval


def interpolate_lost_voltage(record: Record) -> Record:
    """Interpolate the voltage linearly where rows were lost, and average it.

    Over ``m`` intervals, the last one at the next row's voltage, the mean is
    ``v1 + (v2 - v1) (m + 1) / (2 m)``.  Records of bags are interpolated already.
    """
    step = np.diff(record.time)
    if step.size < 2 or any(f.code == "samples_missing" for f in record.findings):
        return record
    edges = [*record.starts, len(record)]  # segments may each have a rate of their own
    inside = [step[min(a, max(b - 2, 0)) : max(b - 1, 1)] for a, b in pairwise(edges)]
    usual = [np.median(part) for part in inside] if len(inside) > 1 else [record.sample_time]
    share = step / np.repeat(usual, np.diff(edges))[:-1]
    whole = np.rint(share)
    regular = np.abs(share - whole) < INTERVAL_TOLERANCE
    few = (whole > 1) & (whole <= 1 + MAX_BRIDGED_ROWS)
    few[np.array(record.starts[1:], dtype=np.int64) - 1] = False
    if not few.any() or not regular.all(where=whole <= 1 + MAX_BRIDGED_ROWS):
        return record
    k = np.flatnonzero(few)
    voltage, m = record.voltage.copy(), whole[k]
    before = record.voltage[k]
    voltage[k + 1] = before + (record.voltage[k + 1] - before) * (m + 1) / (2 * m)
    lost = int((m - 1).sum())
    words = f"{lost} rows missing in {k.size} places; their voltage was interpolated"
    found = Finding("samples_missing", "note", words, {"samples": float(lost)})
    return replace(record, voltage=voltage, findings=(*record.findings, found))
