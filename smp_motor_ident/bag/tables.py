# SPDX-License-Identifier: Apache-2.0
"""Assign the columns of files to signals and time."""

import re
from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import numpy as np

from smp_motor_control.arrays import Flags, Integers
from smp_motor_control.errors import is_ros_name
from smp_motor_ident import limits
from smp_motor_ident.bag import clock, units
from smp_motor_ident.bag.mapping import DEFAULT_MOTOR, MotorMap, Signal, SignalMap
from smp_motor_ident.bag.names import MOTIONS, separates_motors
from smp_motor_ident.bag.readers.grid import strip_unit
from smp_motor_ident.bag.source import Recording
from smp_motor_ident.bag.storage import TABLE, Channel, Table, note
from smp_motor_ident.errors import BagError
from smp_motor_ident.finding import Finding

TIME_NAMES = (
    r"time|stamp|^t(?:[\W_]*(?:s|sec|ms|us|µs|ns))?[\W_]*$|^(?:ms|us|sec(?:onds)?)$|millis|micros|zeit"
    r"|temps|tiempo|tempo|(?:^|\W|_)tid(?:$|\W|_)|czas|čas|zaman|aika|(?:^|\W|_)(?:timp|idő|tijd)"
    r"|время|时间|時間|시간"
)
"""Names of a time column in several languages."""

MIN_TIMES_SINCE_1970 = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
"""Smallest times since 1970, by unit."""

RADIUS_TOLERANCE = 0.01
"""Relative tolerance within which a given radius is replaced by the file's exact one."""

_WHEELS = ((DEFAULT_MOTOR, ""), ("left", "left_"), ("right", "right_"))


def is_time_of_part(path: str) -> bool:
    """Return whether a field is the time of a part of a structure: ``speed.time``."""
    whole, _, last = path.rpartition(".")
    return bool(whole and re.search(TIME_NAMES, last, re.IGNORECASE))


def resolve_signals(plan: MotorMap, channels: list[Channel]) -> MotorMap:
    """Return a plan with the topics and fields of its signals as the files call them."""
    signals = dict(plan.signals)
    for name, signal in plan.signals.items():
        for topic in (c.topic for c in channels if not signal.topic and c.topic.startswith("/")):
            if signal.field.startswith(f"{topic}."):  # its whole name was in quotes
                signals[name] = replace(signal, topic=topic, field=signal.field[len(topic) + 1 :])
                break
    if tables := [channel for channel in channels if channel.encoding == TABLE]:
        signals = {name: _resolve_signal(name, signal, tables) for name, signal in signals.items()}
    return replace(plan, signals=signals)


def _resolve_signal(name: str, signal: Signal, tables: list[Channel]) -> Signal:
    """Find the column of a signal: in a topic, in the only table, or as an entry of its own."""
    whole = f"{signal.topic}.{signal.field}" if signal.topic else signal.field
    entry = re.fullmatch(r"(.+?)((?:\[\d+\])?)", whole)
    choices = [(signal.topic, signal.field), ("", whole)]
    choices += [(entry[1], "value" + entry[2])] if entry else []
    every = choices + [(c.topic, signal.field) for c in tables if not signal.topic]
    bare = [(c.topic, n) for c in tables for n in c.fields if strip_unit(n) == signal.field]
    for topic, field in every + (bare if len(bare) == 1 and not signal.topic else []):
        for channel in tables:
            if channel.topic == topic and field in channel.fields:
                unit = _choose_unit(name, signal, channel, field)
                return replace(signal, topic=topic, field=field, unit=unit)
    if len(tables) == 1:  # the table says which columns it has
        return replace(signal, topic=tables[0].topic, field=whole)
    return signal


def _choose_unit(name: str, signal: Signal, channel: Channel, field: str) -> str:
    """Return a signal's unit: as mapped, else as the file writes it."""
    if signal.unit or (signal.scale, signal.offset) != (1.0, 0.0):
        return signal.unit
    return units.find_unit(name, channel.units.get(field, ""), field)


