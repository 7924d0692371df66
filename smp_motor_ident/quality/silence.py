# SPDX-License-Identifier: Apache-2.0
"""Detect silent sensors: dead, or with a motion below their resolution."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from smp_motor_control.arrays import Array, Flags
from smp_motor_ident._compile import compiled
from smp_motor_ident.errors import SignalError
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import (
    MIN_FLICKER_RATIO,
    MIN_REMAINING_SHARE,
    MIN_SAMPLES,
    MIN_SILENT_SWING,
)
from smp_motor_ident.quality.lag import apply_lag
from smp_motor_ident.record import Record

LAG_COUNT = 12  # between a sampling interval and a quarter of the record
FRICTIONS = (0.0, 0.1, 0.2, 0.35, 0.5, 0.7)  # tried friction, as a share of the largest voltage


def refuse_silent_sensor(record: Record, where: str) -> None:
    """Refuse a sensor that stops although the voltage would move the motor."""
    for name, a, b in _find_silences(record):
        raise SignalError(
            f"{where}: dead encoder, the {name} stays at {getattr(record, name)[a + 1] + 0.0:.6g} "
            f"from t = {record.time[a]:.4g} s to {record.time[b]:.4g} s while the voltage reaches "
            f"{np.abs(record.voltage[a + 1 : b]).max():.3g} V; check the encoder's cable, or that "
            "nothing blocks the motor"
        )


def remove_silences(record: Record) -> Record:
    """Remove the intervals in which a sensor is silent from a record.

    The rest determines the motor, whether the shaft was blocked or the encoder came loose.
    """
    least = MIN_REMAINING_SHARE * len(record)
    while found := next((s for s in _find_silences(record) if s[2] + 1 < len(record)), None):
        name, a, b = found
        rows = np.delete(np.arange(len(record)), np.s_[a:b])
        if rows.size < least:
            break
        begin, end = record.time[a], record.time[b]
        finding = Finding(
            "blocked",
            "warning",
            f"the {name} is constant from {begin:.4g} s to {end:.4g} s while the voltage would "
            "move the motor; this interval was left out",
            {"signal": name, "begin": float(begin), "end": float(end)},
            "look for a blocked motor, or for a loose cable of the encoder",
        )
        record = replace(record.take(rows), findings=(*record.findings, finding))
    return record


def _find_silences(record: Record) -> Iterator[tuple[str, int, int]]:
    """Yield each signal's longest silence during which the voltage would move the motor."""
    for name in ("count", "position", "velocity"):
        values = getattr(record, name)
        if values is None or len(record) < 200:
            continue
        # A constant speed is no silence unless it is zero.
        moves = values != 0 if name == "velocity" else np.diff(values, prepend=np.nan) != 0
        moves[list(record.starts)] = True  # a rest does not extend into the next run
        edges = np.concatenate([[0], np.flatnonzero(moves), [len(record) - 1]])
        longest = int(np.argmax(np.diff(edges)))
        a, b = int(edges[longest]), int(edges[longest + 1])
        if b - a < max(100, 0.1 * len(record)):
            continue
        still, rest = record.voltage[a + 1 : b], np.delete(record.voltage, np.arange(a, b))
        if np.abs(still).mean() <= 0.5 * np.abs(rest).mean():
            continue
        if _predict_swing(record, name, a, b) > MIN_SILENT_SWING:
            yield name, a, b


def _predict_swing(record: Record, name: str, a: int, b: int) -> float:
    """Return the expected swing of a sensor in a silence, in its smallest steps.

    The expectation is that of a motor with lag, winding and friction fitted to the rest of the
    record.  An angle swings by the integral of the speed between two reversals.
    """
    values, step = getattr(record, name), np.diff(record.time, prepend=record.time[0])
    levels = np.diff(np.unique(values[np.isfinite(values)]))
    levels = levels[levels > 1e-9 * levels.sum()]  # ignore floating-point rounding
    with np.errstate(divide="ignore", invalid="ignore"):
        speed = values if name == "velocity" else np.diff(values, prepend=np.nan) / step
    known = np.isfinite(speed)
    known[a : b + 1] = False
    known[list(record.starts)] = False
    if known.sum() < MIN_SAMPLES or not levels.size:
        return float("inf")  # the response of the motor is unknown
    expected, least = _predict_speed(record, speed, known), float(levels.min())
    if name == "velocity":
        # Differences of counts flicker, so that their mean resolves less than a step; a rounded
        # speed changes only where the motion crosses to the next level.
        changes = np.count_nonzero(np.diff(speed[known]))
        if changes < MIN_FLICKER_RATIO * np.abs(np.diff(expected[known])).sum() / least:
            return float(np.abs(expected[a:b]).max() / least)
        least *= float(np.median(step))
    turns = np.flatnonzero(np.diff(np.sign(expected[a:b]), prepend=np.nan) != 0)
    return float(np.abs(np.add.reduceat(expected[a:b] * step[a:b], turns)).max() / least)


def _predict_speed(record: Record, speed: Array, known: Flags) -> Array:
    """Return the speed expected from the voltage by a model fitted to the known samples."""
    step, volts = record.sample_time, record.voltage
    top, y = float(np.abs(volts).max()), speed[known]

    def run(motor: Array) -> tuple[Array, float]:
        """Return the motion and its sum of squared residuals, for two log lags and friction."""
        lags = np.exp(np.minimum(motor[:2], 50.0)) / step
        torque = apply_lag(volts, float(lags[1]))
        x = _simulate_friction(torque, float(np.exp(-1 / lags[0])), abs(float(motor[2])) * top)
        size, alike = float(x[known] @ x[known]), float(x[known] @ y)
        return x * (alike / size if size > 0 else 0.0), -(alike**2) / size if size > 0 else 0.0

    lags = np.linspace(np.log(step), np.log(record.duration / 4), LAG_COUNT)
    tried = [
        np.array([lag, winding, friction])
        for k, lag in enumerate(lags)
        for winding in (lags[0] - 2.0, *lags[: k + 1])
        for friction in FRICTIONS
    ]
    start: Array = min(tried, key=lambda motor: run(motor)[1])
    corners = start + np.vstack([np.zeros(3), np.diag([0.3, 0.5, 0.05])])
    options = {"initial_simplex": corners, "maxfev": 200, "xatol": 1e-3, "fatol": 0.0}
    from scipy.optimize import minimize  # takes a while to load

    descend: Any = minimize  # its stubs know no initial simplex
    found = descend(lambda motor: run(motor)[1], start, method="Nelder-Mead", options=options)
    return run(found.x)[0]


@compiled
def _simulate_friction(torque: Array, keeps: float, friction: float) -> Array:
    """Return the speed, in volts, of a motor with one lag and Coulomb friction."""
    out = np.zeros(torque.size)
    for n in range(1, torque.size):
        before = out[n - 1]
        sign = np.sign(before) if before != 0.0 else np.sign(torque[n])
        if before == 0.0 and abs(torque[n]) <= friction:
            continue
        target = torque[n] - sign * friction
        after = target + (before - target) * keeps
        out[n] = after if after * sign > 0.0 else 0.0
    return out
