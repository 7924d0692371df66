# SPDX-License-Identifier: Apache-2.0
"""Read records from paths and a mapping."""

import math
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from smp_motor_control.errors import is_ros_name
from smp_motor_ident.bag import mapping as mappings
from smp_motor_ident.bag.assemble import assemble
from smp_motor_ident.bag.decode import collect
from smp_motor_ident.bag.mapping import MotorMap, Signal, SignalMap
from smp_motor_ident.bag.names import is_speed_command
from smp_motor_ident.bag.source import Recording, find_recordings
from smp_motor_ident.bag.storage import Channel, Table, note
from smp_motor_ident.bag.tables import (
    add_time_columns,
    add_times,
    plan_from_names,
    resolve_signals,
    separate_motors,
)
from smp_motor_ident.bag.types import Types
from smp_motor_ident.errors import BagError
from smp_motor_ident.finding import Finding
from smp_motor_ident.record import Hardware, Record

STATE, DESCRIPTION = "smp_interfaces/msg/MotorState", "smp_interfaces/msg/MotorDescription"
OWN_FIELDS = {name: name for name in ("voltage", "current", "velocity", "position")}
OWN_FIELDS["count"] = "encoder_count"
PAUSE_BETWEEN_RECORDINGS_S = 1.0  # pause [s] between two joined recordings


def read_experiments(paths: Any, mapping: Any = None) -> dict[str, list[Record]]:
    """Read recordings as `read_records` does, each as records of its own, in their order.

    Unreadable recordings in a folder become findings of the others.
    """
    asked = mappings.read_mapping(mapping)
    types = Types(asked.msg_files)
    read: dict[str, list[Record]] = {}
    failures: list[BagError] = []
    signals = [signal for motor in asked.motors.values() for signal in motor.signals.values()]
    topics = {signal.topic or signal.field for signal in signals}
    for recording in find_recordings(paths, topics):
        try:
            for record in read_recording(recording, asked, types):
                read.setdefault(record.wheel, []).append(record)
        except BagError as error:
            if not recording.one_of_many:
                raise
            failures.append(error)
    if failures and not read:
        raise failures[0]
    if failures:
        missing = tuple(note("not_read", f"not read: {error}", "warning") for error in failures)
        read = {
            wheel: [replace(record, findings=(*record.findings, *missing)) for record in records]
            for wheel, records in read.items()
        }
    return read


def read_records(paths: Any, mapping: Any = None) -> dict[str, Record]:
    """Read recordings as one record per wheel; each recording begins a segment of its own.

    Parameters
    ----------
    paths : path or sequence of paths
        Bags (folders or bare files), folders of bags, or tables of any format of
        `smp_motor_ident.bag.readers`.
    mapping : SignalMap, dict, path of a YAML file, list of command-line items, or None
        Which topics, fields or columns are which signals; not needed for recordings of
        our own messages.

    Returns
    -------
    dict of str to Record
        By wheel.

    Raises
    ------
    BagError
        When a path cannot be read, holds no motor, or recordings of one wheel contradict each
        other; the message says which.
    """
    experiments = read_experiments(paths, mapping)
    return {wheel: join_records(records) for wheel, records in experiments.items()}


def join_records(records: list[Record]) -> Record:
    """Join recordings of one motor; each begins a new segment, one second after the last."""
    if len(records) == 1:
        return records[0]
    first = records[0]
    for other in records[1:]:
        for name in ("gear_ratio", "counts_per_revolution"):
            here, there = getattr(first.hardware, name), getattr(other.hardware, name)
            if here != there:
                raise BagError(
                    f"{first.wheel}: {name} is {here} in {first.source} and {there} in "
                    f"{other.source}; identify them apart"
                )
    offsets = np.cumsum([0.0, *(r.duration + PAUSE_BETWEEN_RECORDINGS_S for r in records)])[:-1]
    lengths = np.cumsum([0, *(len(r) for r in records)])[:-1].tolist()
    findings = [replace(f, message=f"{r.source}: {f.message}") for r in records for f in r.findings]
    columns: dict[str, Any] = dict.fromkeys(OWN_FIELDS)
    for name in OWN_FIELDS:
        parts = [getattr(r, name) for r in records]
        if all(part is None for part in parts):
            continue
        if any(part is None for part in parts):
            if name == "count":
                text = "count: not in all recordings, left out"
                findings.append(note("count_left_out", text, "warning"))
                continue
            parts = [np.full(len(r), np.nan) if p is None else p for r, p in zip(records, parts)]
        columns[name] = np.concatenate(parts)
    return replace(
        first,
        time=np.concatenate([r.time + offset for r, offset in zip(records, offsets)]),
        starts=tuple(s + n for r, n in zip(records, lengths) for s in r.starts),
        source=", ".join(dict.fromkeys(r.source for r in records)),
        findings=tuple(f for k, f in enumerate(findings) if f not in findings[:k]),
        **columns,
    )


