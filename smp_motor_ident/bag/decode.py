# SPDX-License-Identifier: Apache-2.0
"""Decode messages into columns of numbers: one template reads all messages of a layout at once.

The position of a number depends only on the lengths of the strings and sequences before it:
messages of a topic that agree in these have their numbers at the same places, and one indexing per
field reads them all.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, tee
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_control.arrays import Integers
from smp_motor_ident.bag.source import Recording, find_recordings
from smp_motor_ident.bag.storage import Batch, Channel, Table, gather, note_damage
from smp_motor_ident.bag.template import (
    DecodeError,
    Number,
    Text,
    locate,
    parse_message,
    parse_path,
)
from smp_motor_ident.bag.types import Definitions, Types
from smp_motor_ident.bag.unpack import Budget, decompress_messages
from smp_motor_ident.errors import BagError

_Columns = dict[str, NDArray[Any] | None]
Part = tuple[NDArray[np.int64], list[NDArray[Any] | None]]
"""Messages of a batch with the same layout, and their columns; None for a missing column."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Positions of the wanted numbers in all messages of one layout."""

    length: int
    checks: tuple[tuple[int, int], ...]
    numbers: tuple[Number | None, ...]

    def matches(self, batch: Batch) -> NDArray[np.bool_]:
        """Return which messages have this layout."""
        same: NDArray[np.bool_] = np.equal(batch.length, self.length)
        for offset, word in self.checks:
            if not same.any():
                return same
            at = np.where(same, batch.offset, batch.offset[int(np.argmax(same))])
            same &= gather(batch.data, at + offset, "<u4") == word
        return same


class Decoder:
    """Decoder of the wanted fields of a channel, by the first definition that fits a message."""

    MAX_LAYOUTS, MAX_LAYOUTS_VARIABLE = 64, 2
    """Largest number of stored layouts, and of a topic whose layout changes all the time."""
    MAX_FAILURES = 200
    """Undecodable messages in a row after which decoding stops."""
    BLOCK_MESSAGES = 1024
    """Messages compared with the layouts at once."""

    def __init__(
        self, channel: Channel, candidates: Iterable[Definitions], paths: Sequence[str]
    ) -> None:
        self.name = channel.type
        self._encoding = channel.encoding
        self.paths = tuple(paths)
        self._steps = [parse_path(path) for path in paths]
        self._candidates = iter(candidates)
        self._layouts: list[Layout] = []
        self._learned = self._failed = 0
        self.undecodable = 0
        self.reason = ""

    def decode(self, batch: Batch) -> list[Part]:
        """Decode a batch; skip and count the messages that cannot be decoded."""
        every = np.arange(len(batch))
        begins = range(0, every.size, self.BLOCK_MESSAGES)
        return [p for k in begins for p in self._decode(batch, every[k : k + self.BLOCK_MESSAGES])]

    def _decode(self, batch: Batch, left: NDArray[np.int64]) -> list[Part]:
        """Decode some messages of a batch."""
        parts: list[Part] = []
        while left.size:
            rest = batch.take(left)
            for layout in self._layouts:
                if (same := layout.matches(rest)).any():
                    parts.append((left[same], _read(rest, same, layout)))
                    left, self._failed = left[~same], 0
                    rest = batch.take(left)
                if not left.size:
                    break
            may_learn = self._failed < self.MAX_FAILURES
            if left.size and not (may_learn and self._learn(rest.message(0))):
                self._failed += 1
                others = left.size if self._failed > self.MAX_FAILURES else 1
                self.undecodable += others
                left = left[others:]
        return parts

    def _learn(self, data: bytes) -> bool:
        """Add a message's layout; return False if it cannot be decoded."""
        # Look for a new layout only after the others have failed.
        self._candidates, candidates = tee(self._candidates)
        for definitions in candidates:
            try:
                template = parse_message(data, self.name, definitions, self._encoding)
                break
            except DecodeError as error:
                self.reason = self.reason or str(error)
        else:
            return False
        self._candidates = iter([definitions])
        numbers: list[Number | None] = []
        texts: list[Text] = []
        for path, steps in zip(self.paths, self._steps):
            try:
                number, used = locate(template, steps)
            except BagError as error:
                raise BagError(f"{self.name}: field {path!r} {error}") from None
            numbers.append(number)
            texts += used
        # Everything up to the last wanted number must have the template's lengths; beyond
        # it, the message's whole length is enough.
        last = max((n.offset for n in numbers if n is not None), default=len(data))
        positions = {at for at in template.lengths if at < last}
        for text in texts:
            positions.update(range(text.begin, max(text.end - 3, text.begin + 1), 4))
            if text.end - text.begin > 4:
                positions.add(text.end - 4)
        words = tuple((at, int.from_bytes(data[at : at + 4], "little")) for at in sorted(positions))
        self._layouts.insert(0, Layout(len(data), words, tuple(numbers)))
        self._learned, self._failed = self._learned + 1, 0
        is_variable = self._learned >= 16 * self.MAX_LAYOUTS
        del self._layouts[self.MAX_LAYOUTS_VARIABLE if is_variable else self.MAX_LAYOUTS :]
        return True


