# SPDX-License-Identifier: Apache-2.0
"""Detect saturated sensors, and tell them from a regulated current."""

from collections.abc import Iterator

import numpy as np

from smp_motor_control.arrays import Array, Flags
from smp_motor_ident import limits
from smp_motor_ident.errors import SignalError
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import MIN_REGULATED_VARIANCE
from smp_motor_ident.quality.lag import correlate
from smp_motor_ident.record import Record

SMOOTHING_SAMPLES = 9  # length of a moving mean that keeps the motion of a counted speed


def refuse_saturation(record: Record, speed: Array, where: str) -> Iterator[Finding]:
    """Refuse a speed or current at its limit; yield a finding for a regulated current."""
    regulated = 0.0
    for name, unit in (("velocity", "rad/s"), ("current", "A")):
        values = getattr(record, name)
        if values is None:
            continue
        ok = np.isfinite(values)
        x, v = values[ok], record.voltage[ok]
        levels, times = np.unique(x, return_counts=True)
        if x.size < 50 or levels.size < 20 or _has_one_level(v):
            continue
        for limit in (x.max(), x.min()):
            at = x == limit
            if abs(limit) < 0.5 * np.abs(x).max():  # the extreme of the slower direction
                continue
            share = float(at.mean())
            next_times = times[-2] if limit == levels[-1] else times[1]
            runs = at[1:] & at[:-1]
            # A saturated sensor shows its limit far more often than the next level.
            if share < 0.01 or at.sum() < 5 * next_times or runs.sum() < 0.5 * at.sum():
                continue
            # The last samples of a rest may be late, of a voltage that has moved since.
            late = int(limits.MAX_LATE_ROWS)
            early = at & np.append(at[late:], [False] * late)
            if early.sum() < limits.MIN_ROWS_AT_LIMIT:
                continue
            low, high = np.percentile(v[early], [5, 95])
            if high - low < 10 * limits.VOLTMETER_SCATTER * np.ptp(v) and not _jumps_to_limit(
                x, at
            ):
                continue
            if name == "current" and _fits_constant_current(
                record.current == limit, record.voltage, speed
            ):
                regulated = max(regulated, abs(float(limit)))
                continue
            raise SignalError(
                f"{where}: saturated sensor, {name} rests at {limit:.4g} {unit} in "
                f"{100 * share:.1f} % of the samples while the voltage moves; widen its range or "
                "lower the excitation"
            )
    if regulated:
        yield _report_regulation(regulated)


def _report_regulation(current: float) -> Finding:
    """Report the effect of a current-regulating driver on the estimate."""
    return Finding(
        "current_regulated",
        "warning",
        f"the current rests at {current:.4g} A while the voltage follows the speed: a driver "
        "regulates it, and its rise time appears as the winding's lag (inductance, product of the "
        "time constants)",
        {"current": current, "quantity": "inductance"},
        "to identify the inductance, record with a driver that follows a command in volts",
    )


def _fits_constant_current(rests: Flags, voltage: Array, speed: Array) -> bool:
    """Return whether the voltage fits the speed at a constant current, ``v = R i + K w``.

    Behind a clipped sensor the current varies, and the voltage does not fit.
    """
    padded = np.pad(np.nan_to_num(speed), SMOOTHING_SAMPLES // 2, mode="edge")
    smooth = np.convolve(padded, np.full(SMOOTHING_SAMPLES, 1 / SMOOTHING_SAMPLES), mode="valid")
    return max(correlate(voltage[rests], smooth[rests]), 0.0) ** 2 > MIN_REGULATED_VARIANCE


def _has_one_level(v: Array) -> bool:
    """Return whether the voltage has one level, at which a motor may settle."""
    driven = v[np.abs(v) > limits.MAX_REST_VOLTAGE * np.abs(v).max()]
    scatter = 10 * limits.VOLTMETER_SCATTER * np.abs(driven).max(initial=0.0)
    return not driven.size or bool(np.ptp(driven) < scatter)


def _jumps_to_limit(x: Array, at: Flags) -> bool:
    """Return whether a signal jumps to its limit and scatters elsewhere: clipped, not settled."""
    enters = np.flatnonzero(at[1:] & ~at[:-1]) + 1
    rest = x[(x != x.max()) & (x != x.min())]
    if not enters.size or np.unique(rest).size < 0.5 * rest.size:
        return False
    return bool(np.median(np.abs(x[enters] - x[enters - 1])) > 1e-3 * np.ptp(x))
