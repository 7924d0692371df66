# SPDX-License-Identifier: Apache-2.0
"""Read MCAP files, whole or cut off at any byte, and report every loss.

The walk hands out positions for bulk decoding instead of one Python object per message.
"""

import io
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from smp_motor_control.arrays import Integers
from smp_motor_ident.bag.readers import mcap_records as records
from smp_motor_ident.bag.readers.format import Format, Messages
from smp_motor_ident.bag.readers.mcap_records import MAGIC
from smp_motor_ident.bag.storage import Batch, Bytes, Channel, gather, message_type
from smp_motor_ident.bag.unpack import Budget, decompress
from smp_motor_ident.errors import BagError

SEQUENCE_KEY = "publication_sequence"
"""Key of a channel's metadata: ``true`` where sequence numbers are the publisher's."""
_BLOCK = 1 << 22


class _McapFile(Messages):
    """One ``.mcap`` file."""

    def __init__(self, path: Path, name: str, budget: Budget) -> None:
        super().__init__(path, name, budget)
        self._schemas: dict[int, records.Schema] = {}
        with path.open("rb") as file:
            if file.read(8) != MAGIC:
                raise BagError(f"{self.name}: does not begin like an MCAP file")
            self._summary = records.read_summary(file)
        if self._summary is not None:
            self._scanned = True
            self._schemas.update(self._summary.schemas)
            for channel in self._summary.channels:
                self._add_channel(channel)

    def declared(self) -> dict[str, int] | None:
        """Return the messages per topic according to the summary."""
        if self._summary is None:
            return None
        counts: Counter[str] = Counter()
        for key, channel in self._channels.items():
            counts[channel.topic] += self._summary.counts.get(key, 0)
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
                op, length = records.HEAD.unpack(head)
                if op == records.DATA_END:
                    break
                whole = start + 9 + length <= size
                if op == records.CHUNK and not (whole and self._skippable(start, wanted)):
                    body = file.read(min(length, size - start - 9))
                    yield self._chunk(body, start, whole, wanted)
                elif op == 0 or not whole:
                    if not self._resume(file, start):
                        break
                elif op == records.MESSAGE:
                    yield self._top_level(file, start, length, wanted)
                elif op in (records.SCHEMA, records.CHANNEL):
                    self._define(op, file.read(length))
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
            size, crc, compression, packed = records.read_chunk(body)
        except records.DAMAGE:
            self._cut(start, "inside a chunk's head")
            return []
        data = decompress(packed, compression, self._budget)
        sound = len(data) == size and (not crc or zlib.crc32(data) == crc)
        if whole and not sound:
            index = self._chunks.get(start)
            many = f" with {index.messages} messages" if index and index.channels else ""
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
        unpack, end, pos = records.HEAD.unpack_from, len(data), 0
        messages: list[int] = []
        while end - pos >= 9:
            op, length = unpack(data, pos)
            following = pos + 9 + length
            if following > end:
                break
            if op == records.MESSAGE:
                messages.append(pos)
            elif op in (records.SCHEMA, records.CHANNEL):
                self._define(op, data[pos + 9 : following])
            elif op in (0, records.CHUNK, records.DATA_END):
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

    def _define(self, op: int, body: bytes) -> None:
        """Store a schema or a channel; a damaged one is reported by its messages."""
        try:
            if op == records.SCHEMA:
                schema = records.read_schema(body)
                self._schemas[schema.id] = schema
            else:
                self._add_channel(records.read_channel(body))
        except records.DAMAGE:
            return

    def _add_channel(self, channel: records.Channel) -> None:
        schema = self._schemas.get(channel.schema)
        self._channels[channel.id] = Channel(
            id=channel.id,
            topic=channel.topic,
            type=message_type(schema.name) if schema else "",
            encoding=channel.encoding,
            definition=schema.data.decode("utf-8", "replace") if schema else "",
            definition_format=schema.encoding if schema else "",
            qos=channel.metadata.get("offered_qos_profiles", ""),
            numbered=channel.metadata.get(SEQUENCE_KEY) == "true",
        )

    def _skippable(self, start: int, wanted: Callable[[Channel], bool]) -> bool:
        """Return whether a chunk has no wanted message according to the index."""
        index = self._chunks.get(start)
        inside = [self._channels.get(key) for key in index.channels] if index else []
        return bool(inside) and all(c is not None and not wanted(c) for c in inside)

    def _resume(self, file: BinaryIO, start: int) -> bool:
        """Continue at the next indexed chunk after a damaged place."""
        beyond = [offset for offset in self._chunks if offset > start]
        self._cut(start, "" if not beyond else f"; reading went on at byte {min(beyond)}")
        if beyond:
            file.seek(min(beyond))
        return bool(beyond)

    @property
    def _chunks(self) -> dict[int, records.ChunkIndex]:
        return {} if self._summary is None else self._summary.chunks

    def _cut(self, start: int, where: str) -> None:
        size = self.path.stat().st_size
        what = "damaged" if self._summary is not None else "cut off or damaged"
        self._damage(f"{what} at byte {start} of {size} {where}".rstrip())


FORMAT = Format("MCAP", (".mcap",), MAGIC, _McapFile, tables=False)