def _read(batch: Batch, which: NDArray[np.bool_], layout: Layout) -> list[NDArray[Any] | None]:
    """Return the columns of the messages that have the layout."""
    offset = batch.offset if which.all() else batch.offset[which]
    return [
        None if number is None else gather(batch.data, offset + number.offset, number.kind)
        for number in layout.numbers
    ]


STAMP = ("header.stamp.sec", "header.stamp.nanosec")


class _Collector:
    """Collector of one topic's columns."""

    def __init__(self, topic: str, paths: list[str], types: Types, budget: Budget) -> None:
        self.topic, self.paths, self.types, self.budget = topic, paths, types, budget
        self._decoders: dict[tuple[str, str, str], Decoder] = {}
        self._count = 0
        # Indices, log times, numbers and columns of messages that share a layout
        self._parts: list[tuple[Integers, Integers, Integers | None, _Columns]] = []
        self.packed = 0

    def add(self, batch: Batch) -> None:
        batch, lost = decompress_messages(batch, self.budget)
        self.packed += lost
        if not len(batch):
            return
        decoder = self._decoder(batch.channel)
        for rows, columns in decoder.decode(batch):
            number = None if batch.sequence is None else batch.sequence[rows]
            held = dict(zip(decoder.paths, columns))
            self._parts.append((self._count + rows, batch.log_time[rows], number, held))
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
            header = dict(first[channel.type]).get("header")
            if header is not None and header[1] == "std_msgs/msg/Header":
                paths += [name for name in STAMP if name not in paths]
            self._decoders[key] = Decoder(channel, chain((first,), candidates), paths)
        return self._decoders[key]

    def table(self) -> Table:
        """Return the collected columns in the order of the messages, and clear them."""
        none = np.zeros(0, np.int64)
        rows = np.concatenate([none, *(rows for rows, *_ in self._parts)])
        order = slice(None) if np.all(np.diff(rows) > 0) else np.argsort(rows)
        log = np.concatenate([none, *(log for _, log, *_ in self._parts)])[order]
        sizes = [rows.size for rows, *_ in self._parts]
        numbers = [part for *_, part, _ in self._parts if part is not None and part.all()]
        counted = 0 < len(numbers) == len(sizes)
        number = np.concatenate(numbers)[order] if counted else None
        columns: dict[str, NDArray[Any]] = {}
        present: dict[str, NDArray[np.bool_]] = {}
        for name in dict.fromkeys((*self.paths, *STAMP)):
            parts = [held.pop(name, None) for *_, held in self._parts]
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
                text = f"{decoder.undecodable} messages are not of type {decoder.name}"
                text += f" ({decoder.reason})"
                table.findings.append(note_damage(f"{self.topic}: {text} and were left out"))
        if self.packed:
            text = f"{self.topic}: {self.packed} messages could not be decompressed"
            table.findings.append(note_damage(text))
        return table


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


def read_columns(path: Path, wanted: Mapping[str, Sequence[str]]) -> dict[str, Table]:
    """Read fields of topics of one bag; a topic without a message is an error."""
    asked = {topic: list(fields) for topic, fields in wanted.items()}
    found: dict[str, Table] = {}
    for recording in find_recordings([path]):
        found |= collect(recording, asked, Types())
        for topic in asked:
            if not found[topic].logged.size:
                raise BagError(f"{recording.name}: has no message on {topic}")
    return found
