# SPDX-License-Identifier: Apache-2.0
"""Read MCAP files, whole or cut off at any byte, and report every loss.

The layout of the records is that of https://mcap.dev/spec.  The walk hands out positions for bulk
decoding instead of one Python object per message.
"""

import io
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_mcap import read_bytes, read_exact, read_string

from smp_motor_control.arrays import Integers
from smp_motor_ident.bag.readers.format import Format, Messages
from smp_motor_ident.bag.storage import Batch, Bytes, Channel, gather, message_type
from smp_motor_ident.bag.unpack import Budget, decompress
from smp_motor_ident.errors import BagError

SEQUENCE_KEY = "publication_sequence"
"""Key of a channel's metadata: ``true`` where sequence numbers are the publisher's."""
MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX = 2, 3, 4, 5, 6, 8
STATISTICS, DATA_END = 11, 15
_LAYOUTS = {
    SCHEMA: "2ssb",  # number, name, encoding, definition
    CHANNEL: "22ssm",  # number, schema, topic, encoding, metadata
    CHUNK: "8884s8",  # first and last time, size and CRC (0: none) unpacked, compression, size
    CHUNK_INDEX: "8888i8",  # times, start, length, channels, length of the message indices
    STATISTICS: "82444488i",  # messages, schemas, channels, …, messages by channel
}
"""Fields of records: numbers by their bytes, ``s`` a text, ``b`` bytes, ``m`` texts by texts, ``i``
numbers by channel."""
_HEAD = struct.Struct("<BQ")  # every record's opcode and length in bytes
_FOOTER_SIZE = 29  # with its head
_DAMAGE = (struct.error, ValueError, ReaderError)
_BLOCK = 1 << 22


def _read_fields(op: int, body: bytes) -> list[Any]:
    """Return a record's fields, and the bytes behind them; one of `_DAMAGE` if it ends early."""
    file = io.BytesIO(body)
    return [*(_READERS[kind](file) for kind in _LAYOUTS[op]), file.read()]


def _read_number(size: int) -> Callable[[BinaryIO], int]:
    return lambda file: int.from_bytes(read_exact(file, size), "little")


def _read_texts(file: BinaryIO) -> dict[str, str]:
    held = read_bytes(file)
    pairs, texts = io.BytesIO(held), dict[str, str]()
    while pairs.tell() < len(held):
        name = read_string(pairs)
        texts[name] = read_string(pairs)
    return texts


def _read_index(file: BinaryIO) -> dict[int, int]:
    return dict(struct.iter_unpack("<HQ", read_bytes(file)))


_READERS: dict[str, Callable[[BinaryIO], Any]] = {
    **{"2": _read_number(2), "4": _read_number(4), "8": _read_number(8)},
    **{"s": read_string, "b": read_bytes, "m": _read_texts, "i": _read_index},
}


def read_summary(file: BinaryIO) -> dict[int, list[list[Any]]] | None:
    """Return the fields of the summary's records by opcode.

    None unless it counts the messages and repeats the channels.
    """
    end = file.seek(0, io.SEEK_END) - _FOOTER_SIZE - len(MAGIC)
    if end < len(MAGIC):
        return None
    file.seek(end)
    tail = file.read()
    at = int.from_bytes(tail[9:17], "little")
    if tail[0] != FOOTER or not at or not tail.endswith(MAGIC):
        return None
    found: dict[int, list[list[Any]]]
    found = {op: [] for op in (SCHEMA, CHANNEL, CHUNK_INDEX, STATISTICS)}
    while at < end:
        file.seek(at)
        op, length = _HEAD.unpack(file.read(_HEAD.size))
        at += _HEAD.size + length
        if at > end:
            return None
        if op in found:
            try:
                found[op].append(_read_fields(op, file.read(length)))
            except _DAMAGE:
                return None
    statistics, channels = found[STATISTICS], {key for key, *_ in found[CHANNEL]}
    return found if statistics and statistics[-1][2] == len(channels) else None


