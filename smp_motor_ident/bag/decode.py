"""From messages to columns of numbers by topic."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.bag.layout import Decoder
from smp_motor_ident.bag.source import Recording, recordings
from smp_motor_ident.bag.storage import Batch, Channel, Integers, Table, damaged
from smp_motor_ident.bag.types import Definitions, Types
from smp_motor_ident.bag.unpack import Budget, decompress_messages
from smp_motor_ident.errors import BagError

STAMP = ("header.stamp.sec", "header.stamp.nanosec")


class _Collector:
    """Grows one topic's columns batch by batch."""

    def __init__(self, topic: str, paths: list[str], types: Types, budget: Budget) -> None:
        self.topic, self.paths, self.types, self.budget = topic, paths, types, budget
        self._decoders: dict[tuple[str, str, str], Decoder] = {}
        self._count = 0
        # Of each part, whose messages have one layout: which messages, and what they hold
        self._rows: list[Integers] = []
        self._log: list[Integers] = []
        self._number: list[Integers | None] = []
        self._columns: dict[str, list[NDArray[Any] | None]] = {}
        self.packed = 0

    def add(self, batch: Batch) -> None:
        batch, lost = decompress_messages(batch, self.budget)
        self.packed += lost
        if not len(batch):
            return
        decoder = self._decoder(batch.channel)
        for rows, columns in decoder.decode(batch):
            self._rows.append(self._count + rows)
            self._log.append(batch.log_time[rows])
            self._number.append(None if batch.sequence is None else batch.sequence[rows])
            held = dict(zip(decoder.paths, columns))
            for name in {*self.paths, *STAMP}:
                self._columns.setdefault(name, []).append(held.get(name))
        self._count += len(batch)

    def _decoder(self, channel: Channel) -> Decoder:
        key = (channel.type, channel.definition_format, channel.definition)
        if key not in self._decoders:
            if channel.encoding not in ("cdr", "ros1"):
                raise BagError(
                    f"{self.topic}: its messages are encoded as {channel.encoding!r}; "
                    "only 'cdr' and 'ros1' can be read"
                )
            candidates = self.types.candidates(channel)
            paths = list(self.paths)
            first = next(candidates)
            if _has_stamp(first, channel.type):
                paths += [name for name in STAMP if name not in paths]
            self._decoders[key] = Decoder(channel, chain((first,), candidates), paths)
        return self._decoders[key]

    def table(self) -> Table:
        """Return what was collected, in the order of the messages, and forget it."""
        none = np.zeros(0, np.int64)
        rows = np.concatenate([none, *self._rows])
        order = slice(None) if np.all(np.diff(rows) > 0) else np.argsort(rows)
        sizes = [part.size for part in self._rows]
        log = np.concatenate([none, *self._log])[order]
        self._log.clear()
        numbers = [part for part in self._number if part is not None and part.all()]
        counted = 0 < len(numbers) == len(self._number)
        number = np.concatenate(numbers)[order] if counted else None
        columns: dict[str, NDArray[Any]] = {}
        present: dict[str, NDArray[np.bool_]] = {}
        for name in list(self._columns):
            parts = self._columns.pop(name)
            known = [part.dtype for part in parts if part is not None]
            if not known:
                continue
            if len(known) < len(parts):
                flags = [np.full(n, part is not None) for n, part in zip(sizes, parts)]
                present[name] = np.concatenate(flags)[order]
            kind = np.result_type(*known)
            filled = [np.zeros(n, kind) if p is None else p for n, p in zip(sizes, parts)]
            columns[name] = np.concatenate(filled)[order]
        table = Table(log, _stamps(columns), columns, present, number)
        for decoder in self._decoders.values():
            if decoder.undecodable:
                text = f"{decoder.undecodable} messages are no {decoder.name} ({decoder.reason})"
                table.findings.append(damaged(f"{self.topic}: {text} and were left out"))
        if self.packed:
            text = f"{self.topic}: {self.packed} messages could not be decompressed"
            table.findings.append(damaged(text))
        return table


def _has_stamp(definitions: Definitions, name: str) -> bool:
    fields = dict(definitions[name])
    header = fields.get("header")
    return header is not None and header[1] == "std_msgs/msg/Header"


def _stamps(columns: dict[str, NDArray[Any]]) -> Integers | None:
    """Take the header's stamps out of the columns."""
    seconds, rest = (columns.pop(name, None) for name in STAMP)
    if seconds is None or rest is None:
        return None
    stamp: Integers = seconds.astype(np.int64)
    stamp *= 1_000_000_000
    stamp += rest
    return stamp


def collect(
    recording: Recording, wanted: Mapping[str, list[str]], types: Types
) -> dict[str, Table]:
    """Read the wanted fields by topic in one pass; topics without messages give empty tables."""
    if recording.is_table:
        return {topic: recording.table(topic, fields) for topic, fields in wanted.items()}
    collectors = {
        topic: _Collector(topic, paths, types, recording.budget) for topic, paths in wanted.items()
    }
    batches = recording.batches(lambda channel: channel.topic in collectors)
    for batch in chain.from_iterable(batches):
        try:
            collectors[batch.channel.topic].add(batch)
        except BagError as error:
            raise BagError(f"{recording.name}: {error}") from None
    return {topic: collector.table() for topic, collector in collectors.items()}


@dataclass(frozen=True, eq=False)
class Columns:
    """Fields of one topic, where no record of a motor is wanted."""

    # shape (n,), [s]: header stamps where the messages have them, else when they were recorded;
    # since 1970
    time: NDArray[np.float64]
    fields: Mapping[str, NDArray[Any]]  # shape (n,): by field path


def read_columns(path: Path, wanted: Mapping[str, Sequence[str]]) -> dict[str, Columns]:
    """Read fields of topics of one bag; a topic without a message is an error."""
    asked = {topic: list(fields) for topic, fields in wanted.items()}
    found = {}
    for recording in recordings([path]):
        for topic, table in collect(recording, asked, Types()).items():
            clock = table.logged if table.stamp is None else table.stamp
            if clock.size == 0:
                raise BagError(f"{recording.name}: has no message on {topic}")
            found[topic] = Columns(1e-9 * clock.astype(np.float64), table.columns)
    return found