def plan_from_names(recording: Recording, asked: SignalMap) -> dict[str, MotorMap]:
    """Return the plans of a table whose columns and units are named as the signals are.

    Those of a drivetrain have their side before the name, such as ``left_voltage``.
    """
    plans: dict[str, MotorMap] = {}
    channels = recording.channels()
    for channel, (wheel, before) in product(channels, _WHEELS):
        there = [n for n in ("voltage", *MOTIONS) if before + n in channel.fields]
        named = {name: before + name for name in there if wheel not in plans}
        moves = any(column in channel.units for name, column in named.items() if name in MOTIONS)
        if "time" in channel.fields and "voltage" in named and moves:
            signals = {name: Signal(channel.topic, column) for name, column in named.items()}
            signals["time"] = Signal(channel.topic, "time")
            given = asked.motors.get(wheel, asked.defaults)
            if abs(given.wheel_radius / (channel.wheel_radius or np.inf) - 1) < RADIUS_TOLERANCE:
                given = replace(given, wheel_radius=channel.wheel_radius)
            plans[wheel] = resolve_signals(replace(given, signals=signals), channels)
    if plans:
        return plans
    raise BagError(
        f"{recording.files[0]}: a table needs a mapping, such as "
        "voltage=u velocity=y:deg/s time=t (identify --topics suggests one)"
    )


def add_time_columns(
    recording: Recording, plans: Mapping[str, MotorMap], wanted: dict[str, list[str]]
) -> None:
    """Add the columns of time, and those that name motors, to the requested ones."""
    for plan in plans.values():
        for topic in plan.topics:
            wanted[topic] += [n for n in _motor_columns(recording, topic) if n not in wanted[topic]]
            signal = _time_signal(recording, plan, topic)
            if signal is not None and signal.field not in wanted[signal.topic]:
                wanted[signal.topic].append(signal.field)


def _time_signal(recording: Recording, plan: MotorMap, topic: str) -> Signal | None:
    """Return the column of time of a table; None where it needs none."""
    channel = next((c for c in recording.channels() if c.topic == topic), None)
    if channel is None or set(channel.fields) <= {"value"} or channel.fields[:1] == ("value[0]",):
        return None  # an entry with times of its own
    mapped = plan.signals.get("time")
    others = [(s.topic, s.field) for name, s in plan.signals.items() if name != "time"]
    if mapped is not None:
        own = mapped.field in channel.fields and (topic, mapped.field) not in others
        if mapped.topic == topic or own:
            return replace(
                mapped, topic=topic, unit=_choose_unit("time", mapped, channel, mapped.field)
            )
        if len(channel.fields) == 1 and mapped.topic:
            return mapped  # the time of its rows is in another file
    if plan.sample_time:
        return None
    likely = [name for name in channel.fields if re.search(TIME_NAMES, name, re.IGNORECASE)]
    if mapped is not None and likely:
        signal = Signal(topic, likely[0])
        return replace(signal, unit=_choose_unit("time", signal, channel, likely[0]))
    hint = f"time={likely[0]}" if likely else "time=COLUMN"
    raise BagError(
        f"{recording.files[0]}: the column of time is unknown; map {hint} or sample_time=SECONDS"
    )


def separate_motors(
    recording: Recording, wheel: str, plan: MotorMap, tables: Mapping[str, Table]
) -> list[tuple[str, Mapping[str, Table]]]:
    """Return the tables of each motor named in a column, by the motor's name.

    Bags, and tables without such a column or with rows of only one motor, belong to ``wheel``.
    """
    signals = [(signal.topic, signal.field) for signal in plan.signals.values()]
    for topic in plan.topics if recording.is_table and len(plan.topics) == 1 else ():
        for column, labels in _motor_columns(recording, topic).items():
            if (topic, column) in signals:
                continue
            of = tables[topic].columns[column]
            numbers, counts = np.unique(of[np.isfinite(of)], return_counts=True)
            stray = limits.MAX_STRAY_ROW_SHARE * of.size
            numbers, counts = numbers[counts > stray], counts[counts > stray]
            if numbers.size < 2 or of.size - counts.sum() > stray:
                continue
            own = [
                re.sub(r"\W+", "_", labels[int(n)]).strip("_") if labels else "" for n in numbers
            ]
            if len(set(filter(is_ros_name, own))) < len(own):
                own = [f"motor_{re.sub('[.-]', '_', f'{n:g}')}" for n in numbers]
            text = (
                f"{recording.name}: {column} separates the rows of {len(own)} motors: "
                f"{', '.join(own)}"
            )
            finding = note("several_motors", text, motors=len(own))
            motors = [_select_rows(tables[topic], of == n, finding) for n in numbers]
            before = "" if wheel == DEFAULT_MOTOR else f"{wheel}_"
            return [(before + n, {**tables, topic: rows}) for n, rows in zip(own, motors)]
    return [(wheel, tables)]


