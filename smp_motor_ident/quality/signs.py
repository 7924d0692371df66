# SPDX-License-Identifier: Apache-2.0
"""Detect reversed and lost signs by the correlation of a signal with the lagged voltage.

A motor's response lags by at most a quarter of a period, plus the delay of sampling and transport.
Where the total is half a period, a late response cannot be told from a reversed one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.fft import irfft, rfft

from smp_motor_control.arrays import Array
from smp_motor_ident.errors import SignalError
from smp_motor_ident.limits import (
    MAX_BACKWARD_SHARE,
    MAX_SIGN_DELAY,
    MIN_EXPLAINED_SHARE,
    MIN_SIGN_CORRELATION,
    MIN_SIGN_STDS,
)
from smp_motor_ident.quality.lag import apply_lag, correlate
from smp_motor_ident.record import Record

LAG_COUNT = 16  # from a sampling interval to a quarter of the record, each 1.5 to 2 times the last
MAGNITUDE_LAG_COUNT = 8  # up to a tenth of the record
SAMPLES_PER_LAG = 16
MAX_RUNS = 2_000  # averaged runs of a record, which reduce the noise of a counter
TRAVEL_RUNS = 50  # of a record


@dataclass(frozen=True)
class SignCorrelation:
    """The largest correlations of a signal with the voltage that came through a lag."""

    right: float  # as it is
    wrong: float  # with the other sign
    chance: float  # standard deviation of ``wrong`` for independent signals


def correlate_with_voltage(
    records: Sequence[Record], signals: Sequence[Array], lags: bool
) -> SignCorrelation | None:
    """Correlate signals with the lagged voltage; None if they are constant."""
    pairs = [pair for r, y in zip(records, signals, strict=True) if (pair := _average_runs(r, y))]
    if not any(y.any() for _, _, y in pairs):
        return None
    times = [0.0]
    if lags:
        shortest = min(step for step, _, _ in pairs)
        longest = max(step * v.size for step, v, _ in pairs) / 4
        times = [0.0, *np.geomspace(shortest, max(longest, 2 * shortest), LAG_COUNT)]
    best, worst, reverse = 0.0, 0.0, [(v, y) for _, v, y in pairs]
    for lag in times:
        every = max(1, int(lag / (SAMPLES_PER_LAG * max(step for step, _, _ in pairs))))
        fewer = [(every * step, _decimate(v, every), _decimate(y, every)) for step, v, y in pairs]
        power = sum(float(y @ y) for _, _, y in fewer)
        late = [(apply_lag(v, lag / step), y) for step, v, y in fewer]
        products = [
            sum(float(x[: x.size - k] @ y[k:]) for x, y in late)
            for k in range(int(MAX_SIGN_DELAY / every) + 1)
        ]
        square = sum(float(x @ x) for x, _ in late)
        next_to = sum(float(2 * (x[1:] @ x[:-1]) - x[-1] ** 2) for x, _ in late)
        whole = np.array(products) / (np.sqrt(square * power) or 1.0)
        # A mean of two comes half a sample later.
        both = 0.5 * (np.array(products[1:]) + products[:-1])
        both /= np.sqrt(max(0.25 * (2 * square + next_to), 0.0) * power) or 1.0
        best = max(best, *whole, *both)
        for alike, half in ((whole, 1), (both, 2)):
            if alike.min(initial=0.0) < worst:
                worst, reverse = float(alike.min()), [(_average(x, half), y) for x, y in late]
    if -worst <= MIN_SIGN_CORRELATION:  # chance is then irrelevant
        return SignCorrelation(best, -worst, np.inf)
    sizes = [float(np.sqrt((x @ x) * (y @ y))) for x, y in reverse]
    spread = [size * _compute_chance_std(x, y) for size, (x, y) in zip(sizes, reverse, strict=True)]
    chance = float(np.linalg.norm(spread)) / (sum(sizes) or 1.0)
    return SignCorrelation(best, -worst, chance)


def _average_runs(record: Record, signal: Array) -> tuple[float, Array, Array] | None:
    """Return interval, voltage and signal, averaged over runs that keep the voltage's power."""
    known = np.isfinite(signal)
    if known.sum() < 20:
        return None
    step = record.sample_time
    y, there = np.where(known, signal, 0.0), known.astype(np.float64)
    k, volts = max(1, len(record) // MAX_RUNS), record.voltage
    while k > 1 and 2 * np.square(_average(volts, k)).sum() < np.square(volts).sum():
        k //= 2
    return step, _average(volts, k), _average(y, k) / np.maximum(_average(there, k), 1e-9 + 0.5 / k)


def _decimate(values: Array, k: int) -> Array:
    """Return the means of k neighbours, one of each k."""
    n = values.size // k * k
    return np.asarray(values[:n].reshape(-1, k) @ np.full(k, 1 / k)) if 1 < k <= n else values


def _average(values: Array, k: int) -> Array:
    """Return the means of k neighbours, in the places of their last."""
    if k <= 1:
        return values
    sums = np.cumsum(values)
    sums[k:] -= sums[:-k].copy()
    return sums / k


def _compute_chance_std(v: Array, y: Array) -> float:
    """Return the standard deviation of the correlation of two independent signals (Bartlett).

    It is the sum of the product of their autocorrelations over n.
    """
    size = 1 << (2 * len(v)).bit_length()
    own = [irfft(np.abs(rfft(x, size)) ** 2, size)[: len(v)] for x in (v, y)]
    if own[0][0] == 0 or own[1][0] == 0:
        return 1.0
    product = (own[0] / own[0][0]) * (own[1] / own[1][0])
    return float(np.sqrt(max(1.0, 2 * product.sum() - 1) / len(v)))


def refuse_lost_sign(records: Sequence[Record], speeds: Sequence[Array], where: str) -> None:
    """Refuse signals whose sign was lost."""
    lowest = min(float(np.nanmin(r.voltage)) for r in records)
    ways = np.concatenate([_sum_travel(r, w) for r, w in zip(records, speeds, strict=True)])
    way, back = float(np.abs(ways).sum()), -float(np.minimum(ways, 0.0).sum())
    if lowest >= 0 and back > MAX_BACKWARD_SHARE * way and way - back > MAX_BACKWARD_SHARE * way:
        raise SignalError(
            f"{where}: the voltage is never negative, though {100 * back / way:.0f} % of the way "
            "is backwards: it has no sign; map its direction with direction=COLUMN, or record a "
            "signed command"
        )
    if all(_is_magnitude(r) for r in records):
        raise SignalError(
            f"{where}: velocity is never negative although the voltage is, and follows its size: "
            "it has no sign; record a signed speed, the encoder's counts or a direction"
        )


def _sum_travel(record: Record, speed: Array) -> Array:
    """Sum the travel of runs of samples, zero where sensor noise explains it."""
    starts = np.unique(np.linspace(0, speed.size, TRAVEL_RUNS, endpoint=False).astype(int))
    speed = np.nan_to_num(speed)
    ways = np.add.reduceat(speed, starts)
    squares = np.add.reduceat(np.square(np.diff(speed, prepend=speed[:1])), starts)
    # The errors of all speeds add up, of the differences of angles those at the two ends.
    share = 1 / np.diff(starts, append=speed.size) if record.velocity is None else 0.5
    return np.where(np.abs(ways) > MIN_SIGN_STDS * np.sqrt(squares * share), ways, 0.0)


def _is_magnitude(record: Record) -> bool:
    """Return whether a speed is the magnitude of the motor's response to its voltage."""
    speed, volts = record.velocity, record.voltage
    if speed is None or record.count is not None or record.position is not None:
        return False
    if np.nanmin(speed) < 0 or not volts.min() < 0 < volts.max():
        return False
    known = np.isfinite(speed)
    found = []
    for lag in np.geomspace(1.0, max(len(record) / 10, 2.0), MAGNITUDE_LAG_COUNT):
        made = apply_lag(volts, float(lag))[known]
        found.append([correlate(x, speed[known]) ** 2 for x in (made, np.abs(made))])
    signed, size = np.max(found, axis=0)
    return bool(size > MIN_EXPLAINED_SHARE and signed < MIN_EXPLAINED_SHARE * size)
