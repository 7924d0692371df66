"""What every storage format gives: channels, and batches of raw messages for bulk decoding."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import lz4.frame
import numpy as np
import zstandard
from numpy.typing import NDArray

from smp_motor_ident.errors import BagError

Bytes = NDArray[np.uint8]
Integers = NDArray[np.int64]

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
LZ4_MAGIC = b"\x04\x22\x4d\x18"


@dataclass(frozen=True)
class Channel:
    """One stream of messages in a file: a topic, its type and how the type is defined there."""

    id: int
    topic: str
    type: str
    encoding: str = "cdr"
    definition: str = ""
    definition_format: str = ""
    qos: str = ""
    numbered: bool = False
    """Whether the messages' sequence is the publisher's own count, so that a gap is a loss."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Some messages of one channel, in the order of the file.

    Message k occupies ``data[offset[k] : offset[k] + length[k]]``; its log time is in
    nanoseconds since the epoch of the recorder.
    """

    channel: Channel
    data: Bytes
    offset: Integers
    length: Integers
    log_time: Integers
    sequence: Integers | None = None

    def __len__(self) -> int:
        """Return the number of messages."""
        return int(self.offset.size)

    def message(self, k: int) -> bytes:
        """Return the bytes of message ``k``.

        Parameters
        ----------
        k : int
            Index in the batch.

        Returns
        -------
        bytes
            Of the serialized message.
        """
        begin = int(self.offset[k])
        return self.data[begin : begin + int(self.length[k])].tobytes()

    def take(self, which: NDArray[Any]) -> Batch:
        """Return the chosen messages, sharing the data.

        Parameters
        ----------
        which : ndarray
            Indices or a mask.

        Returns
        -------
        Batch
            Of the same channel.
        """
        return Batch(
            self.channel,
            self.data,
            self.offset[which],
            self.length[which],
            self.log_time[which],
            None if self.sequence is None else self.sequence[which],
        )


class Storage(Protocol):
    """A file of messages.

    ``problems`` fills while the file is read: one sentence for everything that was lost.
    """

    path: Path
    problems: list[str]

    def channels(self) -> list[Channel]:
        """Return the channels, reading the whole file where it has no index."""
        ...

    def promised(self) -> dict[str, int] | None:
        """Return the number of messages by topic where the file itself tells it."""
        ...

    def batches(self, wanted: Callable[[Channel], bool]) -> Iterator[tuple[float, Batch]]:
        """Yield the fraction of the file that is read, and a batch."""
        ...


def gather(data: Bytes, at: Integers, dtype: str) -> NDArray[Any]:
    """Return the numbers that begin at the given bytes, aligned or not.

    Parameters
    ----------
    data : ndarray of uint8
        The bytes.
    at : ndarray of int64
        Position of each number's first byte; all must fit.
    dtype : str
        Such as ``<f8``.

    Returns
    -------
    ndarray, shape of ``at``
        Of type ``dtype``.
    """
    kind = np.dtype(dtype)
    # A view in which every byte begins a number: one indexing reads them all.
    every: NDArray[Any] = np.ndarray(
        (data.size - kind.itemsize + 1,), kind, data.data, strides=(1,)
    )
    return every[at]


def message_type(name: str) -> str:
    """Return a type name with its ``/msg/``, which the oldest bags leave out."""
    return re.sub(r"^(\w+)/(\w+)$", r"\1/msg/\2", name)


def decompress(data: bytes, compression: str, size: int) -> bytes:
    """Decompress a block, or what can be had of one that is cut off."""
    if compression in ("", "none"):
        return data
    try:
        if compression == "zstd":
            if size:
                try:
                    return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
                except zstandard.ZstdError:
                    pass  # cut off: take what comes
            return zstandard.ZstdDecompressor().decompressobj().decompress(data)
        if compression == "lz4":
            raw: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data)
            return raw
    except (zstandard.ZstdError, RuntimeError):
        return b""
    raise BagError(f"compression {compression!r} is not supported; use zstd or lz4")


def decompress_messages(batch: Batch) -> tuple[Batch, int]:
    """Decompress messages that were compressed one by one."""
    sound = batch.length >= 4
    if not sound.any():
        return batch, 0
    first = gather(batch.data, np.where(sound, batch.offset, batch.offset[sound][0]), "<u4")
    zstd = sound & (first == int.from_bytes(ZSTD_MAGIC, "little"))
    lz4ed = sound & (first == int.from_bytes(LZ4_MAGIC, "little"))
    if not (zstd.any() or lz4ed.any()):
        return batch, 0
    blobs = []
    for k in range(len(batch)):
        kind = "zstd" if zstd[k] else "lz4" if lz4ed[k] else ""
        blobs.append(decompress(batch.message(k), kind, 0))
    kept = np.array([bool(blob) for blob in blobs])
    joined = join(batch.channel, [b for b in blobs if b], batch.log_time[kept])
    if batch.sequence is not None:
        joined = replace(joined, sequence=batch.sequence[kept])
    return joined, int((~kept).sum())


def join(channel: Channel, blobs: list[bytes], log_time: Integers) -> Batch:
    """Return a batch of messages that are given as bytes.

    Parameters
    ----------
    channel : Channel
        Their channel.
    blobs : list of bytes
        The messages.
    log_time : ndarray of int64
        One for each.

    Returns
    -------
    Batch
        With the messages side by side.
    """
    length = np.fromiter(map(len, blobs), np.int64, len(blobs))
    data = np.frombuffer(b"".join(blobs), np.uint8)
    return Batch(channel, data, np.cumsum(length) - length, length, log_time)
