# SPDX-License-Identifier: Apache-2.0
"""Write bags that stay readable if the recorder is killed.

The MCAP library closes the file at every flush: the closing records are written in one go with
the messages before them, and overwritten by the next flush.  So the file on disk is a closed MCAP
file up to its last flush, with a metadata.yaml that counts the same messages.
"""

import contextlib
import os
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

import yaml
from mcap.writer import CompressionType, Writer

from smp_motor_ident.bag.readers.mcap import SEQUENCE_KEY
from smp_motor_ident.bag.types import definition
from smp_motor_ident.errors import BagError

FLUSH_PERIOD = 0.5
MAX_FLUSH_SHARE = 0.05
"""Largest share of the time for flushing; long files are flushed less often."""

_FOREVER = {"sec": 9223372036, "nsec": 854775807}
DEFAULT_QOS: dict[str, Any] = {
    "history": "keep_last",
    "depth": 10,
    "reliability": "reliable",
    "durability": "volatile",
    "deadline": _FOREVER,
    "lifespan": _FOREVER,
    "liveliness": "automatic",
    "liveliness_lease_duration": _FOREVER,
    "avoid_ros_namespace_conventions": False,
}
"""QoS of a topic as metadata of version 9 write it."""


class _Plain(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """YAML writer without aliases, which not every reader of metadata follows."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _dump_yaml(content: Any) -> str:
    return str(yaml.dump(content, Dumper=_Plain, sort_keys=False))


@dataclass
class _Topic:
    """A topic of the bag: its channel, and its entry of metadata.yaml without the count."""

    id: int
    type_name: str
    metadata: dict[str, Any]
    count: int = 0


class _Draft:
    """Buffer of the end of the file, until a flush."""

    def __init__(self) -> None:
        self.begin = 0
        self.data = bytearray()

    def tell(self) -> int:
        return self.begin + len(self.data)

    def write(self, data: bytes) -> int:
        self.data += data
        return len(data)

    def flush(self) -> None:
        """Do nothing: messages are written together with the closing records."""


class BagWriter(contextlib.AbstractContextManager["BagWriter"]):
    """Writer of an MCAP bag folder in the layout of rosbag2 of ROS 2 Jazzy (metadata version 9).

    The folder must not exist.  A kill of the process loses at most the messages of the last
    ``flush_period`` [s]; after many hours, those of some seconds.
    """

    def __init__(self, path: str | os.PathLike[str], *, flush_period: float = FLUSH_PERIOD) -> None:
        self.path = Path(path)
        self._file_name = f"{self.path.resolve().name}_0.mcap"
        self._distribution = os.environ.get("ROS_DISTRO", "") or "jazzy"
        self._period = self._flush_period = flush_period
        self._topics: dict[str, _Topic] = {}
        self._schemas: dict[str, tuple[int, str]] = {}
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
        self._draft = _Draft()
        self._mcap = Writer(
            cast(IO[bytes], self._draft),
            compression=CompressionType.NONE,
            use_summary_offsets=False,  # the library would repeat those of earlier flushes
        )
        self._mcap.start(profile="ros2", library="smp_motor_ident")
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
        """Add a topic; `write` adds missing ones with a default QoS.

        ``qos`` has a profile for each publisher, with keys as in `DEFAULT_QOS`; ``numbered`` tells
        that `write` gets the publisher's own numbers.  Returns False for an unknown type, whose
        messages are stored without their definition.
        """
        with self._lock:
            if topic in self._topics:
                return True
            schema, type_hash = self._schema(type_name)
            profiles = [{**DEFAULT_QOS, **profile} for profile in qos or [{}]]
            described = {
                "offered_qos_profiles": _dump_yaml(profiles),
                "topic_type_hash": type_hash,
                **({SEQUENCE_KEY: "true"} if numbered else {}),
            }
            channel = self._mcap.register_channel(topic, "cdr", schema, described)
            metadata = {
                "name": topic,
                "type": type_name,
                "serialization_format": "cdr",
                "offered_qos_profiles": profiles,
                "type_description_hash": type_hash,
            }
            self._topics[topic] = _Topic(channel, type_name, metadata)
            return bool(type_hash)

    def _schema(self, type_name: str) -> tuple[int, str]:
        """Return the number of a type in the file, and its hash, empty if unknown."""
        if type_name not in self._schemas:
            try:
                text, type_hash = definition(type_name)
            except BagError:
                text, type_hash = "", ""
            encoding = "ros2msg" if text else ""
            number = self._mcap.register_schema(type_name, encoding, text.encode())
            self._schemas[type_name] = number, type_hash
        return self._schemas[type_name]

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

        ``stamp`` is the time of arrival, ``sent`` of publication, in nanoseconds since 1970;
        ``number`` is the publisher's own, 0 if unknown.
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
            published = stamp if sent is None else sent
            self._mcap.add_message(entry.id, stamp, data, published, number & 0xFFFFFFFF)
            entry.count += 1
            first, last = self._range
            self._range = (min(first, stamp), max(last, stamp))
            self.flush(force=bool(self._draft.data))  # the library has a whole chunk

    def flush(self, *, force: bool = False) -> None:
        """Write pending messages to the disk once the flush period is over, or if forced."""
        begun = time.monotonic()
        if self._closed or (not force and begun - self._flushed < self._period):
            return
        with self._lock:
            draft = self._draft
            self._mcap.flush()  # type: ignore[no-untyped-call]
            kept = len(draft.data)
            self._mcap.finish()  # type: ignore[no-untyped-call]
            whole = bytes(draft.data)
            del draft.data[kept:]
            try:
                view, position = memoryview(whole), draft.begin
                while view:
                    done = os.pwrite(self._file.fileno(), view, position)
                    view, position = view[done:], position + done
                draft.begin += kept
                draft.data.clear()
                self._write_metadata()
            except OSError as error:
                raise BagError(f"{self.path}: cannot be written ({error.strerror})") from None
            self._flushed = time.monotonic()
            self._period = max(self._flush_period, (self._flushed - begun) / MAX_FLUSH_SHARE)

    def _write_metadata(self) -> None:
        """Write metadata.yaml to a temporary file, then rename it."""
        total = sum(self.counts.values())
        first, last = self._range if total else (0, 0)
        begin = {"nanoseconds_since_epoch": first}
        whole = {"starting_time": begin, "duration": {"nanoseconds": last - first}}
        information = {
            "version": 9,
            "storage_identifier": "mcap",
            **whole,
            "message_count": total,
            "topics_with_message_count": [
                {"topic_metadata": topic.metadata, "message_count": topic.count}
                for topic in self._topics.values()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self._file_name],
            "files": [{"path": self._file_name, **whole, "message_count": total}],
            "custom_data": None,
            "ros_distro": self._distribution,
        }
        target = self.path / "metadata.yaml"
        draft = target.with_suffix(".yaml.new")
        draft.write_text(_dump_yaml({"rosbag2_bagfile_information": information}))
        draft.replace(target)

    def close(self) -> None:
        """Write pending messages and close the bag; closing twice does nothing."""
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

    def __exit__(self, *error: object) -> None:
        """Close the bag, also after an error, and keep the recorded messages."""
        self.close()
