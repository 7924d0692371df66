"""From paths and a mapping to records: the whole way."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from smp_motor_ident.bag import mapping as mappings
from smp_motor_ident.bag.assemble import assemble
from smp_motor_ident.bag.csv_file import read_table
from smp_motor_ident.bag.join import join_records
from smp_motor_ident.bag.mapping import MotorMap, Signal, SignalMap
from smp_motor_ident.bag.source import Recording, recordings
from smp_motor_ident.bag.storage import Channel
from smp_motor_ident.bag.table import Progress, Table, collect
from smp_motor_ident.bag.types import Types
from smp_motor_ident.bag.units import FACTORS
from smp_motor_ident.errors import BagError
from smp_motor_ident.record import Hardware, Record

STATE, DESCRIPTION = "smp_interfaces/msg/MotorState", "smp_interfaces/msg/MotorDescription"
_OWN_FIELDS = {
    "voltage": "voltage",
    "current": "current",
    "velocity": "velocity",
    "position": "position",
    "count": "encoder_count",
}


def read_experiments(
    paths: Any, mapping: Any = None, *, progress: Progress | None = None
) -> dict[str, list[Record]]:
    """Read recordings, each as records of its own.

    Parameters
    ----------
    paths : path or sequence of paths
        Bags (folders, bare ``.mcap`` or ``.db3`` files), folders of bags, or CSV files.
    mapping : SignalMap, dict, path of a YAML file, list of command-line items, or None
        Which topics, fields or columns are which signals; not needed for recordings of
        our own messages.
    progress : callable, optional
        ``progress(fraction, name)``, called while files are read.

    Returns
    -------
    dict of str to list of Record
        By wheel, in the order of the recordings that have it.

    Raises
    ------
    BagError
        When a path cannot be read, or holds no motor; the message says which.  Of a folder
        with several recordings those that cannot be read become notes of the others.
    """
    asked = mappings.of(mapping)
    types = Types(asked.msg_files)
    found: dict[str, list[Record]] = {}
    failures: list[BagError] = []
    every = recordings(paths)
    total, before = max(sum(r.size() for r in every), 1), 0
    for recording in every:
        part = recording.size() / total
        report = None if progress is None else _scaled(progress, before / total, part)
        try:
            for record in _read(recording, asked, types, report):
                found.setdefault(record.wheel, []).append(record)
        except BagError as error:
            if not recording.one_of_many:
                raise
            failures.append(error)
        before += recording.size()
    if failures and not found:
        raise failures[0]
    if failures:
        notes = tuple(f"not read: {error}" for error in failures)
        found = {
            wheel: [replace(record, notes=(*record.notes, *notes)) for record in records]
            for wheel, records in found.items()
        }
    if progress is not None:
        progress(1.0, every[-1].name)
    return found


def read_records(
    paths: Any, mapping: Any = None, *, progress: Progress | None = None
) -> dict[str, Record]:
    """Read recordings as one record per wheel; each recording begins a segment of its own.

    Parameters
    ----------
    paths : path or sequence of paths
        As for `read_experiments`.
    mapping : SignalMap, dict, path of a YAML file, list of command-line items, or None
        As for `read_experiments`.
    progress : callable, optional
        As for `read_experiments`.

    Returns
    -------
    dict of str to Record
        By wheel.

    Raises
    ------
    BagError
        As `read_experiments`, and when recordings of one wheel contradict each other.
    """
    experiments = read_experiments(paths, mapping, progress=progress)
    return {wheel: join_records(records) for wheel, records in experiments.items()}


def _read(
    recording: Recording, asked: SignalMap, types: Types, progress: Progress | None
) -> list[Record]:
    """Return a recording's records; an error tells also what was found amiss before."""
    reader = _read_csv if recording.is_table else _read_bag
    try:
        return reader(recording, asked, types, progress)
    except BagError as error:
        amiss = [note for note in recording.notes if note not in str(error)]
        raise BagError("; ".join([str(error), *amiss])) from None


def _scaled(progress: Progress, begin: float, part: float) -> Progress:
    return lambda fraction, name: progress(begin + fraction * part, name)


def _read_csv(
    recording: Recording, asked: SignalMap, types: Types, progress: Progress | None
) -> list[Record]:
    """Return the records of a CSV file."""
    path = recording.files[0]
    if not asked.has_signals:
        raise BagError(
            f"{path}: a CSV file needs a mapping, such as voltage=u velocity=y:deg/s time=t"
        )
    if progress is not None:
        progress(0.0, recording.name)
    records = []
    for wheel, plan in asked.motors.items():
        signals = {name: _as_column(signal) for name, signal in plan.signals.items()}
        plan = replace(plan, signals=signals)
        time: tuple[str, float] | float = plan.sample_time
        if "time" in signals:
            time = (
                signals["time"].field,
                FACTORS["time"][signals["time"].unit] * signals["time"].scale,
            )
        elif not time:
            raise BagError(
                f"{path}: which column is the time? map time=COLUMN or sample_time=SECONDS"
            )
        names = [signal.field for name, signal in signals.items() if name != "time"]
        table = read_table(path, names, time)
        hardware = _hardware(plan.hardware)
        records.append(assemble(wheel, plan, hardware, {"": table}, recording.name))
    return records


