# SPDX-License-Identifier: Apache-2.0
"""Bags of every format, written by other libraries, are read as the same record."""

import gc
import shutil
import sqlite3
import struct
import subprocess
import sys
import warnings
from collections.abc import Callable

import lz4.frame
import mcap.writer
import pytest
from backports import zstd
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from recordings import (
    START,
    TYPES,
    Sent,
    assert_read,
    assert_refused,
    header,
    merged,
    motion,
    notes,
    read_one,
    serialized,
    write_file,
    write_mcap,
    write_metadata,
    write_sqlite,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from smp_motor_ident.bag import list_topics, read_records
from smp_motor_ident.bag.readers.mcap import read_summary
from smp_motor_ident.errors import BagError

Pack = Callable[[bytes], bytes]
PACKERS: dict[str, Pack] = {"plain": bytes, "zstd": zstd.compress, "lz4": lz4.frame.compress}


@pytest.mark.parametrize("pack", PACKERS)
@pytest.mark.parametrize("storage", ["mcap", "db3"])
def test_individually_compressed_messages_are_read(tmp_path, storage, pack):
    truth = motion()
    path = write_file(tmp_path / f"bag.{storage}", truth.messages(), encode=PACKERS[pack])
    assert_read(read_one(path), truth)


@pytest.mark.parametrize("pack", PACKERS)
@pytest.mark.parametrize("storage", ["mcap", "db3"])
@pytest.mark.parametrize("bare", [True, False])
def test_files_compressed_as_a_whole_are_read(tmp_path, storage, pack, bare):
    truth, bag = motion(), tmp_path / "bag"
    file = plain = write_file(bag / f"bag_0.{storage}", truth.messages())
    if pack != "plain":
        file = plain.with_name(f"{plain.name}.{pack}")
        file.write_bytes(PACKERS[pack](plain.read_bytes()))
        plain.unlink()
    if not bare:
        compression = (pack, "FILE") if pack != "plain" else ("", "")
        write_metadata(bag, [file.name], truth.messages(), compression=compression)
    assert_read(read_one(file if bare else bag), truth)


@pytest.mark.parametrize("compression", mcap.writer.CompressionType)
@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("indexed", [True, False])
def test_chunks_of_every_compression_are_read(tmp_path, compression, chunked, indexed):
    truth, other = motion(seed=2), motion(wheel="rear_left", seed=3)
    summary = ("repeat_channels", "repeat_schemas", "use_statistics")
    path = write_mcap(
        tmp_path / "bag.mcap", merged(truth, other), compression=compression, use_chunking=chunked,
        index_types=mcap.writer.IndexType.ALL if indexed else mcap.writer.IndexType.NONE,
        **dict.fromkeys(summary, indexed),
    )  # fmt: skip
    records = read_records(path)
    assert_read(records["front_left"], truth)
    assert_read(records["rear_left"], other)


@pytest.mark.parametrize("version", range(1, 10))
@pytest.mark.parametrize("storage", ["mcap", "db3"])
def test_metadata_of_every_version_are_understood(tmp_path, version, storage):
    truth, bag = motion(), tmp_path / "bag"
    schema = 1 if version < 4 else 2 if version < 6 else 3 if version < 7 else 4
    options = {"schema": schema} if storage == "db3" else {}
    file = write_file(bag / f"bag_0.{storage}", truth.messages(), **options)
    write_metadata(bag, [file.name], truth.messages(), version=version)
    assert_read(read_one(bag), truth)


@pytest.mark.parametrize("plugin", StoragePlugin)
@pytest.mark.parametrize("mode", CompressionMode)
@pytest.mark.parametrize("version", [8, 9])
def test_bags_written_by_rosbags_are_read(tmp_path, plugin, mode, version):
    if plugin == StoragePlugin.SQLITE3 and mode == CompressionMode.STORAGE:
        pytest.skip("SQLite has no compression of its own")
    truth = motion()
    writer = Writer(tmp_path / "bag", version=version, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for sent in truth.messages():
            if sent.topic not in connections:
                connections[sent.topic] = writer.add_connection(
                    sent.topic, sent.type, typestore=TYPES
                )
            writer.write(connections[sent.topic], sent.stamp, sent.data)
    assert_read(read_records(tmp_path / "bag")["front_left"], truth)


def test_messages_are_read_when_qos_of_metadata_and_file_differ(tmp_path):
    truth, bag = motion(), tmp_path / "bag"
    write_file(bag / "bag_0.db3", truth.messages(), qos="- history: 3\n  depth: 0\n")
    write_metadata(bag, ["bag_0.db3"], truth.messages(), version=5, qos="- history: 1\n")
    assert_read(read_one(bag), truth)


def test_messages_in_sqlite_journal_are_read(tmp_path):
    truth = motion()
    messages = truth.messages()
    path = write_sqlite(tmp_path / "bag.db3", messages[:101])
    database = sqlite3.connect(path)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("PRAGMA wal_autocheckpoint=0")
    for sent in messages[101:]:
        database.execute(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES (2, ?, ?)",
            (sent.stamp, sent.data),
        )
    database.commit()
    # A killed recorder leaves the file and its journal, copied here while open.
    dead = tmp_path / "dead"
    dead.mkdir()
    for name in ("bag.db3", "bag.db3-wal"):
        shutil.copyfile(tmp_path / name, dead / name)
    database.close()
    before = (dead / "bag.db3").read_bytes()
    with warnings.catch_warnings(record=True) as left:  # of temporary folders left behind
        warnings.simplefilter("always")
        record = read_records(dead / "bag.db3")["front_left"]
        gc.collect()
    assert not [str(one.message) for one in left if one.category is ResourceWarning]
    assert_read(record, truth)
    assert "journal" in notes(record)
    assert (dead / "bag.db3").read_bytes() == before


def test_message_definition_of_matching_ros_distribution_is_used(tmp_path):
    # Range of Foxy has no field `variance`; the bag does not define it.
    whole = serialized(
        "sensor_msgs/msg/Range", header=header(START, "x"), radiation_type=0, field_of_view=1.0,
        min_range=0.0, max_range=9.0, range=0.5, variance=7.0,
    )  # fmt: skip
    sent = [
        Sent("/range", "sensor_msgs/msg/Range", START + k * 10_000_000, whole[:-4])
        for k in range(10)
    ]
    path = write_sqlite(tmp_path / "foxy.db3", sent, schema=2)
    topics = list_topics(path)[0].topics
    assert "range" in topics[0].fields
    assert "variance" not in topics[0].fields
    record = read_records(path, ["voltage=/range.range", "velocity=/range.max_range"])["motor"]
    assert set(record.voltage) == {0.5}


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.mcap", b"", "is empty"),
        ("a.mcap", b"\x89MCAP", "cut off"),
        ("a.mcap", b"hello world, this is no bag", "not a recording of a known format"),
        ("a.db3", b"SQLite format 3\0", "not a readable bag"),
        ("a.bag", b"#ROSBAG V1.2\n", "ROS 1 bag of version 'V1.2'"),
        ("a.db3.zstd", b"\x28\xb5\x2f\xfd\x00", "compression is cut off"),
        ("a.db3", b"SQLite format 3\0" + bytes(4080), "not a readable bag"),
    ],
)
def test_files_that_are_not_bags_are_refused_with_the_reason(tmp_path, name, content, reason):
    (tmp_path / name).write_bytes(content)
    assert_refused(reason, tmp_path / name)


