# SPDX-License-Identifier: Apache-2.0
"""Make the record of one motor from columns: units, clock, order, repairs, segments."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_control.arrays import Array, Integers
from smp_motor_control.motor.parameters import Gearbox
from smp_motor_ident.bag import checks, clock, counter, mapping, units
from smp_motor_ident.bag.axis import Context, Series, resample, select_finite, unwrap_counts
from smp_motor_ident.bag.storage import Table
from smp_motor_ident.errors import BagError
from smp_motor_ident.limits import MAX_COUNT_STEP, MAX_STRAY_ROW_SHARE
from smp_motor_ident.quality.stamps import find_beat, is_on_beat
from smp_motor_ident.record import Hardware, Record

_OUTPUTS = ("count", "position", "velocity")
_MOTION = ("velocity", "position")


def assemble(
    wheel: str, plan: mapping.MotorMap, hardware: Hardware, tables: Mapping[str, Table], source: str
) -> Record:
    """Make one motor's record."""
    motor = Context(wheel, plan, hardware, tables, source)
    for topic in plan.topics:
        motor.findings += tables[topic].findings
        if not tables[topic].logged.size:
            raise BagError(f"{motor.where}: {topic or 'it'} has no messages")
    axis_name = next((name for name in _OUTPUTS if name in plan.signals), None)
    if axis_name is None or "voltage" not in plan.signals:
        missing = "voltage" if axis_name else "velocity, position or count"
        raise BagError(f"{motor.where}: the mapping gives no {missing}")
    clocks = _choose_times(motor)
    arrivals = [topic for topic, time in clocks.items() if time is tables[topic].log]
    times, leaps = clock.remove_leaps(clocks, plan.gap)
    if leaps:
        text = (
            f"the time leaps by up to {_describe_span(max(leaps))} in {len(leaps)} places: the "
            "clock was set while recording, or these are runs of several days; each leap begins a "
            "new segment"
        )
        motor.report("clock_set", text, "warning", times=len(leaps), longest=max(leaps))
    if plan.clock == "auto":
        times |= {topic: _fit_arrivals(motor, topic, times[topic]) for topic in arrivals}
    given = {name: signal for name, signal in plan.signals.items() if name != "time"}
    series = {n: _take_series(motor, n, signal, times[signal.topic]) for n, signal in given.items()}
    for name in ("voltage", axis_name):
        if not np.isfinite(series[name].value).any():
            raise BagError(f"{motor.where}: {given[name].field} holds no number; map another field")
    together = plan.signals["voltage"].topic == plan.signals[axis_name].topic
    if together:
        _drop_incomplete_samples(motor, series, axis_name)
    elif axis_name == "count":  # a whole number has no NaN
        series["count"] = select_finite(series["count"])
    _check_series(motor, series)
    if together:
        _drop_incomplete_samples(motor, series, axis_name)
    return resample(motor, series, axis_name)


def _describe_span(seconds: float) -> str:
    days = seconds / 86_400
    return f"{days / 365.25:.3g} years" if days > 700 else f"{days:.3g} days"


def _fit_arrivals(motor: Context, topic: str, time: Integers) -> Integers:
    """Return arrival times fitted to the sender's period, unchanged if it has none."""
    table = motor.tables[topic]
    together = np.diff(time) == 0
    if together.any():
        alike = np.all([np.diff(column) == 0 for column in table.columns.values()], axis=0)
        # A held value repeats at any time, a duplicated message only at its own time.
        if np.mean(alike[together]) > 0.5 > np.mean(alike[~together]):
            return time
    beat = find_beat(time)
    if beat is None:
        return time
    if table.clocked and not beat.repeated:
        # The motion shows whether header stamps are the sampling instants.
        signal = next((s for n, s in motor.plan.signals.items() if n in _MOTION), None)
        if clock.measure_sampling(time).regular or signal is None or signal.topic != topic:
            return time
        motion = table.columns[signal.field].astype(np.float64)
        if not is_on_beat(beat, time, motion):
            return time
    text = (
        f"{topic or 'time'}: arrival times fitted to their period of {beat.period * 1e-6:.5g} ms "
        f"(median latency {beat.latency * 1e-6:.3g} ms)"
    )
    period, deviation, latency = (1e-9 * x for x in (beat.period, beat.deviation, beat.latency))
    motor.report("arrival_beat", text, period=period, deviation=deviation, latency=latency)
    return beat.time


