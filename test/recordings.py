# SPDX-License-Identifier: Apache-2.0
"""Recordings made by libraries other than the reader under test: rosbags, mcap, sqlite3."""

import sqlite3
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mcap.writer
import numpy as np
import pytest
import yaml
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from scipy.signal import cont2discrete, lfilter

from smp_motor_ident.bag import BagWriter, read_records
from smp_motor_ident.errors import BagError
from smp_motor_ident.record import Record

ROOT = Path(__file__).resolve().parents[1]
STATE = "smp_interfaces/msg/MotorState"
DESCRIPTION = "smp_interfaces/msg/MotorDescription"
START = 1_700_000_000_000_000_000
RATIO, COUNTS = 65.5, 500.0


def types() -> Typestore:
    """Return a type store with our messages, read from their source."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name in (STATE, DESCRIPTION, "smp_interfaces/msg/MotorCommand"):
        text = (ROOT / "smp_interfaces" / "msg" / f"{name.rpartition('/')[2]}.msg").read_text()
        store.register(get_types_from_msg(text, name))
    return store


TYPES = types()


@dataclass(frozen=True)
class Sent:
    """One message of a recording."""

    topic: str
    type: str
    stamp: int
    data: bytes


def stamp_of(nanoseconds: int) -> Any:
    return TYPES.types["builtin_interfaces/msg/Time"](*divmod(int(nanoseconds), 1_000_000_000))


def serialized(type_name: str, *, little_endian: bool = True, **fields: Any) -> bytes:
    """Return a message by rosbags' own serialization."""
    message = TYPES.types[type_name](**fields)
    return bytes(TYPES.serialize_cdr(message, type_name, little_endian=little_endian))


def header(nanoseconds: int, frame: str = "") -> Any:
    return TYPES.types["std_msgs/msg/Header"](stamp_of(nanoseconds), frame)


@dataclass(frozen=True)
class Motion:
    """Motion of one motor, and its messages."""

    wheel: str
    time: np.ndarray
    voltage: np.ndarray
    current: np.ndarray
    velocity: np.ndarray
    position: np.ndarray
    count: np.ndarray
    bits: int = 0

    def state(self, k: int, little_endian: bool = True) -> bytes:
        raw = int(self.count[k])
        if self.bits:
            half = 1 << (self.bits - 1)
            raw = (raw + half) % (1 << self.bits) - half
        return serialized(
            STATE,
            little_endian=little_endian,
            header=header(self.time[k], f"{self.wheel}_wheel_joint"),
            voltage=float(self.voltage[k]),
            current=float(self.current[k]),
            velocity=float(self.velocity[k]),
            position=float(self.position[k]),
            encoder_count=raw,
            duty_cycle=0.0,
        )

    def messages(self, latency: int = 150_000, description: bool = True) -> list[Sent]:
        sent = []
        if description:
            text = serialized(
                DESCRIPTION,
                joint_name=f"{self.wheel}_wheel_joint",
                gear_ratio=RATIO,
                counts_per_revolution=COUNTS,
                encoder_bits=self.bits,
                supply_voltage=12.0,
                resistance=float("nan"),
            )
            topic = f"/{self.wheel}/motor_description"
            sent.append(Sent(topic, DESCRIPTION, int(self.time[0]), text))
        topic = f"/{self.wheel}/motor_state"
        sent += [
            Sent(topic, STATE, int(t) + latency, self.state(k)) for k, t in enumerate(self.time)
        ]
        return sent


def motion(n=200, wheel="front_left", step=10000000, seed=1, bits=0):
    """Return a motor that follows a random voltage."""
    rng = np.random.default_rng(seed)
    voltage = rng.uniform(-12, 12, n)
    velocity = np.cumsum(rng.normal(0, 0.1, n))
    position = np.cumsum(velocity) * step * 1e-9
    count = np.rint(position * RATIO * COUNTS / (2 * np.pi)).astype(np.int64)
    time = START + step * np.arange(n, dtype=np.int64)
    return Motion(wheel, time, voltage, rng.normal(0, 1, n), velocity, position, count, bits)


def write_table(path: Path, separator: str = ",", **columns: Iterable[Any]) -> Path:
    """Write a table of columns below their names."""
    rows = [columns, *zip(*columns.values())]
    path.write_text("\n".join(separator.join(map(str, row)) for row in rows))
    return path


def follow(voltage):
    """Return the speed of a motor, 20 rad/s/V and 0.1 s, under voltages held for 10 ms each."""
    keep = np.exp(-0.1)
    return lfilter([0.0, 20 * (1 - keep)], [1.0, -keep], voltage)


