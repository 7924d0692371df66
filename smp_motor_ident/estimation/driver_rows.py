"""The rows of records as a driver meets them: command and back-EMF; and what it makes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import uniform_filter1d

from smp_motor_control.arrays import Array
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.descent import initial_of
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.likelihood.experiments import Experiments, prepare
from smp_motor_ident.model.driver import Rows
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.record import Record

SUBSET, PIECES, LAGS = 5_000, 5, 10  # rows on which effects are ranked, in pieces of so many lags
SMOOTHED, MOST_SMOOTHED = 0.2, 1_000  # of the motor's lag, and rows: a measured speed is its mean


def pieces(group: Sequence[Record], step: float, lag: float) -> list[Record]:
    """Return pieces of long records, all over them, that outlive a motor's lag."""
    rows = sum(map(len, group))
    length = int(np.clip(LAGS * lag / step, SUBSET / PIECES, SUBSET))
    every = rows * length / SUBSET
    if every < 2 * length:
        return list(group)
    return [
        record.slice(a, a + length)
        for record in group
        for a in np.arange(0, len(record) - length + 1, every).astype(int)
    ] or list(group)


def commands_of(group: Sequence[Record], fit: Fit) -> Experiments:
    """Return records as a driver meets them: a command for each row, without the current."""
    data = prepare(group, False).measured_as(fit.structure.speed)
    return data if fit.structure.held == "interpolated" else data.held(fit.structure.held)


def with_voltages(group: Sequence[Record], voltage: Array) -> list[Record]:
    """Return records with other voltages, one after the other."""
    ends = np.cumsum([0, *map(len, group)])
    return [replace(r, voltage=voltage[a:b]) for r, (a, b) in zip(group, pairwise(ends))]


def under_drag(
    records: Sequence[Record], data: Experiments, fit: Fit, size: float, measured: bool = False
) -> list[Record]:
    """Return records of which the voltage is that behind a drag, for a winding without its current.

    A load torque T is a voltage ``-(R T + L dT/dt) / K`` beside a current ``T / K``.
    """
    if measured:
        speed = measured_speed(data, fit.z.time_constant)
    else:
        speed = prediction.simulate(data, replace(fit, initial=initial_of(data, fit)))[:, 0]
    steady = fit.z.a0 * speed
    most = np.abs(np.concatenate([r.voltage for r in records])) + np.abs(steady)
    lost = np.sign(steady) * np.minimum(size * np.square(steady), most)  # as `terminal_voltage`
    rise = np.concatenate([
        np.gradient(lost[a:b], data.time[a:b]) if b - a > 1 else np.zeros(b - a)
        for a, b in pairwise(data.starts)
    ])  # fmt: skip
    known = fit.structure.current
    late = (fit.z if known else fit.z.undamped()).electrical_time_constant * rise
    current = lost / float(np.exp(fit.z.ln_r)) if known else np.zeros(lost.size)
    ends = np.cumsum([0, *map(len, records)])
    return [
        replace(
            r,
            voltage=r.voltage - late[a:b],
            current=None if r.current is None else r.current - current[a:b],
        )
        for r, (a, b) in zip(records, pairwise(ends), strict=True)
    ]


def rows_of(data: Experiments, group: Sequence[Record], fit: Fit, measured: bool = False) -> Rows:
    """Return the commands of records and how the fitted motor runs, or did as measured."""
    speed = (
        measured_speed(data, fit.z.time_constant)
        if measured
        else prediction.simulate(data, fit)[:, 0]
    )
    first = np.zeros(data.size, dtype=np.bool_)
    first[data.starts[:-1]] = True
    middle, interval = speed.copy(), np.full(data.size, data.step)
    middle[1:] = np.where(first[1:], speed[1:], 0.5 * (speed[1:] + speed[:-1]))
    interval[1:] = np.where(first[1:], data.step, np.diff(data.time))
    back = emf_share(fit) * fit.z.a0
    command = np.concatenate([r.voltage for r in group])
    supply = min((r.hardware.supply_voltage or 0.0 for r in group), default=0.0)
    return Rows(command, back * middle, interval, first, fit.z.time_constant, supply)


def emf_share(fit: Fit) -> float:
    """Return what of the voltage at steady speed is back-EMF, between none and all of it.

    A descent may pass motors that viscous friction drives: behind a driver these run away.
    """
    return float(np.clip(fit.structure.internal(fit.z)[0][2] / fit.z.a0, 0.0, 1.0))


def measured_speed(data: Experiments, lag: float) -> Array:
    """Return the speed as measured, a mean over a fraction of the motor's lag."""
    width = int(np.clip(SMOOTHED * lag / data.step, 1, MOST_SMOOTHED))
    out = []
    for a, b in pairwise(data.starts):  # the time of each record is its own
        time, output = data.time[a:b], data.output[a:b]
        there = np.isfinite(output)
        if b - a < 2 or not there.any():  # nothing was measured, as where a motor stands
            out.append(np.zeros(b - a))
            continue
        speed = np.interp(time, time[there], output[there])
        if data.kind == ANGLE:
            speed = np.gradient(speed, time)
        out.append(uniform_filter1d(speed, width, mode="nearest"))
    return np.concatenate(out)
