# SPDX-License-Identifier: Apache-2.0
"""Resample all signals of a motor to its main output's times; split at gaps."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_control.arrays import Array, Flags, Integers
from smp_motor_ident.bag.clock import (
    BEAT_SAMPLES,
    average_held_input,
    find_first_time,
    measure_sampling,
)
from smp_motor_ident.bag.counter import Unwrapped, angle_resets, report_resets, unwrap
from smp_motor_ident.bag.drives import find_late_rows, responds_in_its_row
from smp_motor_ident.bag.mapping import MotorMap
from smp_motor_ident.bag.names import MOTIONS
from smp_motor_ident.bag.storage import Table, note
from smp_motor_ident.errors import BagError
from smp_motor_ident.finding import Finding, Severity
from smp_motor_ident.record import Hardware, Record

MIN_SHIFT_ROWS = 2  # smallest corrected shift; one row may be a voltage held before its row
MAX_TESTED_ROWS = 20_000  # rows examined for such a shift
MAX_BRIDGED_SAMPLES = 2  # samples that may be lost in a row before a new segment begins


@dataclass(eq=False)
class Context:
    """Mapping, hardware, tables and findings while the record of one motor is made."""

    wheel: str
    plan: MotorMap
    hardware: Hardware
    tables: Mapping[str, Table]
    source: str
    findings: list[Finding] = field(default_factory=list)

    @property
    def where(self) -> str:
        """Recording and wheel, for messages."""
        return f"{self.source}: {self.wheel}"

    def report(self, code: str, text: str, severity: Severity = "note", **evidence: float) -> None:
        """Add a finding, once."""
        finding = note(code, text, severity, **evidence)
        if finding not in self.findings:
            self.findings.append(finding)


@dataclass(eq=False)
class Series:
    """One signal's samples: time [ns] strictly increasing, value in SI at the motor shaft.

    ``number`` is the publisher's count, where it is known; ``bits`` the width of the
    message's field, for a counter.
    """

    time: Integers
    value: NDArray[Any]
    number: Integers | None = None
    bits: int | None = None

    def take(self, which: NDArray[Any]) -> "Series":
        """Return some of the samples, by their indices or a mask."""
        number = None if self.number is None else self.number[which]
        return Series(self.time[which], self.value[which], number, self.bits)


def resample(motor: Context, series: dict[str, Series], axis_name: str) -> Record:
    """Make a record of signals with different sampling instants."""
    if "supply" in series:
        _multiply_duty_by_supply(series)
    voltage = select_finite(series["voltage"])
    axis = series[axis_name].time
    alike = np.array_equal(voltage.time, axis)
    keep = np.ones(axis.size, bool) if alike else _mark_covered_samples(motor, voltage, axis)
    if keep.sum() < 2:
        raise BagError(f"{motor.where}: fewer than 2 samples have a voltage and an output")
    starts = _count_starts(motor, series, keep, axis_name)
    held = motor.plan.held or (
        _detect_hold(motor, voltage, series[axis_name], axis_name, starts) if alike else "after"
    )
    axis = axis[keep]
    values = average_held_input(voltage.time, voltage.value, held, axis)
    starts |= _find_gaps(motor, axis, alike, held, voltage, values)
    columns: dict[str, Any] = {
        name: _interpolate(motor, name, series[name], axis, keep)
        for name in ("current", "velocity", "position", "count")
        if name in series
    }
    if all(column is None for column in columns.values()):
        raise BagError(
            f"{motor.where}: no speed, position or count has a finite value; map another field"
        )
    record = Record(
        wheel=motor.wheel,
        time=(axis - axis[0]) * 1e-9,
        voltage=values,
        starts=tuple(np.flatnonzero(starts).tolist()),
        hardware=motor.hardware,
        source=motor.source,
        velocity_window=motor.plan.velocity_window,
        recorded=find_first_time(motor.tables[topic].logged for topic in motor.plan.topics),
        **columns,
    )
    record = record if motor.plan.own else _undo_delay(motor, record)
    record = _drop_single_samples(motor, record)
    findings = tuple(f for k, f in enumerate(motor.findings) if f not in motor.findings[:k])
    return replace(record, time=record.time - record.time[0], findings=findings)


def _undo_delay(motor: Context, record: Record) -> Record:
    """Shift a voltage that is recorded several rows late."""
    edges = (*record.starts, len(record))
    longest = int(np.argmax(np.diff(edges)))
    part = slice(edges[longest], min(edges[longest + 1], edges[longest] + MAX_TESTED_ROWS))
    name, motion = next((n, v[part]) for n in MOTIONS if (v := getattr(record, n)) is not None)
    sampling = measure_sampling(record.time[part])
    if not sampling.regular or not np.isfinite(motion).all():
        return record
    if name != "velocity":
        motion = np.diff(motion, prepend=motion[:1])
    rows = find_late_rows(record.voltage[part], motion.astype(np.float64))
    if rows < MIN_SHIFT_ROWS:
        return record
    late = rows * sampling.interval
    text = (
        f"the voltage is recorded {1e3 * late:.3g} ms ({rows} rows) after it acts, or the motion "
        "was smoothed in both directions; the voltage was moved back"
    )
    motor.report("voltage_late", text, "warning", rows=rows, late=late)
    kept = np.concatenate([np.arange(a, b - rows) for a, b in pairwise(edges)])
    if kept.size < 2:
        raise BagError(
            f"{motor.where}: the voltage is recorded {rows} rows late, and no segment is longer; "
            "record longer ones"
        )
    return replace(record, voltage=np.roll(record.voltage, -rows)).take(kept)


def _detect_hold(motor: Context, voltage: Series, output: Series, name: str, starts: Flags) -> str:
    """Return whether the motion shows that a voltage acts after its row or before it."""
    motion = output.value.astype(np.float64)
    if name != "velocity":
        motion = np.diff(motion, prepend=motion[:1])
    gap = measure_sampling(output.time).gap()
    motion[starts | (np.diff(output.time, prepend=output.time[:1]) > gap)] = np.nan
    if not responds_in_its_row(voltage.value, motion):
        return "after"
    text = f"the {name} responds in the row of a change of voltage: the voltage acts before its row"
    motor.report("held_before", f"{text} (held=before; map held=after if it did not)")
    return "before"


def select_finite(series: Series) -> Series:
    """Return the finite samples."""
    sound = np.isfinite(series.value)
    return series if sound.all() else series.take(sound)


def _multiply_duty_by_supply(series: dict[str, Series]) -> None:
    """Multiply the duty cycle by the measured supply voltage."""
    supply, voltage = select_finite(series.pop("supply")), series["voltage"]
    if not supply.time.size:
        raise BagError("the supply signal has no finite value")
    measured = np.interp(voltage.time - supply.time[0], supply.time - supply.time[0], supply.value)
    series["voltage"] = Series(voltage.time, voltage.value * measured)


def _mark_covered_samples(motor: Context, voltage: Series, axis: Integers) -> Flags:
    """Return which output samples lie where the input is known."""
    keep: Flags = axis >= voltage.time[0] if voltage.time.size else np.zeros(axis.size, bool)
    if not keep.all():
        text = f"{int((~keep).sum())} samples before the first voltage were left out"
        motor.report("no_voltage_yet", text)
    beat = measure_sampling(voltage.time)
    if beat.regular:
        limit = beat.gap()
        index = np.searchsorted(voltage.time, axis, "right") - 1
        age = axis - voltage.time[np.maximum(index, 0)]
        stale = keep & (age > limit)
        if stale.any():
            text = f"{int(stale.sum())} samples were left out: no voltage came for more than "
            motor.report("voltage_missing", f"{text}{limit * 1e-9:g} s", "warning")
        keep &= ~stale
    return keep


def _count_starts(motor: Context, series: dict[str, Series], keep: Flags, axis_name: str) -> Flags:
    """Unwrap a counter in place; return which kept samples begin a segment by a reset."""
    flags = np.zeros(keep.size, bool)
    flags[0] = True
    if axis_name == "count":
        counter = unwrap_counts(motor, series)
        motor.findings += counter.findings
        count = counter.count
        if np.abs(count.astype(np.float64)).max() >= 2.0**53:  # beyond exact floats
            count = count - count[0]
        series["count"] = Series(series["count"].time, count)
        flags[counter.resets] = True
    elif axis_name == "position":
        resets = angle_resets(series["position"].value)
        motor.findings += [report_resets("angle", resets.size)] if resets.size else []
        flags[resets] = True
    # A reset at a sample that is left out begins a segment at the next that is kept.
    begun = np.cumsum(flags)[keep]
    return np.concatenate([[True], np.diff(begun) > 0])


def unwrap_counts(motor: Context, series: dict[str, Series]) -> Unwrapped:
    """Return the counter without its wraps."""
    counted = series["count"]
    given = "encoder_bits" in motor.plan.hardware
    bits = motor.hardware.encoder_bits if given else counted.bits
    raw = counted.value
    if raw.dtype.kind == "f":
        raw = np.rint(raw).astype(np.int64)
    return unwrap(raw, bits, _expect_counts(series, motor.hardware))


def _expect_counts(series: dict[str, Series], hardware: Hardware) -> Array | None:
    """Return the counts between samples expected from a measured speed of the same rows."""
    speed = series.get("velocity")
    if speed is None or hardware.counts_per_revolution is None:
        return None
    time = series["count"].time
    if not np.array_equal(speed.time, time):
        return None
    per_radian = hardware.counts_per_revolution / (2 * np.pi)
    mean = 0.5 * (speed.value[1:] + speed.value[:-1])
    expected: Array = mean * (np.diff(time) * 1e-9) * per_radian
    return np.where(np.abs(expected) < 2.0**52, expected, 0.0)


def _find_gaps(
    motor: Context, axis: Integers, alike: bool, held: str, voltage: Series, values: Array
) -> Flags:
    """Return where segments begin because samples are missing; bridge the voltage over a few."""
    beat = measure_sampling(axis)
    steps, missing = np.diff(axis), beat.missing(axis)
    edges = [0, *(np.flatnonzero(steps > beat.gap()) + 1).tolist(), axis.size]
    for a, b in pairwise(edges):  # each run may have its own rate
        if (own := measure_sampling(axis[a:b])).regular and b - a > BEAT_SAMPLES:
            missing[a : b - 1] = own.missing(axis[a:b])
    if alike and voltage.number is not None:  # the publisher's numbers tell losses
        missing = np.maximum(np.diff(voltage.number) - 1, 0)
    given = motor.plan.gap
    limit = given * 1e9 if given else beat.gap(averaged=alike and held == "before")
    cut = steps > limit
    if alike and not given:
        cut |= missing > MAX_BRIDGED_SAMPLES
    bridged = (missing > 0) & ~cut
    if alike and bridged.any():  # by linear interpolation of the voltage
        k = np.flatnonzero(bridged)
        lost = missing[k]
        weight = (lost + 2 if held == "before" else lost) / (2 * (lost + 1))
        values[k + 1] = voltage.value[k] + np.diff(voltage.value)[k] * weight
    if bridged.any():
        text = f"{int(missing[bridged].sum())} samples missing in {int(bridged.sum())} places"
        text += "; their voltage was interpolated" if alike else "; the voltage there is known"
        motor.report("samples_missing", text, samples=int(missing[bridged].sum()))
    apart = [f.evidence for f in motor.findings if f.code in ("clock_set_back", "clock_set")]
    if cut.sum() > sum(float(e.get("times") or 0.0) for e in apart):
        text = f"{int(cut.sum())} gaps of up to {steps[cut].max() * 1e-9:.3g} s"
        text += f" ({int(missing[cut].sum())} samples missing)" if beat.regular else ""
        motor.report("gaps", f"{text}; a new segment begins after each", gaps=int(cut.sum()))
    if not beat.regular:
        text = (
            f"the sampling is irregular: median {beat.interval * 1e-6:.4g} ms, "
            f"from {steps.min() * 1e-6:.4g} to {steps.max() * 1e-6:.4g} ms"
        )
        motor.report("irregular_sampling", text)
    return np.concatenate([[True], cut])


def _interpolate(
    motor: Context, name: str, series: Series, axis: Integers, keep: Flags
) -> NDArray[Any] | None:
    """Return a signal at the axis's instants, NaN where it is not known."""
    if series.time.size == keep.size and np.array_equal(series.time[keep], axis):
        values = series.value if keep.all() else series.value[keep]
    else:
        sound = select_finite(series)
        if sound.time.size < 2:
            return None
        origin = sound.time[0]
        values = np.interp(axis - origin, sound.time - origin, sound.value, np.nan, np.nan)
        after = np.clip(np.searchsorted(sound.time, axis), 1, sound.time.size - 1)
        apart = sound.time[after] - sound.time[after - 1]
        exact = np.isin(axis, sound.time)
        values[(apart > 3 * measure_sampling(sound.time).interval) & ~exact] = np.nan
        motor.report("interpolated", f"{name}: interpolated to the instants of the main output")
    if name == "count":
        return values
    if not np.isfinite(values).all():
        values = np.where(np.isfinite(values), values, np.nan)
        if np.isnan(values).all():
            return None
        motor.report("values_missing", f"{name}: {int(np.isnan(values).sum())} values missing")
    return values


def _drop_single_samples(motor: Context, record: Record) -> Record:
    """Leave out segments of a single sample."""
    lengths = np.diff([*record.starts, len(record)])
    short = lengths < 2
    if not short.any():
        return record
    text = f"{int(short.sum())} single samples between gaps were left out"
    motor.report("single_samples", text)
    kept = np.flatnonzero(np.repeat(~short, lengths))
    if not kept.size:
        raise BagError(f"{motor.where}: fewer than 2 samples in a row are left")
    return record.take(kept)