def _check_series(motor: Context, series: dict[str, Series]) -> None:
    """Drop impossible values and an unsigned current; sign a magnitude by its direction."""
    if "direction" in series:
        way, volts = series.pop("direction"), series["voltage"].value
        stray = MAX_STRAY_ROW_SHARE * np.count_nonzero(volts)
        if min(np.sum(volts > 0), np.sum(volts < 0)) > stray:
            text = "the voltage has a sign already, so that the direction is not used; leave it out"
            motor.report("direction_not_used", text)
        else:
            series["voltage"] = checks.apply_direction(series["voltage"], way, motor.where)
    for name in sorted(series, key=lambda name: name != "count"):
        value = series[name].value
        if name == "count":  # a wrap is not a jump
            if last := counter.find_full_count(value):
                raise BagError(
                    f"{motor.where}: the count stays at {last}, the end of a counter's range: "
                    "it is saturated; record a wider counter, or one that wraps"
                )
            if checks.has_two_publishers(value.astype(np.float64)):
                raise BagError(
                    f"{motor.where}: the count alternates between two counters, so that two "
                    "nodes published it at once; stop one of them and record again"
                )
            count = unwrap_counts(motor, series).count
            value = (count - count[:1]).astype(np.float64)
            step = np.quantile(np.abs(np.diff(value)), 0.9) if value.size > 1 else 0.0
            if step > MAX_COUNT_STEP and not motor.plan.own:
                raise BagError(
                    f"{motor.where}: the count moves by {step:.2g} between samples, more than an "
                    "encoder can; map the column of its counts"
                )
        bad = checks.find_impossible_values(
            value, steps_allowed=name in ("voltage", "supply", "current")
        )
        if bad.any():
            worst = float(np.abs(value[bad]).max())
            text = f"{name}: {int(bad.sum())} values with impossible jumps (up to {worst:.4g})"
            motor.report(
                "impossible_jump", f"{text} were left out", "warning", values=int(bad.sum())
            )
            if name == "count":  # a whole number has no NaN: the samples go
                time = series[name].time
                alike = [k for k, signal in series.items() if np.array_equal(signal.time, time)]
                series.update({k: series[k].take(~bad) for k in alike})
            else:
                series[name].value = np.where(bad, np.nan, value)
    if "current" in series and checks.is_unsigned(series["voltage"], series["current"]):
        del series["current"]
        text = (
            "current: it is positive in both directions, so it is the supply's current or has lost "
            "its sign; it was left out"
        )
        motor.report("unsigned_current", text, "warning")
    ways = [series[name].value for name in ("position", "count") if name in series]
    moved = any(np.nan_to_num(np.diff(way)).any() for way in ways)
    if moved and "velocity" in series and not np.nan_to_num(series["velocity"].value).any():
        del series["velocity"]
        text = "velocity: it is 0 while the motor turns: its driver does not fill it in"
        motor.report("velocity_not_filled", f"{text}; it was left out", "warning")


def _choose_times(motor: Context) -> dict[str, Integers]:
    """Return the time [ns] of every topic's messages, all on one clock."""
    tables = {topic: motor.tables[topic] for topic in motor.plan.topics}
    logged = {topic: table.logged for topic, table in tables.items()}
    if all(table.clocked for table in tables.values()):
        return logged
    stamps = {topic: _read_stamps(motor, table) for topic, table in tables.items()}
    if motor.plan.clock == "log":
        motor.report("time_base", "time: log times, as clock=log requests")
        return logged
    judged = {topic: clock.judge_stamps(stamps[topic], log) for topic, log in logged.items()}
    poor = {topic: reason for topic, reason in judged.items() if reason}
    if motor.plan.clock == "header" and poor:
        topic, reason = next(iter(poor.items()))
        raise BagError(f"{motor.where}: {topic} has no usable header time: {reason}")
    usable = {t: s for t, s in stamps.items() if s is not None and t not in poor}
    fits = {topic: clock.fit_clock(stamp, logged[topic]) for topic, stamp in usable.items()}
    offsets = [fit.offset for fit in fits.values()]
    if not poor and max(offsets) - min(offsets) < clock.MAX_CLOCK_OFFSET_NS:
        text = "time: header stamps (the instants of sampling, free of transport delay)"
        motor.report("time_base", text)
        _report_offset(motor, *next(iter(fits.items())))
        if any(len(clock.split_at_resets(stamp)) > 1 for stamp in usable.values()):
            return _times_across_resets(motor, logged, usable)
        return usable
    if not fits:
        motor.report("time_base", f"time: log times ({next(iter(poor.values()))})")
        return logged
    because = "; ".join(f"{topic}: {why}" for topic, why in poor.items())
    text = "time: header stamps moved to the recorder's clock by their offset and drift, because "
    motor.report("time_base", text + (because or "the topics' clocks differ"))
    for topic, fit in fits.items():
        _report_offset(motor, topic, fit, always=True)
    return logged | {topic: fit.to_log(usable[topic]) for topic, fit in fits.items()}