@pytest.mark.parametrize("storage", ["mcap", "db3"])
def test_bag_without_topics_is_refused(tmp_path, storage):
    assert_refused("no topics at all", write_file(tmp_path / f"bag.{storage}", []))


def test_topic_without_messages_is_refused_by_name(tmp_path):
    path = write_sqlite(tmp_path / "bag.db3", motion(n=20).messages())
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM messages WHERE topic_id = 2")
    assert_refused("/front_left/motor_state has no messages", path)


def test_types_defined_as_idl_are_understood(tmp_path):
    text = (
        "module odd_msgs {\n module msg {\n  struct Speed {\n   string label;\n"
        '   sequence<double> values;\n   @unit(value="V")\n   float volts;\n  };\n };\n};\n'
    )
    line = "=" * 80 + "\nIDL: odd_msgs/msg/Speed\n"
    sent = [
        # Label "a", two values, four volts: aligned as CDR asks.
        Sent("/odd", "odd_msgs/msg/Speed", k * 10_000_000,
             struct.pack("<4sI2s2xI4xddf", b"\0\1\0\0", 2, b"a\0", 2, 0.5, float(k), 4.0))
        for k in range(20)
    ]  # fmt: skip
    path = tmp_path / "bag.mcap"
    write_mcap(path, sent, define=lambda _: line + text, encoding="ros2idl")
    record = read_one(path, "voltage=/odd.volts velocity=/odd.values[1]")
    assert record.velocity.tolist() == list(range(20))
    assert set(record.voltage) == {4.0}


