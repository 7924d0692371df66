"""Columns of numbers by topic: what is left of a recording once it is decoded."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.bag.layout import Decoder
from smp_motor_ident.bag.source import Recording
from smp_motor_ident.bag.storage import Batch, Channel, decompress_messages
from smp_motor_ident.bag.types import Definitions, Types
from smp_motor_ident.errors import BagError

Integers = NDArray[np.int64]
Progress = Callable[[float, str], None]
STAMP = ("header.stamp.sec", "header.stamp.nanosec")


@dataclass(eq=False)
class Table:
    """Samples of one topic (or CSV file) in the order of the file.

    Attributes
    ----------
    log : ndarray of int64, shape (n,), [ns]
        When the recorder got them.
    stamp : ndarray of int64, shape (n,), [ns], or None
        What their header says.
    columns : dict of str to ndarray, shape (n,)
        By field path, in the type of the message.
    present : dict of str to ndarray of bool
        For columns that some messages lacked.
    number : ndarray of int64, shape (n,), or None
        The publisher's own count, where the recorder kept it for every message.
    notes : list of str
        What was found amiss.
    """

    log: Integers
    stamp: Integers | None
    columns: dict[str, NDArray[Any]]
    present: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    number: Integers | None = None
    notes: list[str] = field(default_factory=list)


class _Collector:
    """Grows one topic's columns batch by batch."""

    def __init__(self, topic: str, paths: list[str], types: Types) -> None:
        self.topic, self.paths, self.types = topic, paths, types
        self._decoders: dict[tuple[str, str, str], Decoder] = {}
        self._log: list[Integers] = []
        self._number: list[Integers | None] = []
        self._columns: dict[str, list[NDArray[Any] | None]] = {}
        self._present: dict[str, list[NDArray[np.bool_] | None]] = {}
        self.packed = 0

    def add(self, batch: Batch) -> None:
        batch, lost = decompress_messages(batch)
        self.packed += lost
        if not len(batch):
            return
        decoder = self._decoder(batch.channel)
        decoded = decoder.decode(batch)
        if not decoded.rows.size:
            return
        self._log.append(batch.log_time[decoded.rows])
        numbers = batch.sequence
        self._number.append(None if numbers is None else numbers[decoded.rows])
        names = decoder.paths
        for name in {*self.paths, *STAMP}:
            k = names.index(name) if name in names else -1
            column = decoded.columns[k] if k >= 0 else None
            self._columns.setdefault(name, []).append(column)
            there = decoded.present[k] if k >= 0 else None
            self._present.setdefault(name, []).append(there)

    def _decoder(self, channel: Channel) -> Decoder:
        key = (channel.type, channel.definition_format, channel.definition)
        if key not in self._decoders:
            if channel.encoding != "cdr":
                raise BagError(
                    f"{self.topic}: its messages are encoded as {channel.encoding!r}; "
                    "only 'cdr' can be read"
                )
            candidates = self.types.candidates(channel)
            paths = list(self.paths)
            if _has_stamp(candidates[0], channel.type):
                paths += [name for name in STAMP if name not in paths]
            self._decoders[key] = Decoder(channel.type, candidates, paths)
        return self._decoders[key]

    def table(self) -> Table:
        """Return what was collected, and forget it."""
        sizes = [part.size for part in self._log]
        log = np.concatenate(self._log) if self._log else np.zeros(0, np.int64)
        self._log.clear()
        numbers = [part for part in self._number if part is not None and part.all()]
        number = np.concatenate(numbers) if 0 < len(numbers) == len(self._number) else None
        columns: dict[str, NDArray[Any]] = {}
        present: dict[str, NDArray[np.bool_]] = {}
        for name in list(self._columns):
            parts, flags = self._columns.pop(name), self._present.pop(name)
            if all(part is None for part in parts):
                continue
            if any(p is None or f is not None for p, f in zip(parts, flags)):
                present[name] = np.concatenate(
                    [
                        np.full(n, p is not None) if f is None else f
                        for n, p, f in zip(sizes, parts, flags)
                    ]
                )
            columns[name] = np.concatenate(
                [np.zeros(n) if p is None else p for n, p in zip(sizes, parts)]
            )
        table = Table(log, _stamps(columns), columns, present, number)
        for decoder in self._decoders.values():
            if decoder.undecodable:
                table.notes.append(
                    f"{self.topic}: {decoder.undecodable} messages are no {decoder.name} "
                    f"({decoder.reason}) and were left out"
                )
        if self.packed:
            table.notes.append(f"{self.topic}: {self.packed} messages could not be decompressed")
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
    recording: Recording,
    wanted: Mapping[str, list[str]],
    types: Types,
    progress: Progress | None = None,
) -> dict[str, Table]:
    """Read the wanted fields of a bag in one pass over its files.

    Parameters
    ----------
    recording : Recording
        Its notes grow by whatever is lost.
    wanted : mapping of str to list of str
        Field paths by topic.
    types : Types
        For messages that the bag does not define.
    progress : callable, optional
        Called with the fraction that is read and the recording's name.

    Returns
    -------
    dict of str to Table
        By topic; empty tables for topics without messages.

    Raises
    ------
    BagError
        When a wanted field or type does not exist.
    """
    collectors = {topic: _Collector(topic, paths, types) for topic, paths in wanted.items()}
    for fraction, batch in recording.batches(lambda channel: channel.topic in collectors):
        try:
            collectors[batch.channel.topic].add(batch)
        except BagError as error:
            raise BagError(f"{recording.name}: {error}") from None
        if progress is not None:
            progress(fraction, recording.name)
    return {topic: collector.table() for topic, collector in collectors.items()}
