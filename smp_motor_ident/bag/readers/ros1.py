# SPDX-License-Identifier: Apache-2.0
"""Read ROS 1 bags of version 2.0, whole or cut off, indexed or not.

The format is that of http://wiki.ros.org/Bags/Format/2.0; rosbags reads the records' heads.
"""

import io
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import ReaderError
from rosbags.rosbag1.reader import Header, RecordType
from rosbags.typesys.msg import normalize_msgtype

from smp_motor_ident.bag.readers.format import Format, Messages
from smp_motor_ident.bag.storage import Batch, Channel, join
from smp_motor_ident.bag.unpack import Budget, decompress
from smp_motor_ident.errors import BagError

MAGIC = b"#ROSBAG V"
_FIRST_LINE = b"#ROSBAG V2.0\n"
_COMPRESSION = {"none": "", "bz2": "bz2", "lz4": "lz4"}
_DAMAGE = (ReaderError, LookupError, ValueError, OverflowError)


class _Ros1Bag(Messages):
    """One ``.bag`` file."""

    def __init__(self, path: Path, name: str, budget: Budget) -> None:
        super().__init__(path, name, budget)
        with path.open("rb") as file:
            if (line := file.readline(32)) != _FIRST_LINE:
                version = line[len(MAGIC) - 1 :].strip().decode("latin-1")
                raise BagError(f"{name}: is a ROS 1 bag of version {version!r}; only 2.0 is read")

    def batches(self, wanted: Callable[[Channel], bool]) -> Iterator[list[Batch]]:
        """Walk over the file, a chunk at a time."""
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            file.seek(len(_FIRST_LINE))
            yield from self._walk(file, size, wanted, inside=False)
        self._scanned = True

    def _walk(
        self, file: Any, size: int, wanted: Callable[[Channel], bool], *, inside: bool
    ) -> Iterator[list[Batch]]:
        """Yield the messages of a file, or of an unpacked chunk, by connection."""
        messages: dict[int, list[tuple[int, bytes]]] = defaultdict(list)
        while (start := file.tell()) < size:
            try:
                header = Header.read(file)
                kind = header.get_uint8("op")
                length = int.from_bytes(file.read(4), "little")
                if file.tell() + length > size and kind != RecordType.CHUNK:
                    raise ReaderError("cut off")
                if kind == RecordType.CHUNK:
                    packed = _COMPRESSION.get(header.get_string("compression"), "?")
                    whole = header.get_uint32("size")
                    data = decompress(file.read(length), packed, self._budget)
                    if len(data) != whole:
                        self._damage(f"the chunk at byte {start} is damaged; its rest is left out")
                    yield from self._walk(io.BytesIO(data), len(data), wanted, inside=True)
                elif kind == RecordType.CONNECTION:
                    self._connect(header, file.read(length))
                elif kind == RecordType.MSGDATA:
                    key = header.get_uint32("conn")
                    messages[key].append((header.get_time("time"), file.read(length)))
                else:
                    file.seek(length, io.SEEK_CUR)
            except _DAMAGE:
                where = "inside a chunk" if inside else f"at byte {start} of {size}"
                self._damage(f"cut off or damaged {where}")
                break
        batches = []
        for key, sent in messages.items():
            channel = self._channels.get(key)
            if channel is None:
                self._damage(
                    f"{len(sent)} messages of connection {key}, which it does not describe"
                )
            elif wanted(channel):
                log = np.array([time for time, _ in sent], np.int64)
                batches.append(join(channel, [data for _, data in sent], log))
        yield batches

    def _connect(self, header: Any, body: bytes) -> None:
        """Store a connection: its topic, and the definition of its type."""
        key = header.get_uint32("conn")
        if key in self._channels:
            return
        inner = Header.read(io.BytesIO(len(body).to_bytes(4, "little") + body))
        kind = normalize_msgtype(inner.get_string("type"))
        text = inner.get_string("message_definition")
        topic = "/" + header.get_string("topic").strip("/")
        self._channels[key] = Channel(key, topic, kind, "ros1", text, "ros1msg")


FORMAT = Format("ROS 1 bag", (".bag",), MAGIC, _Ros1Bag, tables=False)
