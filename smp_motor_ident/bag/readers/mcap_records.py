# SPDX-License-Identifier: Apache-2.0
"""Records that describe an MCAP file, in the layout of https://mcap.dev/spec.

A record that ends early, or whose text is not UTF-8, raises one of `DAMAGE`.
"""

import io
import struct
from typing import BinaryIO, NamedTuple

from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_mcap import read_bytes, read_string

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX = 2, 3, 4, 5, 6, 8
STATISTICS, DATA_END = 11, 15
HEAD = struct.Struct("<BQ")  # every record's opcode and length in bytes
DAMAGE = (struct.error, ValueError, OverflowError, ReaderError)
_FOOTER = struct.Struct("<BQQQI")  # with its head


class Schema(NamedTuple):
    """The definition of a message type."""

    id: int
    name: str
    encoding: str
    data: bytes


class Channel(NamedTuple):
    """A topic."""

    id: int
    schema: int
    topic: str
    encoding: str
    metadata: dict[str, str]


class ChunkIndex(NamedTuple):
    """Where a chunk begins in the file, its channels and its number of messages."""

    start: int
    channels: tuple[int, ...]
    messages: int


class Summary(NamedTuple):
    """The summary section of a file that was closed."""

    schemas: dict[int, Schema]
    channels: list[Channel]
    counts: dict[int, int]  # messages by channel
    chunks: dict[int, ChunkIndex]  # by where they begin


def _numbers(file: BinaryIO, kinds: str) -> tuple[int, ...]:
    """Read numbers of the given struct kinds."""
    return struct.unpack("<" + kinds, file.read(struct.calcsize("<" + kinds)))


def read_schema(body: bytes) -> Schema:
    """Read a schema."""
    file = io.BytesIO(body)
    (key,) = _numbers(file, "H")
    return Schema(key, read_string(file), read_string(file), read_bytes(file))


def read_channel(body: bytes) -> Channel:
    """Read a channel."""
    file = io.BytesIO(body)
    key, schema = _numbers(file, "HH")
    topic, encoding, held = read_string(file), read_string(file), read_bytes(file)
    pairs, metadata = io.BytesIO(held), dict[str, str]()
    while pairs.tell() < len(held):
        name = read_string(pairs)
        metadata[name] = read_string(pairs)
    return Channel(key, schema, topic, encoding, metadata)


def read_chunk(body: bytes) -> tuple[int, int, str, bytes]:
    """Read a chunk: its size and CRC (0 if absent) unpacked, its compression and packed bytes."""
    file = io.BytesIO(body)
    _, _, size, crc = _numbers(file, "QQQI")
    compression, (stored,) = read_string(file), _numbers(file, "Q")
    return size, crc, compression, body[file.tell() :][:stored]


def read_chunk_index(body: bytes) -> ChunkIndex:
    """Read the index of a chunk."""
    file = io.BytesIO(body)
    _, _, start, _ = _numbers(file, "QQQQ")
    channels = tuple(key for key, _ in struct.iter_unpack("<HQ", read_bytes(file)))
    (length,) = _numbers(file, "Q")
    # Behind a chunk, each channel's index record is 15 bytes and 16 per message.
    return ChunkIndex(start, channels, (length - 15 * len(channels)) // 16)


def read_statistics(body: bytes) -> tuple[int, dict[int, int]]:
    """Read the number of channels, and the number of messages by channel."""
    file = io.BytesIO(body)
    _, _, channels, _, _, _, _, _ = _numbers(file, "QHIIIIQQ")
    return channels, dict(struct.iter_unpack("<HQ", read_bytes(file)))


def read_summary(file: BinaryIO) -> Summary | None:
    """Return the summary, or None unless it counts the messages and repeats the channels."""
    bodies: dict[int, list[bytes]] = {SCHEMA: [], CHANNEL: [], CHUNK_INDEX: [], STATISTICS: []}
    end = file.seek(0, io.SEEK_END) - _FOOTER.size - len(MAGIC)
    if end < len(MAGIC):
        return None
    file.seek(end)
    op, _, at, _, _ = _FOOTER.unpack(file.read(_FOOTER.size))
    if op != FOOTER or not at or file.read(len(MAGIC)) != MAGIC:
        return None
    while at < end:
        file.seek(at)
        op, length = HEAD.unpack(file.read(HEAD.size))
        at += HEAD.size + length
        if at > end:
            return None
        if op in bodies:
            bodies[op].append(file.read(length))
    try:
        schemas = [read_schema(body) for body in bodies[SCHEMA]]
        channels = [read_channel(body) for body in bodies[CHANNEL]]
        chunks = [read_chunk_index(body) for body in bodies[CHUNK_INDEX]]
        statistics = [read_statistics(body) for body in bodies[STATISTICS]]
    except DAMAGE:
        return None
    if not statistics or statistics[-1][0] != len({channel.id for channel in channels}):
        return None
    return Summary(
        {schema.id: schema for schema in schemas},
        channels,
        statistics[-1][1],
        {chunk.start: chunk for chunk in chunks},
    )