def write_steps(path: Path, seconds=20.0, level=6.0, seed=1, begin=0.0) -> Path:
    """Write a motor, 25 rad/s/V and 60 ms, under random steps; ``u`` holds from its row on."""
    rng = np.random.default_rng(seed)
    n = round(seconds / 0.01)
    voltage = np.repeat(rng.uniform(-level, level, n // 20 + 1), 20)[:n]
    b, a, _ = cont2discrete(([25.0], [0.06, 1.0]), 0.01)
    speed = lfilter(b.ravel(), a, voltage) + rng.normal(0.0, 0.5, n)
    table = np.column_stack((begin + np.arange(n) * 0.01, voltage, speed))
    path.parent.mkdir(exist_ok=True)
    np.savetxt(path, table, delimiter=",", header="t,u,w", comments="", fmt="%.15g")
    return path


def merged(*motions: Motion, **options: Any) -> list[Sent]:
    """Return the messages of several motors in the order of their stamps."""
    return in_order(*(one.messages(**options) for one in motions))


def floats(topic: str, times: Iterable[int], values: Iterable[float]) -> list[Sent]:
    """Return messages of a number."""
    kind = "std_msgs/msg/Float64"
    return [
        Sent(topic, kind, int(t), serialized(kind, data=float(v))) for t, v in zip(times, values)
    ]


def joint_state(at: int, names: list[str], velocity: Iterable[float], **more: Any) -> Sent:
    """Return the speeds of joints; ``more`` are other fields, or the topic."""
    kind, none = "sensor_msgs/msg/JointState", np.zeros(0)
    topic, stamp = more.pop("topic", "/joint_states"), more.pop("stamp", at)
    fields = {"header": header(stamp), "position": none, "effort": none, **more}
    speeds = np.array(velocity, float)
    return Sent(topic, kind, int(at), serialized(kind, name=names, velocity=speeds, **fields))


def in_order(*parts: list[Sent]) -> list[Sent]:
    return sorted((sent for part in parts for sent in part), key=lambda sent: sent.stamp)


def notes(record: Record) -> str:
    """Return the messages of all findings."""
    return " ".join(finding.message for finding in record.findings)


def codes(record: Record) -> list[str]:
    """Return the codes of all findings."""
    return [finding.code for finding in record.findings]


def definition(type_name: str) -> str:
    return TYPES.generate_msgdef(type_name, ros_version=2)[0]


def write_file(path: Path, messages: Iterable[Sent], **options: Any) -> Path:
    """Write the file of a bag in the format of its suffix, and its folder."""
    return (write_sqlite if path.suffix == ".db3" else write_mcap)(path, messages, **options)


def write_mcap(path, messages, *, define=definition, encoding="ros2msg", encode=bytes, **options):
    """Write an .mcap file with the mcap library; ``define`` gives the definition of a type."""
    path.parent.mkdir(exist_ok=True)
    options.setdefault("chunk_size", 4096)
    options.setdefault("compression", mcap.writer.CompressionType.NONE)
    with path.open("wb") as file:
        writer = mcap.writer.Writer(file, **options)
        writer.start("ros2")
        channels: dict[tuple[str, str], int] = {}
        for sent in messages:
            key = (sent.topic, sent.type)
            if key not in channels:
                text = define(sent.type).encode()
                schema = writer.register_schema(sent.type, encoding, text)
                channels[key] = writer.register_channel(sent.topic, "cdr", schema)
            writer.add_message(channels[key], sent.stamp, encode(sent.data), sent.stamp)
        writer.finish()
    return path


def write_bag(path: Path, messages: Iterable[Sent]) -> None:
    """Write the folder of a bag as ``record`` does."""
    with BagWriter(path) as bag:
        for sent in messages:
            bag.write(sent.topic, sent.type, sent.data, sent.stamp)


TOPIC_COLUMNS = {
    1: "",
    2: ", offered_qos_profiles TEXT NOT NULL",
    3: ", offered_qos_profiles TEXT NOT NULL",
    4: ", offered_qos_profiles TEXT NOT NULL, type_description_hash TEXT NOT NULL",
}


def write_sqlite(path, messages, *, schema=4, encode=bytes, qos=""):
    """Write a .db3 file as rosbag2 laid it out in that version of its schema."""
    path.parent.mkdir(exist_ok=True)
    database = sqlite3.connect(path)
    database.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
        f"serialization_format TEXT NOT NULL{TOPIC_COLUMNS[schema]})"
    )
    database.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, "
        "timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
    )
    database.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
    if schema >= 3:
        database.execute("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT)")
        database.execute("INSERT INTO schema VALUES (?, 'test')", (schema,))
    if schema >= 4:
        database.execute(
            "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, "
            "encoding TEXT, encoded_message_definition TEXT, type_description_hash TEXT)"
        )
    topics: dict[tuple[str, str], int] = {}
    for sent in messages:
        key = (sent.topic, sent.type)
        if key not in topics:
            topics[key] = len(topics) + 1
            row: list[Any] = [topics[key], sent.topic, sent.type, "cdr"]
            row += [qos] if schema >= 2 else []
            row += [""] if schema >= 4 else []
            marks = ",".join("?" * len(row))
            database.execute(f"INSERT INTO topics VALUES ({marks})", row)
            if schema >= 4:
                database.execute(
                    "INSERT INTO message_definitions(topic_type, encoding, "
                    "encoded_message_definition, type_description_hash) VALUES (?, ?, ?, '')",
                    (sent.type, "ros2msg", definition(sent.type)),
                )
        database.execute(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)",
            (topics[key], sent.stamp, encode(sent.data)),
        )
    database.commit()
    database.close()
    return path