def test_wheels_are_read_when_another_has_no_messages(tmp_path):
    silent = motion(n=20, wheel="rear_left").messages()
    spoken = motion(n=20).messages()
    path = write_sqlite(tmp_path / "bag.db3", spoken + silent)
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM messages WHERE topic_id = 4")
    records = read_records(path)
    assert set(records) == {"front_left"}
    assert "not read: bag.db3: rear_left" in notes(records["front_left"])


ZSTD = mcap.writer.CompressionType.ZSTD


@pytest.mark.parametrize(
    "options",
    [
        dict(),
        dict(compression=ZSTD),
        dict(use_chunking=False),
        dict(use_summary_offsets=False, use_statistics=True),
        dict(repeat_channels=False),
        dict(use_statistics=False),
        dict(index_types=mcap.writer.IndexType.NONE),
    ],
    ids=str,
)
def test_summary_equals_that_of_mcap_library(tmp_path, options):
    messages = merged(motion(n=100), motion(n=70, wheel="rear_right", seed=2))
    path = write_mcap(tmp_path / "bag.mcap", messages, **options)
    with path.open("rb") as file:
        found = read_summary(file)
        file.seek(0)
        theirs = SeekingReader(file).get_summary()
    complete = theirs.statistics is not None and len(theirs.channels) == 4
    assert (found is not None) == complete
    if found is not None:
        assert {key: tuple(fields) for key, *fields, _ in found[Opcode.SCHEMA]} == {
            s.id: (s.name, s.encoding, s.data) for s in theirs.schemas.values()
        }
        assert {key: tuple(fields) for key, *fields, _ in found[Opcode.CHANNEL]} == {
            c.id: (c.schema_id, c.topic, c.message_encoding, c.metadata)
            for c in theirs.channels.values()
        }
        assert found[Opcode.STATISTICS][-1][-2] == theirs.statistics.channel_message_counts
        assert {start: offsets for _, _, start, _, offsets, *_ in found[Opcode.CHUNK_INDEX]} == {
            c.chunk_start_offset: c.message_index_offsets for c in theirs.chunk_indexes
        }
    assert len(read_records(path)["rear_right"]) == 70


def test_damage_to_any_byte_of_the_summary_loses_no_message_silently(tmp_path):
    path = write_mcap(tmp_path / "bag.mcap", motion(n=60).messages(), define=lambda _: "")
    whole = path.read_bytes()
    (begin,) = struct.unpack_from("<Q", whole, len(whole) - 28)  # the footer's summary_start
    for at in range(begin, len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x41]) + whole[at + 1 :])
        try:
            record = read_records(path)["front_left"]
        except BagError as error:
            told = str(error)
        else:
            told = " ".join(finding.message for finding in record.findings)
            if len(record) == 60:
                continue
        assert path.name in told, at


def test_compressed_bags_are_read_without_the_package_mcap(tmp_path):
    path = write_mcap(tmp_path / "bag.mcap", motion(n=60).messages(), compression=ZSTD)
    program = (
        "import sys\nsys.modules['mcap'] = sys.modules['zstandard'] = None\n"
        "from smp_motor_ident.bag import read_records\n"
        "assert len(read_records(sys.argv[1])['front_left']) == 60\n"
    )
    subprocess.run([sys.executable, "-c", program, str(path)], check=True)
