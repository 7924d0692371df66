# SPDX-License-Identifier: Apache-2.0
"""Contents of recordings: channels, and batches of raw messages or tables of columns."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_control.arrays import Array, Flags, Integers
from smp_motor_ident.finding import Finding, Severity

Bytes = NDArray[np.uint8]

TABLE = "table"  # encoding of a channel whose file holds columns of numbers instead of messages


def note(code: str, message: str, severity: Severity = "note", **evidence: float) -> Finding:
    """Return a finding with its evidence."""
    return Finding(code, severity, message, evidence)


def note_damage(message: str) -> Finding:
    """Return a finding on a lost part of a recording."""
    return Finding("damaged_recording", "warning", message)


@dataclass(frozen=True)
class Channel:
    """One stream of samples in a file: a topic, its type and how the type is defined there."""

    id: int
    topic: str
    type: str
    encoding: str = "cdr"
    definition: str = ""
    definition_format: str = ""
    qos: str = ""
    # Whether the messages' sequence is the publisher's own count, so that a gap is a loss
    numbered: bool = False
    fields: tuple[str, ...] = ()  # names of the columns of a table
    # Units of the columns, where the file names them
    units: Mapping[str, str] = field(default_factory=dict, hash=False)
    # Words of a column that names motors, by the numbers that replace them
    words: Mapping[str, tuple[str, ...]] = field(default_factory=dict, hash=False)
    # Radius [m] of the wheel for motions in units of length; 0 if unknown
    wheel_radius: float = 0.0
    lengths: tuple[int, ...] = ()  # how many values each column has, where they differ


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
        """Return the bytes of message ``k``."""
        begin = int(self.offset[k])
        return self.data[begin : begin + int(self.length[k])].tobytes()

    def take(self, which: NDArray[Any]) -> "Batch":
        """Return the chosen messages (indices or a mask), sharing the data."""
        sequence = None if self.sequence is None else self.sequence[which]
        places = self.offset[which], self.length[which], self.log_time[which]
        return Batch(self.channel, self.data, *places, sequence)


@dataclass(eq=False)
class Table:
    """Samples of one topic, or rows of a file, in the order of the file."""

    # shape (n,), [ns]: times of arrival, or of the file if ``clocked``; None if they are a column
    log: Integers | None
    stamp: Integers | None  # shape (n,), [ns]: what their header says
    columns: dict[str, NDArray[Any]]  # shape (n,): by field path, in the type of the message
    # For columns that some messages lacked
    present: dict[str, Flags] = field(default_factory=dict)
    # shape (n,): the publisher's own count, where the recorder kept it for every message
    number: Integers | None = None
    findings: list[Finding] = field(default_factory=list)
    clocked: bool = False  # whether ``log`` is the file's own time of each sample
    # Columns of whole nanoseconds, whatever unit is mapped: they were written as dates
    exact: frozenset[str] = frozenset()

    @property
    def logged(self) -> Integers:
        """Log times, once known."""
        assert self.log is not None
        return self.log

    @property
    def seconds(self) -> Array:
        """Stamps if there are any, else log times, since 1970 [s]."""
        return 1e-9 * (self.logged if self.stamp is None else self.stamp).astype(np.float64)


def gather(data: Bytes, at: Integers, dtype: str) -> NDArray[Any]:
    """Return the numbers that begin at the given bytes, aligned or not; all must fit."""
    kind = np.dtype(dtype)
    # A view in which every byte begins a number: one indexing reads them all.
    every: NDArray[Any] = np.ndarray(
        (data.size - kind.itemsize + 1,), kind, data.data, strides=(1,)
    )
    return every[at]


def first_line(error: BaseException) -> str:
    """Return an error's first line, or its type if it has no text."""
    return (str(error).splitlines() or [type(error).__name__])[0]


def message_type(name: str) -> str:
    """Return a type name with its ``/msg/``, which the oldest bags leave out."""
    return re.sub(r"^(\w+)/(\w+)$", r"\1/msg/\2", name)


def join(channel: Channel, blobs: list[bytes], log_time: Integers) -> Batch:
    """Return a batch of messages that are given as bytes."""
    length = np.fromiter(map(len, blobs), np.int64, len(blobs))
    data = np.frombuffer(b"".join(blobs), np.uint8)
    return Batch(channel, data, np.cumsum(length) - length, length, log_time)
