"""MCAP files, whole or cut off at any byte: a walk over records that loses nothing silently.

The record structure is that of https://mcap.dev/spec.  The library ``mcap`` reads the summary;
the walk over messages is done here, because it hands out positions for bulk decoding
instead of one Python object per message.
"""

import io
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import mcap.records
import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.summary import Summary

from smp_motor_control.arrays import Integers
from smp_motor_ident.bag.readers.format import Format, Messages
from smp_motor_ident.bag.storage import Batch, Bytes, Channel, gather, message_type
from smp_motor_ident.bag.unpack import Budget, decompress
from smp_motor_ident.errors import BagError

MAGIC = b"\x89MCAP0\r\n"
NUMBERED = "publication_sequence"
"""Key of a channel's metadata: ``true`` where sequence numbers are the publisher's."""
_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK_RECORD, _DATA_END = 3, 4, 5, 6, 15
_BLOCK = 1 << 22
_DAMAGE = (McapError, struct.error, ValueError, OverflowError, MemoryError, KeyError)


class _McapFile(Messages):
    """One ``.mcap`` file."""

    def __init__(self, path: Path, name: str, budget: Budget) -> None:
        super().__init__(path, name, budget)
        with path.open("rb") as file:
            if file.read(8) != MAGIC:
                raise BagError(f"{self.name}: does not begin like an MCAP file")
        self._schemas: dict[int, mcap.records.Schema] = {}
        self._summary = self._read_summary()
        self._scanned = self._summary is not None

    def _read_summary(self) -> Summary | None:
        """Return the summary of a file that was closed properly."""
        try:
            with self.path.open("rb") as file:
                file.seek(-8, io.SEEK_END)
                if file.read(8) != MAGIC:
                    return None
                file.seek(0)
                summary = SeekingReader(file).get_summary()
        except (OSError, *_DAMAGE):
            return None
        if summary is None or summary.statistics is None:
            return None
        if summary.statistics.channel_count != len(summary.channels):
            return None  # the summary does not repeat the channels: scan
        self._schemas.update(summary.schemas)
        for channel in summary.channels.values():
            self._add_channel(channel)
        return summary

    def declared(self) -> dict[str, int] | None:
        """Return what the summary counts."""
        if self._summary is None or self._summary.statistics is None:
            return None
        counts: Counter[str] = Counter()
        for key, channel in self._channels.items():
            counts[channel.topic] += self._summary.statistics.channel_message_counts.get(key, 0)
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
                    if self._summary is None:
                        self._cut(start, "")
                    break
                op, length = _HEAD.unpack(head)
                if op == _DATA_END:
                    break
                whole = start + 9 + length <= size
                if op == _CHUNK_RECORD and not (whole and self._skippable(start, wanted)):
                    body = file.read(min(length, size - start - 9))
                    yield self._chunk(body, start, whole, wanted)
                elif op == 0 or not whole:
                    if not self._resume(file, start):
                        break
                elif op == _MESSAGE:
                    yield self._top_level(file, start, length, wanted)
                elif op in (_SCHEMA, _CHANNEL):
                    self._define(op, file.read(length))
                else:
                    file.seek(length, io.SEEK_CUR)
        self._scanned = True

    def _top_level(
        self, file: BinaryIO, start: int, length: int, wanted: Callable[[Channel], bool]
    ) -> list[Batch]:
        """Return messages that stand outside of chunks, of a block of the file."""
        file.seek(start)
        data = file.read(max(_BLOCK, length + 9))
        positions, end = self._walk(data)
        file.seek(start + end)
        return self._split(data, positions, wanted)

    def _chunk(
        self, body: bytes, start: int, whole: bool, wanted: Callable[[Channel], bool]
    ) -> list[Batch]:
        """Return the messages of a chunk; of one that is cut off, those that are there."""
        try:
            _, _, size, crc = _CHUNK.unpack_from(body)
            stream = ReadDataStream(io.BytesIO(body[28:]))
            compression = stream.read_prefixed_string()
            stored = stream.read8()
        except _DAMAGE:
            self._cut(start, "inside a chunk's head")
            return []
        packed = body[28 + stream.count :][:stored]
        data = decompress(packed, compression, size, self._budget)
        sound = len(data) == size and (not crc or zlib.crc32(data) == crc)
        if whole and not sound:
            self._amiss(
                f"the chunk at byte {start} is damaged and was left out"
                f"{self._count_of_chunk(start)}"
            )
            return []
        positions, end = self._walk(data)
        if not whole:
            self._cut(start, f"inside a chunk of which {len(positions)} messages could be read")
        elif end != len(data):
            self._amiss(
                f"the chunk at byte {start} ends inside a record; "
                f"{len(data) - end} of its bytes were left out"
            )
        return self._split(data, positions, wanted)

    def _walk(self, data: bytes) -> tuple[list[int], int]:
        """Take in what is defined; return where messages begin and the last whole record ends."""
        unpack, end, pos = _HEAD.unpack_from, len(data), 0
        messages: list[int] = []
        while end - pos >= 9:
            op, length = unpack(data, pos)
            following = pos + 9 + length
            if following > end:
                break
            if op == _MESSAGE:
                messages.append(pos)
            elif op in (_SCHEMA, _CHANNEL):
                self._define(op, data[pos + 9 : following])
            elif op in (0, _CHUNK_RECORD, _DATA_END):
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
            self._amiss(f"{int((length < 0).sum())} messages too short")
            at, length = at[length >= 0], length[length >= 0]
        ids = gather(raw, at + 9, "<u2")
        for key in np.unique(ids).tolist():
            channel = self._channels.get(key)
            which = ids == key
            if channel is None:
                self._amiss(
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

    def _define(self, op: int, body: bytes) -> None:
        """Take in a schema or a channel; a damaged one is reported by its messages."""
        stream = ReadDataStream(io.BytesIO(body))
        try:
            if op == _SCHEMA:
                schema = mcap.records.Schema.read(stream)
                self._schemas[schema.id] = schema
            else:
                self._add_channel(mcap.records.Channel.read(stream))
        except _DAMAGE:
            return

    def _add_channel(self, channel: mcap.records.Channel) -> None:
        schema = self._schemas.get(channel.schema_id)
        self._channels[channel.id] = Channel(
            id=channel.id,
            topic=channel.topic,
            type=message_type(schema.name) if schema else "",
            encoding=channel.message_encoding,
            definition=schema.data.decode("utf-8", "replace") if schema else "",
            definition_format=schema.encoding if schema else "",
            qos=channel.metadata.get("offered_qos_profiles", ""),
            numbered=channel.metadata.get(NUMBERED) == "true",
        )

    def _skippable(self, start: int, wanted: Callable[[Channel], bool]) -> bool:
        """Return whether the index says that a chunk has nothing of what is wanted."""
        index = self._chunk_indexes.get(start)
        if index is None or not index.message_index_offsets:
            return False
        inside = [self._channels.get(key) for key in index.message_index_offsets]
        return all(channel is not None and not wanted(channel) for channel in inside)

    def _count_of_chunk(self, start: int) -> str:
        index = self._chunk_indexes.get(start)
        if index is None or not index.message_index_offsets:
            return ""
        # Each channel's index record is 15 bytes and 16 per message.
        count = (index.message_index_length - 15 * len(index.message_index_offsets)) // 16
        return f" with {count} messages"

    def _resume(self, file: BinaryIO, start: int) -> bool:
        """Go to the next chunk that the index knows behind a damaged place."""
        beyond = [offset for offset in self._chunk_indexes if offset > start]
        self._cut(start, "" if not beyond else f"; reading went on at byte {min(beyond)}")
        if beyond:
            file.seek(min(beyond))
        return bool(beyond)

    @property
    def _chunk_indexes(self) -> dict[int, mcap.records.ChunkIndex]:
        if self._summary is None:
            return {}
        return {index.chunk_start_offset: index for index in self._summary.chunk_indexes}

    def _cut(self, start: int, where: str) -> None:
        size = self.path.stat().st_size
        what = "damaged" if self._summary is not None else "cut off or damaged"
        self._amiss(f"{what} at byte {start} of {size} {where}".rstrip())


FORMAT = Format("MCAP", (".mcap",), MAGIC, _McapFile, tables=False)
