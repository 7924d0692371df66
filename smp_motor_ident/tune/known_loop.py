# SPDX-License-Identifier: Apache-2.0
"""Reconstruct the command of a known loop from logged set-points and speeds.

A loop's arithmetic is deterministic: its set-points and speeds give its commands, starting from a
known state, such as rest with a set-point of 0.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.errors import SignalError
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import LOOP_RATE_TOLERANCE, MAX_COMMAND_ERROR, TICK_TOLERANCE
from smp_motor_ident.record import Record

Step = Callable[[float, float], float]
"""From set-point, in the target's unit, and speed of the wheel [rad/s] to the command [V]."""

INTERVAL_TOLERANCE = 0.5  # relative excess of an interval that indicates a lost sample

DITHER_COUNT = 4  # simulations that estimate the error of rounding


@dataclass(frozen=True)
class Setting:
    """Properties of a robot that a loop's arithmetic needs."""

    numbers: Mapping[str, float]  # gains, by the target's names
    sample_time: float  # [s]
    supply: float  # voltage of a full command [V]
    ticks: float  # counts of a radian of the wheel; NaN where they are not known


@dataclass(frozen=True)
class KnownLoop:
    """The arithmetic of a target."""

    defaults: Mapping[str, float]  # its numbers; NaN for those that must be given
    start: Callable[[Setting], Step]  # from a setting to the step of a loop that begins at rest
    # From the numbers to the loop's interval [s]; NaN where it is that of the log
    interval: Callable[[Mapping[str, float]], float] = lambda numbers: math.nan


def reconstruct(record: Record, loop: KnownLoop, numbers: Mapping[str, float]) -> Record:
    """Return a record with set-points as ``voltage`` replaced by the voltages of the loop.

    The record ends at the first lost sample.  Raises SignalError if the commands are unknown: no
    speed or supply, a rate that differs from the loop's, a start in motion, coarse speeds.
    """
    where = f"{record.source}: {record.wheel}"
    supply, velocity = record.hardware.supply_voltage, record.velocity
    if velocity is None or not np.all(np.isfinite(velocity)):
        raise SignalError(f"{where}: the loop's speed is missing at some samples; map velocity")
    if supply is None:
        raise SignalError(
            f"{where}: the supply is unknown, and so is a command's voltage; map "
            "supply_voltage=VOLTS"
        )
    T = _check_interval(record, loop, numbers)
    record = _cut_at_lost_sample(record, T)
    assert record.velocity is not None
    if record.voltage[1] != 0.0 or record.velocity[0] != 0.0:
        raise SignalError(
            f"{where}: begins while the loop is running, with an unknown integral; "
            "record from rest, before the first set-point"
        )
    per_turn = record.hardware.counts_per_revolution
    ticks = math.nan if per_turn is None else per_turn * record.hardware.gear_ratio / (2 * math.pi)
    setting = Setting(numbers, T, supply, ticks)
    speed = record.velocity / record.hardware.gear_ratio
    speed, step, counted = _restore_loop_speed(speed, setting)
    volts = _replay(loop.start(setting), record.voltage, speed)
    error = _find_error(loop, setting, record.voltage, speed, step)
    if error > MAX_COMMAND_ERROR * supply:
        raise SignalError(
            f"{where}: the speed was logged in steps of {step:.3g} rad/s, so the command is known "
            f"to {error:.2g} V only; log more digits, or give counts_per_revolution if this "
            "is a tick of the encoder"
        )
    note = Finding(
        "reconstructed_voltage",
        "note",
        f"voltage: reconstructed from the known controller ({len(record)} samples); it depends on "
        f"its gains and the supply of {supply:g} V",
        {"error": error},
    )
    return replace(record, voltage=volts, findings=(*record.findings, note), **counted)


def _check_interval(record: Record, loop: KnownLoop, numbers: Mapping[str, float]) -> float:
    """Return the interval of the loop [s]; SignalError if the log has another one."""
    logged, T = record.sample_time, loop.interval(numbers)
    if math.isnan(T):
        return logged
    if abs(logged / T - 1) > LOOP_RATE_TOLERANCE:
        raise SignalError(
            f"{record.source}: {record.wheel}: logged every {1e3 * logged:.4g} ms, and the loop "
            f"ran every {1e3 * T:.4g} ms: commands between two rows are not known; log every step"
        )
    return T


def _cut_at_lost_sample(record: Record, T: float) -> Record:
    """Return the record up to the first lost sample."""
    lost = np.flatnonzero(np.diff(record.time) > (1 + INTERVAL_TOLERANCE) * T)
    end = min([len(record), *record.starts[1:], *(lost[:1] + 1)])
    if end < len(record):
        if end < 2:
            raise SignalError(
                f"{record.source}: {record.wheel}: the second sample is missing, so the "
                "commands are unknown; log every step"
            )
        text = (
            f"a sample is missing at {record.time[end - 1]:.4g} s; the recording is used up to it"
        )
        note = Finding("lost_loop", "warning", text, {"samples": float(end)})
        record = record.slice(0, int(end))
        record = replace(record, findings=(*record.findings, note))
    return record


def _restore_loop_speed(speed: Array, setting: Setting) -> tuple[Array, float, dict[str, Any]]:
    """Return the loop's own speed, the rounding of its log, and its counts.

    Whole ticks of every interval are counts: known far better than the speed at each instant.
    """
    if math.isfinite(setting.ticks):
        exact = speed * setting.ticks * setting.sample_time
        ticks = np.rint(exact)
        whole = np.abs(exact - ticks) < TICK_TOLERANCE
        if np.mean(whole) > 1 - TICK_TOLERANCE:
            counted = {"count": np.cumsum(ticks), "velocity": None} if whole.all() else {}
            return ticks / setting.ticks / setting.sample_time, 0.0, counted
    gaps = np.diff(np.unique(np.abs(speed)))
    gaps = gaps[gaps > 1e-9 * np.abs(speed).max(initial=1e-9)]
    step = float(gaps.min()) if gaps.size else 0.0
    on_grid = step > 0 and np.abs(speed / step - np.rint(speed / step)).max() < 0.1
    return speed, step if on_grid else 0.0, {}


def _replay(step: Step, setpoints: Array, speed: Array) -> Array:
    """Return the voltages over the intervals that end at the samples."""
    volts = np.zeros(speed.size)
    for k in range(speed.size - 1):
        volts[k + 1] = step(float(setpoints[k + 1]), float(speed[k]))
    return volts


def _find_error(
    loop: KnownLoop, setting: Setting, setpoints: Array, speed: Array, step: float
) -> float:
    """Return the error of the command by rounding of the logged speed, rms [V]."""
    if step == 0.0:
        return 0.0
    rng: Any = np.random.default_rng(0)
    plain = _replay(loop.start(setting), setpoints, speed)
    errors = []
    for _ in range(DITHER_COUNT):
        other = speed + rng.uniform(-0.5, 0.5, speed.size) * step
        errors.append(_replay(loop.start(setting), setpoints, other) - plain)
    return float(np.sqrt(np.mean(np.square(errors))))
