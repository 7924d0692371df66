"""Writing bags that are whole at every moment: a killed recorder leaves a readable bag.

Every flush appends a chunk, its message index and a complete summary with footer, in one
write; the next flush overwrites that summary.  So the file on disk is a closed MCAP file
up to its last flush, with a metadata.yaml that counts the same messages.
"""

import contextlib
import json
import os
import struct
import threading
import time
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from smp_motor_ident.bag.metadata import DEFAULT_QOS, document, topic_entry
from smp_motor_ident.bag.readers.mcap import MAGIC, NUMBERED
from smp_motor_ident.bag.types import definition
from smp_motor_ident.errors import BagError

_MESSAGE = struct.Struct("<BQHIQQ")
_INDEX_ENTRY = struct.Struct("<QQ")
CHUNK_SIZE = 1 << 20
FLUSH_PERIOD = 0.5


@dataclass
class _Topic:
    """A topic of the bag and what is said about it."""

    channel: records.Channel
    type_name: str
    text: str
    count: int = 0
    entries: bytearray = field(default_factory=bytearray)


class BagWriter:
    """Writes an MCAP bag folder as rosbag2 of ROS 2 Jazzy lays it out (metadata version 9).

    The folder must not exist.  With messages coming, what came within ``flush_period`` [s] is lost
    at most when the process is killed.

    Examples
    --------
    >>> with BagWriter(path) as bag:                              # doctest: +SKIP
    ...     bag.write("/pwm", "std_msgs/msg/Float64", data, stamp_ns)
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        flush_period: float = FLUSH_PERIOD,
    ) -> None:
        self.path = Path(path)
        self._file_name = f"{self.path.resolve().name}_0.mcap"
        self._distribution = os.environ.get("ROS_DISTRO", "") or "jazzy"
        self._flush_period = flush_period
        self._topics: dict[str, _Topic] = {}
        self._schemas: dict[str, tuple[records.Schema, str]] = {}
        self._chunks, self._chunk_indexes = 0, bytearray()
        self._chunk = bytearray()
        self._chunk_range = (2**63 - 1, 0)
        self._range = (2**63 - 1, 0)
        self._lock = threading.RLock()
        self._flushed = time.monotonic()
        self._closed = False
        try:
            self.path.mkdir(parents=True)
            self._file = open(self.path / self._file_name, "xb", buffering=0)  # noqa: SIM115
        except FileExistsError:
            raise BagError(f"{self.path}: exists already; choose another name") from None
        except OSError as error:
            raise BagError(f"{self.path}: cannot be made ({error.strerror})") from None
        head = RecordBuilder()
        head.write(MAGIC)
        records.Header(profile="ros2", library="smp_motor_ident").write(head)
        self._end = self._file.write(_taken(head))
        self.flush(force=True)

    @property
    def counts(self) -> dict[str, int]:
        """Messages by topic that were written so far."""
        return {name: topic.count for name, topic in self._topics.items()}

    def add_topic(
        self,
        topic: str,
        type_name: str,
        qos: list[dict[str, Any]] | None = None,
        *,
        numbered: bool = False,
    ) -> bool:
        """Announce a topic; `write` does it by itself where the QoS does not matter.

        ``qos`` has a profile for each publisher, with keys as in `DEFAULT_QOS`; ``numbered`` says
        that `write` will be given the publisher's own numbers.  False where nobody here knows the
        type, so that its messages are kept without their definition.
        """
        with self._lock:
            if topic in self._topics:
                return True
            schema, type_hash = self._schema(type_name)
            profiles = json.loads(json.dumps([{**DEFAULT_QOS, **p} for p in qos or [{}]]))
            metadata = {
                "offered_qos_profiles": yaml.safe_dump(profiles, sort_keys=False),
                "topic_type_hash": type_hash,
            }
            if numbered:
                metadata[NUMBERED] = "true"
            channel = records.Channel(
                id=len(self._topics) + 1,
                topic=topic,
                message_encoding="cdr",
                metadata=metadata,
                schema_id=schema.id,
            )
            text = topic_entry(topic, type_name, profiles, type_hash)
            self._topics[topic] = _Topic(channel, type_name, text)
            self._add_record(channel)
            return bool(schema.data)

    def _schema(self, type_name: str) -> tuple[records.Schema, str]:
        if type_name not in self._schemas:
            try:
                text, type_hash = definition(type_name)
            except BagError:
                text, type_hash = "", ""
            schema = records.Schema(
                id=len(self._schemas) + 1,
                data=text.encode(),
                encoding="ros2msg" if text else "",
                name=type_name,
            )
            self._schemas[type_name] = (schema, type_hash)
            self._add_record(schema)
        return self._schemas[type_name]

    def _add_record(self, record: records.McapRecord) -> None:
        builder = RecordBuilder()
        record.write(builder)
        self._chunk += _taken(builder)

    def write(
        self,
        topic: str,
        type_name: str,
        data: bytes,
        stamp: int,
        *,
        sent: int | None = None,
        number: int = 0,
    ) -> None:
        """Write a message, serialized (CDR) with its four bytes of encapsulation.

        ``stamp`` is when it came, ``sent`` when it was published, in nanoseconds since 1970;
        ``number`` is the publisher's own, 0 where that is not known.
        """
        with self._lock:
            if self._closed:
                raise BagError(f"{self.path}: is closed")
            entry = self._topics.get(topic)
            if entry is None:
                self.add_topic(topic, type_name)
                entry = self._topics[topic]
            if entry.type_name != type_name:
                raise BagError(
                    f"{self.path}: {topic} is of the type {entry.type_name}, not {type_name}"
                )
            entry.entries += _INDEX_ENTRY.pack(stamp, len(self._chunk))
            self._chunk += _MESSAGE.pack(
                Opcode.MESSAGE,
                22 + len(data),
                entry.channel.id,
                number & 0xFFFFFFFF,
                stamp,
                stamp if sent is None else sent,
            )
            self._chunk += data
            entry.count += 1
            first, last = self._chunk_range
            self._chunk_range = (min(first, stamp), max(last, stamp))
            self.flush(force=len(self._chunk) >= CHUNK_SIZE)

    def flush(self, *, force: bool = False) -> None:
        """Bring what was written to the disk, where the flush period is over or it is forced."""
        # The summary grows with the bag: hours later it is rewritten less often.
        period = max(self._flush_period, len(self._chunk_indexes) / 2e6)
        if self._closed or (not force and time.monotonic() - self._flushed < period):
            return
        with self._lock:
            self._flushed = time.monotonic()
            builder = RecordBuilder()
            if self._chunk:
                self._finish_chunk(builder)
            appended = builder.count
            self._write_summary(builder, self._end + appended)
            try:
                self._write_all(_taken(builder))
                self._end += appended
                self._write_metadata()
            except OSError as error:
                raise BagError(f"{self.path}: cannot be written ({error.strerror})") from None

    def _finish_chunk(self, builder: RecordBuilder) -> None:
        """Append the open chunk and its indexes."""
        data, (first, last) = bytes(self._chunk), self._chunk_range
        if last < first:  # only schemas and channels
            first, last = 0, 0
        start = self._end
        records.Chunk(
            compression="",
            data=data,
            message_start_time=first,
            message_end_time=last,
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        ).write(builder)
        length, offsets = builder.count, {}
        for topic in self._topics.values():
            if topic.entries:
                offsets[topic.channel.id] = start + builder.count
                builder.start_record(Opcode.MESSAGE_INDEX)
                builder.write2(topic.channel.id)
                builder.write4(len(topic.entries))
                builder.write(topic.entries)
                builder.finish_record()  # type: ignore[no-untyped-call]
                topic.entries = bytearray()
        index = RecordBuilder()
        records.ChunkIndex(
            chunk_length=length,
            chunk_start_offset=start,
            compression="",
            compressed_size=len(data),
            message_end_time=last,
            message_index_length=builder.count - length,
            message_index_offsets=offsets,
            message_start_time=first,
            uncompressed_size=len(data),
        ).write(index)
        self._chunk_indexes += _taken(index)
        self._chunks += 1
        if offsets:
            self._range = (min(self._range[0], first), max(self._range[1], last))
        self._chunk, self._chunk_range = bytearray(), (2**63 - 1, 0)

    def _write_summary(self, builder: RecordBuilder, start: int) -> None:
        """Append everything that closes the file; ``start`` is where that begins."""
        records.DataEnd(0).write(builder)
        summary = RecordBuilder()
        begin = start + 13  # behind the record above
        offsets = []
        groups: list[tuple[Opcode, list[records.McapRecord], bytes | bytearray]] = [
            (Opcode.SCHEMA, [schema for schema, _ in self._schemas.values()], b""),
            (Opcode.CHANNEL, [topic.channel for topic in self._topics.values()], b""),
            (Opcode.STATISTICS, [self._statistics()], b""),
            (Opcode.CHUNK_INDEX, [], self._chunk_indexes),
        ]
        for opcode, group, ready in groups:
            at = summary.count
            for record in group:
                record.write(summary)
            summary.write(ready)
            if summary.count > at:
                offsets.append(records.SummaryOffset(opcode, begin + at, summary.count - at))
        offset_start = begin + summary.count
        for offset in offsets:
            offset.write(summary)
        data = _taken(summary)
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, begin, offset_start)
        builder.write(data)
        builder.write(footer + struct.pack("<I", zlib.crc32(footer, zlib.crc32(data))))
        builder.write(MAGIC)

    def _statistics(self) -> records.Statistics:
        total = sum(self.counts.values())
        return records.Statistics(
            attachment_count=0,
            channel_count=len(self._topics),
            channel_message_counts={t.channel.id: t.count for t in self._topics.values()},
            chunk_count=self._chunks,
            message_count=total,
            message_end_time=self._range[1] if total else 0,
            message_start_time=self._range[0] if total else 0,
            metadata_count=0,
            schema_count=len(self._schemas),
        )

    def _write_all(self, data: bytes) -> None:
        view, position = memoryview(data), self._end
        while view:
            done = os.pwrite(self._file.fileno(), view, position)
            view, position = view[done:], position + done

    def _write_metadata(self) -> None:
        """Write metadata.yaml beside, then put it in place at once."""
        total = sum(self.counts.values())
        first, last = self._range if total else (0, 0)
        topics = [(topic.text, topic.count) for topic in self._topics.values()]
        text = document(self._file_name, self._distribution, first, last, topics)
        target = self.path / "metadata.yaml"
        draft = target.with_suffix(".yaml.new")
        draft.write_text(text)
        draft.replace(target)

    def close(self) -> None:
        """Write what is left and close the bag; nothing happens the second time."""
        with self._lock:
            if self._closed:
                return
            try:
                self.flush(force=True)
                with contextlib.suppress(OSError):
                    os.fsync(self._file.fileno())
            finally:
                self._closed = True
                self._file.close()

    def __enter__(self) -> "BagWriter":
        """Return the writer."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close the bag, also after an error: what was recorded is kept."""
        self.close()


def _taken(builder: RecordBuilder) -> bytes:
    """Return what was built."""
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data