def _times_across_resets(
    motor: Context, logged: dict[str, Integers], stamps: dict[str, Integers]
) -> dict[str, Integers]:
    """Return times for a recording during which the clock of the stamps was set back."""
    if len(logged) > 1:
        motor.findings.pop()
        text = "time: log times (the clock of the header stamps was set back while recording)"
        motor.report("time_base", text)
        return logged
    ((topic, log),) = logged.items()
    stamp = stamps[topic]
    parts = clock.split_at_resets(stamp)
    least = clock.pause_between(stamp, parts, motor.plan.gap)
    pauses = [max(int(log[begin] - log[begin - 1]), least) for begin, _ in parts[1:]]
    time = clock.concatenate_parts([stamp], [parts], pauses)[0]
    text = f"{topic}: the clock of the header stamps was set back {len(pauses)} times"
    motor.report("clock_set_back", f"{text}; a new segment at each", "warning", times=len(pauses))
    return {topic: time}


def _read_stamps(motor: Context, table: Table) -> Integers | None:
    """Return a topic's stamps: the field that the mapping names, else the header's."""
    signal = motor.plan.signals.get("time")
    if signal is None or motor.tables.get(signal.topic) is not table:
        return table.stamp
    column = table.columns.get(signal.field)
    if column is None:
        return None
    time = clock.nanoseconds(column, signal, signal.unit)
    return np.where(time == clock.MISSING_TIME, 0, time)


def _report_offset(motor: Context, topic: str, fit: clock.ClockFit, always: bool = False) -> None:
    if always or abs(fit.offset) > 1e9 or abs(fit.drift) > 1e-4:
        text = (
            f"{topic}: the recorder's clock is {fit.offset * 1e-9:+.6f} s from the header's, "
            f"drifting by {fit.drift * 1e6:+.0f} ppm"
        )
        motor.report("clock_offset", text, offset=fit.offset * 1e-9, drift=fit.drift)


def _take_series(motor: Context, name: str, signal: mapping.Signal, time: Integers) -> Series:
    """Return one signal's valid samples in SI at the motor shaft, in order."""
    table = motor.tables[signal.topic]
    column = table.columns.get(signal.field)
    there = table.present.get(signal.field)
    order = np.zeros(0, np.int64) if column is None else _sort(motor, time, table, signal.topic)
    keep = order if there is None else order[there[order]]
    if column is None or not keep.size:
        raise BagError(f"{motor.where}: no message of {signal.topic} has {signal.field}")
    values = column[keep]
    number = None if table.number is None else table.number[keep]
    bits = None
    if name == "count" and column.dtype.kind in "iu" and column.dtype.itemsize < 4:
        bits = 8 * column.dtype.itemsize
    return Series(time[keep], _convert(motor, name, signal, values), number, bits)


def _sort(motor: Context, time: Integers, table: Table, topic: str) -> Integers:
    """Return the indices that sort the samples by time without duplicates; report repairs."""
    steps = np.diff(time)
    if np.all(steps > 0):
        return np.arange(time.size)
    late = int(np.sum(steps < 0))
    order = np.argsort(time, kind="stable")
    ordered = time[order]
    first = np.concatenate([[True], np.diff(ordered) > 0])
    where = topic or "rows"
    if late:
        text = f"{where}: {late} samples came out of order and were sorted"
        motor.report("samples_reordered", text, samples=late)
    if doubles := int((~first).sum()):
        again = order[~first]
        before = order[np.flatnonzero(~first) - 1]
        differ = [
            name
            for name, column in table.columns.items()
            if not np.array_equal(column[again], column[before], equal_nan=column.dtype.kind == "f")
        ]
        text = f"{where}: {doubles} samples with a repeated time were left out"
        text += f" although they differ in {', '.join(differ)}" if differ else " (duplicates)"
        motor.report("duplicate_samples", text, "warning" if differ else "note", samples=doubles)
    chosen: Integers = order[first]
    return chosen