class _McapFile(Messages):
    """One ``.mcap`` file."""

    def __init__(self, path: Path, name: str, budget: Budget) -> None:
        super().__init__(path, name, budget)
        self._schemas: dict[int, list[Any]] = {}
        # Messages by channel, from the summary; None without one
        self._counts: dict[int, int] | None = None
        # Channels and number of messages of chunks by their start
        self._chunks: dict[int, tuple[list[int], int]] = {}
        with path.open("rb") as file:
            if file.read(8) != MAGIC:
                raise BagError(f"{self.name}: does not begin like an MCAP file")
            summary = read_summary(file)
        if summary is not None:
            self._scanned = True
            self._counts = summary[STATISTICS][-1][-2]
            for op in (SCHEMA, CHANNEL):
                for fields in summary[op]:
                    self._define(op, fields)
            for _, _, start, _, offsets, length, _ in summary[CHUNK_INDEX]:
                # Behind a chunk, each channel's index record is 15 bytes and 16 per message.
                self._chunks[start] = list(offsets), (length - 15 * len(offsets)) // 16

    def declared(self) -> dict[str, int] | None:
        """Return the messages per topic according to the summary."""
        if self._counts is None:
            return None
        counts: Counter[str] = Counter()
        for key, channel in self._channels.items():
            counts[channel.topic] += self._counts.get(key, 0)
        return dict(counts)

    def batches(self, wanted: Callable[[Channel], bool]) -> Iterator[list[Batch]]:
        """Walk over the file."""
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            file.seek(8)
            while True:
                start = file.tell()
                head = file.read(9)
                if len(head) < 9:
                    if self._counts is None:
                        self._cut(start, "")
                    break
                op, length = _HEAD.unpack(head)
                if op == DATA_END:
                    break
                whole = start + 9 + length <= size
                if op == CHUNK and not (whole and self._skippable(start, wanted)):
                    body = file.read(min(length, size - start - 9))
                    yield self._chunk(body, start, whole, wanted)
                elif op == 0 or not whole:
                    if not self._resume(file, start):
                        break
                elif op == MESSAGE:
                    yield self._top_level(file, start, length, wanted)
                elif op in (SCHEMA, CHANNEL):
                    self._read_definition(op, file.read(length))
                else:
                    file.seek(length, io.SEEK_CUR)
        self._scanned = True

    def _top_level(
        self, file: BinaryIO, start: int, length: int, wanted: Callable[[Channel], bool]
    ) -> list[Batch]:
        """Return the messages outside of chunks in a block of the file."""
        file.seek(start)
        data = file.read(max(_BLOCK, length + 9))
        positions, end = self._walk(data)
        file.seek(start + end)
        return self._split(data, positions, wanted)

    def _chunk(
        self, body: bytes, start: int, whole: bool, wanted: Callable[[Channel], bool]
    ) -> list[Batch]:
        """Return the messages of a chunk, or the readable ones of a chunk that is cut off."""
        try:
            _, _, size, crc, compression, stored, rest = _read_fields(CHUNK, body)
        except _DAMAGE:
            self._cut(start, "inside a chunk's head")
            return []
        data = decompress(rest[:stored], compression, self._budget)
        sound = len(data) == size and (not crc or zlib.crc32(data) == crc)
        if whole and not sound:
            channels, messages = self._chunks.get(start, ([], 0))
            many = f" with {messages} messages" if channels else ""
            self._damage(f"the chunk at byte {start} is damaged and was left out{many}")
            return []
        positions, end = self._walk(data)
        if not whole:
            self._cut(start, f"inside a chunk; {len(positions)} of its messages could be read")
        elif end != len(data):
            self._damage(
                f"the chunk at byte {start} ends inside a record; "
                f"{len(data) - end} of its bytes were left out"
            )
        return self._split(data, positions, wanted)

    def _walk(self, data: bytes) -> tuple[list[int], int]:
        """Read definitions; return where messages begin and where the last whole record ends."""
        unpack, end, pos = _HEAD.unpack_from, len(data), 0
        messages: list[int] = []
        while end - pos >= 9:
            op, length = unpack(data, pos)
            following = pos + 9 + length
            if following > end:
                break
            if op == MESSAGE:
                messages.append(pos)
            elif op in (SCHEMA, CHANNEL):
                self._read_definition(op, data[pos + 9 : following])
            elif op in (0, CHUNK, DATA_END):
                break
            pos = following
        return messages, pos

    def _split(
        self, data: bytes, positions: list[int], wanted: Callable[[Channel], bool]
    ) -> list[Batch]:
        """Return the messages at the given positions, channel by channel."""
        batches: list[Batch] = []
        if not positions:
            return batches
        raw: Bytes = np.frombuffer(data, np.uint8)
        at = np.array(positions, np.int64)
        length: Integers = gather(raw, at + 1, "<i8") - 22
        if (length < 0).any():
            self._damage(f"{int((length < 0).sum())} messages too short")
            at, length = at[length >= 0], length[length >= 0]
        ids = gather(raw, at + 9, "<u2")
        for key in np.unique(ids).tolist():
            channel = self._channels.get(key)
            which = ids == key
            if channel is None:
                self._damage(
                    f"{int(which.sum())} messages of channel {key}, "
                    "which the file does not describe, were left out"
                )
            elif wanted(channel):
                mine = at[which]
                log_time = gather(raw, mine + 15, "<i8")
                sequence = None
                if channel.numbered:
                    sequence = gather(raw, mine + 11, "<u4").astype(np.int64)
                batches.append(Batch(channel, raw, mine + 31, length[which], log_time, sequence))
        return batches

    def _read_definition(self, op: int, body: bytes) -> None:
        """Store a schema or a channel; a damaged one is reported by its messages."""
        try:
            self._define(op, _read_fields(op, body))
        except _DAMAGE:
            return

    def _define(self, op: int, fields: list[Any]) -> None:
        if op == SCHEMA:
            self._schemas[fields[0]] = fields
            return
        key, schema, topic, encoding, metadata, _ = fields
        _, kind, form, text, _ = self._schemas.get(schema, (0, "", "", b"", b""))
        self._channels[key] = Channel(
            id=key,
            topic=topic,
            type=message_type(kind),
            encoding=encoding,
            definition=text.decode("utf-8", "replace"),
            definition_format=form,
            qos=metadata.get("offered_qos_profiles", ""),
            numbered=metadata.get(SEQUENCE_KEY) == "true",
        )

    def _skippable(self, start: int, wanted: Callable[[Channel], bool]) -> bool:
        """Return whether a chunk has no wanted message according to the index."""
        inside = [self._channels.get(key) for key in self._chunks.get(start, ([], 0))[0]]
        return bool(inside) and all(c is not None and not wanted(c) for c in inside)

    def _resume(self, file: BinaryIO, start: int) -> bool:
        """Continue at the next indexed chunk after a damaged place."""
        beyond = [offset for offset in self._chunks if offset > start]
        self._cut(start, "" if not beyond else f"; reading went on at byte {min(beyond)}")
        if beyond:
            file.seek(min(beyond))
        return bool(beyond)

    def _cut(self, start: int, where: str) -> None:
        size = self.path.stat().st_size
        what = "damaged" if self._counts is not None else "cut off or damaged"
        self._damage(f"{what} at byte {start} of {size} {where}".rstrip())


FORMAT = Format("MCAP", (".mcap",), MAGIC, _McapFile, tables=False)