def write_metadata(
    folder,
    files,
    messages,
    *,
    version=9,
    compression=("", ""),
    counts=None,
    qos=None,
):
    """Write a metadata.yaml as rosbag2 of that version did."""
    topics: dict[tuple[str, str], int] = {}
    for sent in messages:
        topics[sent.topic, sent.type] = topics.get((sent.topic, sent.type), 0) + 1
    entries = []
    for (name, kind), count in topics.items():
        topic: dict[str, Any] = {"name": name, "type": kind, "serialization_format": "cdr"}
        if version == 1:
            topic = {"name": name, "type": kind.replace("/msg/", "/")}
        if version >= 4:
            topic["offered_qos_profiles"] = ("" if version < 9 else []) if qos is None else qos
        if version >= 7:
            topic["type_description_hash"] = ""
        key = "topic_and_type" if version == 1 else "topic_metadata"
        entries.append({key: topic, "message_count": (counts or {}).get(name, count)})
    stamps = [sent.stamp for sent in messages] or [0]
    information: dict[str, Any] = {
        "version": version,
        "storage_identifier": "sqlite3" if ".db3" in files[0] else "mcap",
        "relative_file_paths": files if version >= 4 else [f"{folder.name}/{f}" for f in files],
        "duration": {"nanoseconds": max(stamps) - min(stamps)},
        "starting_time": {"nanoseconds_since_epoch": min(stamps)},
        "message_count": len(messages),
        "topics_with_message_count": entries,
    }
    if version >= 3:
        information["compression_format"], information["compression_mode"] = compression
    if version >= 5:
        information["files"] = [{"path": file} for file in files]
    if version >= 6:
        information["custom_data"] = None
    if version >= 8:
        information["ros_distro"] = "test"
    document = {"rosbag2_bagfile_information": information}
    (folder / "metadata.yaml").write_text(yaml.safe_dump(document))


def assert_read(record: Any, truth: Motion, n: int | None = None) -> None:
    """Assert that a record equals a motion (its first ``n`` samples)."""
    n = truth.time.size if n is None else n
    assert len(record) == n
    # Nanoseconds become float64 seconds: exact to half a unit in the last place.
    np.testing.assert_allclose(record.time, (truth.time[:n] - truth.time[0]) * 1e-9, rtol=1e-15)
    np.testing.assert_array_equal(record.voltage, truth.voltage[:n])
    np.testing.assert_array_equal(record.current, truth.current[:n])
    np.testing.assert_array_equal(record.velocity, truth.velocity[:n] * RATIO)
    np.testing.assert_array_equal(record.position, truth.position[:n] * RATIO)
    np.testing.assert_array_equal(record.count - record.count[0], truth.count[:n] - truth.count[0])


def read(path: Path, messages: Iterable[Sent], mapping: Any = None) -> Record:
    """Return the only record of a bag of these messages."""
    path.unlink(missing_ok=True)
    return read_one(write_mcap(path, messages), mapping)


def read_one(path: Path, mapping: Any = None) -> Record:
    """Return the only record of a file."""
    (record,) = read_records(path, mapping).values()
    return record


def read_table(folder: Path, mapping: Any, **columns: Iterable[Any]) -> Record:
    """Return the only record of a table of these columns."""
    return read_one(write_table(folder / "log.csv", **columns), mapping)


def assert_refused(match: str, source: Any, mapping: Any = None) -> None:
    """Assert that reading is refused in one line that gives the reason and names the file."""
    with pytest.raises(BagError, match=match) as refused:
        read_records(source, mapping)
    message = str(refused.value)
    assert "\n" not in message
    assert not isinstance(source, Path) or source.name in message, message