def _motor_columns(recording: Recording, topic: str) -> dict[str, tuple[str, ...]]:
    """Return the columns of a table that name motors, with the words for their numbers."""
    channel = next(c for c in recording.channels() if c.topic == topic)
    words = {name: channel.words.get(name, ()) for name in channel.fields}
    return {name: own for name, own in words.items() if separates_motors(name, own)}


def _select_rows(table: Table, which: Flags, finding: Finding) -> Table:
    """Return some rows of a table as they are in the file."""
    columns = {name: column[which] for name, column in table.columns.items()}
    log = None if table.log is None else table.log[which]
    return replace(table, log=log, columns=columns, findings=[*table.findings, finding])


def add_times(
    recording: Recording, plan: MotorMap, tables: Mapping[str, Table]
) -> dict[str, Table]:
    """Return a plan's tables with their times in nanoseconds; rows without one are left out."""
    result = {}
    written = []
    for topic in plan.topics:
        table = tables[topic]
        findings = list(table.findings)
        log = table.log
        if log is None:
            written.append(topic)
            signal = _time_signal(recording, plan, topic)
            size = next(iter(table.columns.values())).size
            if signal is None:
                log = np.rint(np.arange(size) * (plan.sample_time * 1e9)).astype(np.int64)
            else:
                of = tables[signal.topic]
                log, unit = _read_nanoseconds(of, signal)
                if log.size != size:
                    raise BagError(
                        f"{recording.name}: {topic} has {size} rows, and their time "
                        f"{signal.topic}.{signal.field} has {log.size}; give files of one length"
                    )
                if not unit and signal.field not in of.exact:
                    _check_seconds(log, signal, recording)
                if unit and unit != signal.unit:
                    text = f"{recording.name}: {signal.field} is read as {unit} since 1970"
                    findings.append(note("time_unit", text))
        sound = log > clock.MISSING_TIME
        columns = table.columns
        if not sound.all():
            text = f"{recording.name}: {int((~sound).sum())} rows without time were left out"
            findings.append(note("rows_without_time", text, "warning"))
            log, columns = log[sound], {name: c[sound] for name, c in columns.items()}
        if not log.size:
            raise BagError(
                f"{recording.files[0]}: has no row with a time from 1678 to 2262; correct its unit"
            )
        if log.size > 2 and not np.ptp(log):
            raise BagError(
                f"{recording.files[0]}: all {log.size} rows have the same time, "
                f"{1e-9 * log[0]:g} s: its clock did not run; map sample_time=SECONDS instead"
            )
        result[topic] = Table(log, None, columns, findings=findings, clocked=True)
    rows = {topic: result[topic] for topic in written}
    return result | clock.concatenate_runs(rows, plan.gap, recording.name)


def _check_seconds(log: Integers, signal: Signal, recording: Recording) -> None:
    """Refuse a time without unit whose rows are too far apart for seconds."""
    steps = np.diff(log[log > clock.MISSING_TIME]) * 1e-9
    step = float(np.median(steps)) if steps.size else 0.0
    if step >= limits.MAX_ROW_INTERVAL_S:
        raise BagError(
            f"{recording.files[0]}: {signal.field} rises by {step:g} per row, too fast for "
            f"seconds; give its unit: time={signal.field}:ms (or us, ns; s if it is seconds)"
        )


def _read_nanoseconds(table: Table, signal: Signal) -> tuple[Integers, str]:
    """Return the times of a table, `MISSING_TIME` for missing cells, and an inferred unit."""
    column = table.columns[signal.field]
    if signal.field in table.exact:
        return column.astype(np.int64), ""
    unit = signal.unit
    if not unit:
        size = np.nanmedian(np.abs(column.astype(np.float64))) if column.size else 0.0
        unit = next((name for least, name in MIN_TIMES_SINCE_1970 if size > least), "")
    return clock.nanoseconds(column, signal, unit), unit