def _convert(motor: Context, name: str, signal: mapping.Signal, raw: NDArray[Any]) -> NDArray[Any]:
    """Return values in SI at the motor shaft; counts as int64."""
    if name == "count":
        exact = signal.scale == 1 and signal.offset == 0
        if raw.dtype.kind in "iu" and exact:
            return raw.astype(np.int64, copy=False)
        return raw.astype(np.float64) * signal.scale + signal.offset
    plain = signal.scale == 1 and signal.offset == 0 and not motor.plan.own
    where = signal.topic.rpartition("/")[2] if signal.field == "data" else signal.field
    named = units.find_unit(name, "", where) if plain else ""
    unit = signal.unit or named or units.check_unit(name, "")
    values: Array = raw.astype(np.float64)
    values *= signal.scale
    values += signal.offset
    hardware, plan = motor.hardware, motor.plan
    measured = "supply" in plan.signals and name == "voltage"  # multiplied in below
    known = {
        "counts_per_revolution": hardware.counts_per_revolution,
        "supply_voltage": 1.0 if measured else hardware.supply_voltage,
        "wheel_radius": plan.wheel_radius,
        "pwm_full_scale": plan.pwm_full_scale,
        "pole_pairs": plan.pole_pairs,
    }
    try:
        values *= units.factor(name, unit, known)
    except BagError as error:
        seen = f" (its largest value here is {np.nanmax(np.abs(raw)):g})" if raw.size else ""
        raise BagError(f"{motor.where}: {error}{seen if unit == 'pwm' else ''}") from None
    supply = known["supply_voltage"]
    if units.needs(name, unit, "supply_voltage") and supply is not None:
        values = _clamp_to_supply(motor, values, supply)
    shaft = signal.shaft or motor.plan.shaft
    if unit.startswith("ticks"):
        shaft = signal.shaft or "motor"
    if name == "position" and not motor.plan.own:
        values, width = counter.unwrap_angle(values)
        if width:
            turns = width / (2 * np.pi)
            at = "one turn" if abs(turns - 1) < 1e-9 else f"{turns:.6g} turns"
            motor.report("angle_wraps", f"position: wraps at {at}; it was unwrapped")
    if name in ("velocity", "position") and shaft == "wheel":
        values = Gearbox(motor.hardware.gear_ratio).to_motor(values)
    return values


def _clamp_to_supply(motor: Context, volts: Array, supply: float) -> Array:
    """Return the commanded voltage clamped to the supply."""
    beyond = int(np.sum(np.abs(volts) > supply * (1 + 1e-6)))  # allow for float32 rounding
    if beyond:
        motor.report(
            "beyond_full_scale",
            f"{beyond} samples of the command are beyond 100 % (up to "
            f"{100 * np.nanmax(np.abs(volts)) / supply:.0f} %) and were clamped to it; give the "
            "pwm_full_scale that is 100 %, and write codes such as a brake command as 0",
            "warning",
            samples=beyond,
        )
    return np.clip(volts, -supply, supply)


def _drop_incomplete_samples(motor: Context, series: dict[str, Series], axis_name: str) -> None:
    """Leave out the samples of a common topic whose voltage or output is not finite."""
    axis, voltage = series[axis_name], series["voltage"]
    if not np.array_equal(axis.time, voltage.time):
        return
    sound = np.isfinite(voltage.value)
    values = axis.value
    both, either = sound & np.isfinite(values), sound | np.isfinite(values)
    if both.sum() < 0.5 * either.sum():  # rows of several kinds: each signal has its own
        for name, signal in series.items():
            series[name] = signal.take(np.isfinite(signal.value))
        return
    if axis_name == "count" and values.dtype.kind == "f":
        sound &= np.isfinite(values)
    if sound.all():
        return
    what = "count" if np.isfinite(voltage.value).all() else "voltage"
    text = f"{int((~sound).sum())} samples without a finite {what} were left out"
    motor.report("no_voltage", text, "warning")
    alike = [name for name, signal in series.items() if np.array_equal(signal.time, axis.time)]
    series.update({name: series[name].take(sound) for name in alike})
