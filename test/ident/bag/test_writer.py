# SPDX-License-Identifier: Apache-2.0
"""Bags of the writer are valid for ros2 bag and rosbags at any time."""

import threading
import tracemalloc

import pytest
import yaml
from mcap.reader import make_reader
from recordings import TYPES, Sent, assert_read, motion, serialized, write_mcap, write_sqlite
from rosbags.highlevel import AnyReader

from smp_motor_ident.bag import BagWriter, read_records
from smp_motor_ident.errors import BagError
from smp_motor_ident.nodes.play import Replay, find_offered_qos

FLOAT = "std_msgs/msg/Float64"


def float_bytes(value: float) -> bytes:
    data: bytes = serialized(FLOAT, data=value)
    return data


def test_metadata_have_format_version_nine(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/b", FLOAT, [{"reliability": "best_effort", "depth": 7}])
        bag.write("/a", FLOAT, float_bytes(1.0), 1_000)
        bag.write("/b", FLOAT, float_bytes(2.0), 3_000)
        bag.write("/b", FLOAT, float_bytes(2.0), 2_000)
    document = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    information = document["rosbag2_bagfile_information"]
    assert information["version"] == 9
    assert information["storage_identifier"] == "mcap"
    assert information["message_count"] == 3
    assert information["duration"]["nanoseconds"] == 2_000
    assert information["starting_time"]["nanoseconds_since_epoch"] == 1_000
    assert information["relative_file_paths"] == ["bag_0.mcap"]
    assert information["files"][0]["message_count"] == 3
    assert information["ros_distro"] == "jazzy"
    topics = {
        entry["topic_metadata"]["name"]: entry for entry in information["topics_with_message_count"]
    }
    assert topics["/b"]["message_count"] == 2
    qos = topics["/b"]["topic_metadata"]["offered_qos_profiles"][0]
    assert (qos["reliability"], qos["depth"], qos["history"]) == ("best_effort", 7, "keep_last")
    # The hash of REP 2011 that ROS 2 Jazzy itself computes for std_msgs/msg/Float64.
    expected = TYPES.hash_rihs01(FLOAT)
    assert topics["/a"]["topic_metadata"]["type_description_hash"] == expected


def test_index_and_checksums_are_accepted_by_mcap_library(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(100):
            bag.write("/a", FLOAT, float_bytes(k), 1_000 + k)
            if k % 10 == 0:
                bag.flush(force=True)
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary.statistics.message_count == 100
        assert len(summary.chunk_indexes) == summary.statistics.chunk_count >= 10
        data = [message.data for _, _, message in reader.iter_messages()]
    assert data == [float_bytes(k) for k in range(100)]
    schema = next(iter(summary.schemas.values()))
    assert (schema.name, schema.encoding) == (FLOAT, "ros2msg")
    assert b"float64 data" in schema.data


def test_bag_is_complete_after_every_flush(tmp_path):
    bag = BagWriter(tmp_path / "bag")
    for k in range(30):
        bag.write(f"/t{k % 3}", FLOAT, float_bytes(k), 1_000 + k)
        if k % 7 == 0:
            bag.flush(force=True)
            with AnyReader([tmp_path / "bag"]) as reader:
                assert sum(1 for _ in reader.messages()) == k + 1
                assert reader.message_count == k + 1
    bag.close()
    bag.close()
    with pytest.raises(BagError, match="is closed"):
        bag.write("/t0", FLOAT, b"", 1)


def test_a_bag_is_never_overwritten(tmp_path):
    with BagWriter(tmp_path / "bag"):
        pass
    with pytest.raises(BagError, match="exists already"):
        BagWriter(tmp_path / "bag")
    (tmp_path / "file").write_text("")
    with pytest.raises(BagError, match="cannot be made"):
        BagWriter(tmp_path / "file" / "bag")


def test_bag_without_messages_is_readable(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/a", FLOAT)
    with AnyReader([tmp_path / "bag"]) as reader:
        assert [c.topic for c in reader.connections] == ["/a"]
        assert list(reader.messages()) == []
    assert list(Replay(tmp_path / "bag").messages()) == []


def test_messages_of_unknown_type_are_written_without_definition(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        assert not bag.add_topic("/odd", "strange_msgs/msg/Thing")
        assert bag.add_topic("/a", FLOAT)
        bag.write("/odd", "strange_msgs/msg/Thing", b"12345678", 1)
    assert [data for _, _, data in Replay(tmp_path / "bag").messages()] == [b"12345678"]


def test_concurrent_writes_lose_no_message(tmp_path):
    data = float_bytes(1.0)
    with BagWriter(tmp_path / "bag", flush_period=0.001) as bag:

        def write(topic: str) -> None:
            for k in range(500):
                bag.write(topic, FLOAT, data, 1_000 + k)

        threads = [threading.Thread(target=write, args=(f"/t{k}",)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert bag.counts == {f"/t{k}": 500 for k in range(4)}
    with AnyReader([tmp_path / "bag"]) as reader:
        assert sum(1 for _ in reader.messages()) == 2000


def test_replay_orders_messages_within_and_across_chunks(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(200):
            # Within a chunk of ten, and from chunk to chunk, stamps come a little out of order.
            stamp = 1_000 + k + (5 if k % 5 == 0 else 0)
            bag.write(f"/t{k % 2}", FLOAT, float_bytes(k), stamp)
            if k % 10 == 9:
                bag.flush(force=True)
    stamps = [stamp for _, stamp, _ in Replay(tmp_path / "bag").messages()]
    assert len(stamps) == 200
    assert stamps == sorted(stamps)


@pytest.mark.parametrize(
    ("qos", "expected"),
    [
        ("", (True, False)),
        ("- reliability: 2\n  durability: 2\n", (False, False)),
        ("- reliability: best_effort\n  durability: transient_local\n", (False, True)),
        ("- {reliability: 1, durability: 1}\n- {reliability: 2, durability: 2}\n", (True, True)),
        (":\n - {", (True, False)),
        ("17", (True, False)),
    ],
)
def test_recorded_qos_of_every_version_is_understood(qos, expected):
    from smp_motor_ident.bag.storage import Channel

    assert find_offered_qos(Channel(1, "/a", FLOAT, qos=qos)) == expected


@pytest.mark.parametrize("storage", ["mcap", "db3"])
def test_unmapped_topics_are_not_loaded_into_memory(tmp_path, storage):
    truth = motion(n=500)
    image = bytes(200_000)
    images = [
        Sent("/camera", "std_msgs/msg/UInt8MultiArray", int(t), image) for t in truth.time[::5]
    ]
    messages = sorted(truth.messages() + images, key=lambda sent: sent.stamp)
    if storage == "mcap":
        path = write_mcap(tmp_path / "bag.mcap", messages, chunk_size=1 << 20)
    else:
        path = write_sqlite(tmp_path / "bag.db3", messages)
    assert path.stat().st_size > 20_000_000
    read_records(path)  # load modules before measuring
    tracemalloc.start()
    record = read_records(path)["front_left"]
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert_read(record, truth)
    # A few chunks of 1 MB at a time, of twenty.
    assert peak < 6_000_000