def read_recording(recording: Recording, asked: SignalMap, types: Types) -> list[Record]:
    """Return a recording's records."""
    with errors_in_one_line(recording):
        return _assemble_records(recording, asked, types)


@contextmanager
def errors_in_one_line(recording: Recording) -> Iterator[None]:
    """Turn any error into a one-line `BagError` that includes earlier findings."""
    try:
        with np.errstate(all="ignore"):  # damaged numbers may have any size
            yield
    except BagError as error:
        amiss = [f.message for f in recording.findings if f.message not in str(error)]
        text, file = str(error), recording.files[0]
        where = "" if file.name in text or recording.name in text else f"{file}: "
        raise BagError("; ".join([where + text, *amiss])) from None
    except _DAMAGE as error:
        reason = (str(error).splitlines() or [""])[0][:200]
        raise BagError(
            f"{recording.files[0]}: is damaged in a way that cannot be read "
            f"({type(error).__name__}: {reason})"
        ) from None


_DAMAGE = (
    ArithmeticError, AttributeError, LookupError, MemoryError, OSError, RecursionError,
    TypeError, ValueError, struct.error,
)  # fmt: skip
"""Errors of readers on damaged bytes, reported with the file instead of the code."""


def _assemble_records(recording: Recording, asked: SignalMap, types: Types) -> list[Record]:
    """Return the records of a bag or of tables."""
    channels = recording.channels()
    plans = _plan(recording, asked, channels)
    wanted: dict[str, list[str]] = {}
    signals = [signal for plan in plans.values() for signal in plan.signals.values()]
    for topic, name in dict.fromkeys((signal.topic, signal.field) for signal in signals):
        wanted.setdefault(topic, []).append(name)
    descriptions = [c.topic for c in channels if c.type == DESCRIPTION]
    wanted.update({topic: list(mappings.DESCRIBED) for topic in descriptions})
    if recording.is_table:
        add_time_columns(recording, plans, wanted)
    tables = collect(recording, wanted, types)
    records: list[Record] = []
    failures: list[BagError] = []
    for wheel in list(plans):
        plan = plans.pop(wheel)
        description, findings = _find_description(wheel, plan, descriptions, tables)
        plan = replace(plan, hardware={**description, **plan.hardware})
        try:
            for name, mine in separate_motors(recording, wheel, plan, tables):
                mine = add_times(recording, plan, mine) if recording.is_table else mine
                record = assemble(name, plan, make_hardware(plan.hardware), mine, recording.name)
                doubts = _question_voltage(plan, channels)
                records.append(replace(record, findings=(*findings, *doubts, *record.findings)))
        except BagError as error:
            if not plan.own:
                raise
            failures.append(error)
        used = {topic for other in plans.values() for topic in other.topics}
        for topic in {*plan.topics} - used:
            del tables[topic]  # its memory is needed for the next
    if failures and not records:
        raise failures[0]
    missing = [note("not_read", f"not read: {error}", "warning") for error in failures]
    shared = (*recording.findings, *missing)
    return [replace(record, findings=(*shared, *record.findings)) for record in records]