def _as_column(signal: Signal) -> Signal:
    """Return a signal of a CSV file whose column looks like a topic and a field."""
    if not signal.topic:
        return signal
    return replace(signal, topic="", field=f"{signal.topic}.{signal.field}")


def _read_bag(
    recording: Recording, asked: SignalMap, types: Types, progress: Progress | None
) -> list[Record]:
    """Return the records of a bag."""
    channels = recording.channels()
    plans = _plans(recording, asked, channels)
    wanted: dict[str, list[str]] = {}
    for plan in plans.values():
        for signal in plan.signals.values():
            fields = wanted.setdefault(signal.topic, [])
            if signal.field not in fields:
                fields.append(signal.field)
    descriptions = [c.topic for c in channels if c.type == DESCRIPTION]
    wanted.update({topic: list(mappings.HARDWARE) for topic in descriptions})
    tables = collect(recording, wanted, types, progress)
    records: list[Record] = []
    failures: list[BagError] = []
    for wheel in list(plans):
        plan = plans.pop(wheel)
        notes: list[str] = []
        description = _description(wheel, plan, descriptions, tables, notes)
        plan = replace(plan, hardware={**description, **plan.hardware})
        try:
            record = assemble(wheel, plan, _hardware(plan.hardware), tables, recording.name)
            records.append(replace(record, notes=(*notes, *record.notes)))
        except BagError as error:
            if not plan.own:
                raise
            failures.append(error)
        used = {s.topic for other in plans.values() for s in other.signals.values()}
        for topic in {s.topic for s in plan.signals.values()} - used:
            del tables[topic]  # its memory is needed for the next
    if failures and not records:
        raise failures[0]
    shared = (*recording.notes, *(f"not read: {error}" for error in failures))
    return [replace(record, notes=(*shared, *record.notes)) for record in records]


def _plans(recording: Recording, asked: SignalMap, channels: list[Channel]) -> dict[str, MotorMap]:
    """Return the signals of every wheel, mapped by the user or told by our own messages."""
    topics = {channel.topic for channel in channels}
    if asked.has_signals:
        plans = {wheel: plan for wheel, plan in asked.motors.items() if plan.signals}
        for wheel, plan in plans.items():
            for name, signal in plan.signals.items():
                if signal.topic not in topics:
                    what = signal.topic or f"a topic for {name} (it is {signal.field!r})"
                    raise BagError(
                        f"{recording.name}: {wheel}: has no {what}; it has "
                        f"{', '.join(sorted(topics)) or 'no topics at all'}"
                    )
        return plans
    states = sorted(channel.topic for channel in channels if channel.type == STATE)
    if not states:
        raise BagError(
            f"{recording.name}: has no topic of type {STATE}; it has "
            f"{', '.join(sorted(topics)) or 'no topics at all'}. Map its signals, such as "
            "voltage=/pwm.data*12/255 (identify --topics suggests how)"
        )
    states = list(dict.fromkeys(states))
    names = {topic: topic.rpartition("/")[0].rpartition("/")[2] or topic[1:] for topic in states}
    if len(set(names.values())) < len(names):  # two robots: keep their namespaces
        names = {topic: topic.rpartition("/")[0][1:] or topic[1:] for topic in states}
    plans = {}
    for topic, wheel in names.items():
        signals = {
            name: Signal(topic, path, unit=_UNITS[name]) for name, path in _OWN_FIELDS.items()
        }
        given = asked.motors.get(wheel, asked.defaults)
        plans[wheel] = replace(
            given,
            signals={**signals, **given.signals},
            held=given.held or "before",
            shaft="wheel",
            own=not given.signals,
        )
    return plans


_UNITS = {name: next(iter(FACTORS[name])) for name in _OWN_FIELDS}


def _description(
    wheel: str,
    plan: MotorMap,
    topics: list[str],
    tables: Mapping[str, Table],
    notes: list[str],
) -> dict[str, float]:
    """Return the last description of a wheel."""
    spaces = {signal.topic.rpartition("/")[0] for signal in plan.signals.values()}
    mine = [topic for topic in topics if topic.rpartition("/")[0] in spaces]
    for topic in mine:
        table = tables[topic]
        if table.log.size:
            last = {name: float(column[-1]) for name, column in table.columns.items()}
            changed = [n for n, c in table.columns.items() if np.unique(c[c == c]).size > 1]
            if changed:
                notes.append(f"{topic}: {', '.join(changed)} changed meanwhile; the last is used")
            return last
    if "gear_ratio" not in plan.hardware:
        own = any(signal.field == "encoder_count" for signal in plan.signals.values())
        notes.append(
            f"{wheel}: {'no motor_description' if own else 'no gear_ratio'}; a gear ratio of 1 "
            "is assumed, so that its parameters are those of the shaft that was measured"
        )
    return {}


def _hardware(known: Mapping[str, float]) -> Hardware:
    """Return what is known of the hardware."""

    def positive(name: str) -> float | None:
        value = known.get(name)
        return value if value is not None and math.isfinite(value) and value > 0 else None

    return Hardware(
        gear_ratio=positive("gear_ratio") or 1.0,
        counts_per_revolution=positive("counts_per_revolution"),
        encoder_bits=int(known.get("encoder_bits") or 0),
        supply_voltage=positive("supply_voltage"),
        resistance=positive("resistance"),
    )