def _plan(recording: Recording, asked: SignalMap, channels: list[Channel]) -> dict[str, MotorMap]:
    """Return the signals of every wheel, mapped by the user or given by our own messages."""
    topics = {channel.topic for channel in channels}
    mapped = {wheel: plan for wheel, plan in asked.motors.items() if plan.signals}
    if mapped:
        plans = {wheel: resolve_signals(plan, channels) for wheel, plan in mapped.items()}
        for wheel, plan in plans.items():
            for name, signal in plan.signals.items():
                if signal.topic not in topics:
                    what = signal.topic or f"a topic for {name} (it is {signal.field!r})"
                    raise BagError(
                        f"{recording.name}: {wheel}: has no {what}; it has "
                        f"{', '.join(sorted(topics)) or 'no topics at all'}"
                    )
        return plans
    if recording.is_table:
        return plan_from_names(recording, asked)
    states = sorted({channel.topic for channel in channels if channel.type == STATE})
    if not states:
        raise BagError(
            f"{recording.name}: has no topic of type {STATE}; it has "
            f"{', '.join(sorted(topics)) or 'no topics at all'}. Map its signals, such as "
            "voltage=/pwm.data*12/255 (identify --topics suggests how)"
        )
    names = {topic: topic.rpartition("/")[0].rpartition("/")[2] or topic[1:] for topic in states}
    if len(set(names.values())) < len(names):  # two robots: keep their namespaces
        names = {topic: topic.rpartition("/")[0][1:] or topic[1:] for topic in states}
    plans = {}
    for topic, wheel in names.items():
        if not is_ros_name(wheel):
            raise BagError(
                f"{recording.name}: {topic!r} is not a ROS name, so its wheel has no name"
            )
        signals = {name: Signal(topic, path) for name, path in OWN_FIELDS.items()}
        given = asked.motors.get(wheel, asked.defaults)
        plans[wheel] = replace(
            given,
            signals={**signals, **given.signals},
            held=given.held or "before",
            shaft="wheel",
            own=not given.signals,
        )
    return plans


def _question_voltage(plan: MotorMap, channels: list[Channel]) -> list[Finding]:
    """Return findings on a mapped voltage whose name contradicts it."""
    voltage = plan.signals["voltage"]
    name = f"{voltage.topic}.{voltage.field}" if voltage.topic else voltage.field
    kind = next((c.type for c in channels if c.topic == voltage.topic), "")
    if plan.own or not is_speed_command(f"{kind} {name}"):
        return []
    scaled = bool(voltage.unit) or (voltage.scale, voltage.offset) != (1.0, 0.0)
    text = (
        f"voltage: {name} is a speed command by its name; if a loop controls the speed, the "
        "estimates describe the loop, not the motor. Map the PWM or the voltage"
    )
    return [note("speed_command", text, "warning" if scaled else "unreliable")]


def _find_description(
    wheel: str, plan: MotorMap, topics: list[str], tables: Mapping[str, Table]
) -> tuple[dict[str, float], list[Finding]]:
    """Return the last description of a wheel, and findings on it."""
    spaces = {topic.rpartition("/")[0] for topic in plan.topics}
    mine = [topic for topic in topics if topic.rpartition("/")[0] in spaces]
    for topic in mine:
        table = tables[topic]
        if table.log is not None and table.log.size:
            last = {name: float(column[-1]) for name, column in table.columns.items()}
            changed = [n for n, c in table.columns.items() if np.unique(c[c == c]).size > 1]
            text = (
                f"{topic}: {', '.join(changed)} changed while recording; the last values are used"
            )
            return last, [note("description_changed", text, "warning")] if changed else []
    if "gear_ratio" not in plan.hardware:
        own = any(signal.field == "encoder_count" for signal in plan.signals.values())
        text = (
            f"{wheel}: {'no motor_description' if own else 'no gear_ratio'}; a gear ratio of 1 "
            "is assumed, so the parameters refer to the measured shaft"
        )
        return {}, [note("gear_ratio_assumed", text)]
    return {}, []


def convert_description(message: Any) -> Hardware:
    """Return the hardware of a ``motor_description``."""
    return make_hardware({name: float(getattr(message, name)) for name in mappings.DESCRIBED})


def make_hardware(known: Mapping[str, float]) -> Hardware:
    """Return the known hardware; impossible values count as unknown."""
    sound: dict[str, Any] = {
        n: v for n, v in known.items() if math.isfinite(v) and (v > 0 or n in mappings.ACCURACIES)
    }
    return Hardware(**{**sound, "encoder_bits": int(sound.get("encoder_bits", 0))})
