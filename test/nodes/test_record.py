# SPDX-License-Identifier: Apache-2.0
"""record and play as processes: every message is kept, and sent as recorded at its time."""

import re
import signal
import time
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from recordings import Sent, write_mcap
from rosbags.rosbag2 import Reader
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64, String
from wheel_robot import spinning

from smp_interfaces.msg import MotorDescription, MotorState
from smp_motor_control import WHEELS
from smp_motor_ident.bag import BagWriter, read_records
from smp_motor_ident.errors import BagError

BEGIN = time.time_ns()
RELIABLE = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(
    depth=5, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


def state(number: int) -> MotorState:
    message = MotorState()
    # The instant of sampling, 1 ms apart however late a busy machine publishes.
    stamp = BEGIN + number * 10**6
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    message.header.frame_id = "x_wheel_joint"
    message.voltage, message.velocity, message.encoder_count = 0.01 * number, 1.0, number
    return message


def raw(message: Any) -> bytes:
    """Serialize as DDS delivers it: in whole words (a string may end in the middle of one)."""
    data = bytes(serialize_message(message))
    return data + bytes(-len(data) % 4)


def so_far(bag: Path) -> dict[str, list[bytes]]:
    """Read a bag that is being written; its end may be torn in the middle of a write."""
    try:
        return contents(bag)
    except Exception:  # any error of a reader in a torn file: look again
        return {}


def all_states(found: dict[str, list[bytes]]) -> list[int]:
    """Count each wheel's messages; the bag also holds log messages of nodes."""
    return [len(found.get(f"/{wheel}/motor_state", [])) for wheel in WHEELS]


def contents(bag: Path) -> dict[str, list[bytes]]:
    """Read a bag with rosbags."""
    found: dict[str, list[bytes]] = {}
    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            found.setdefault(connection.topic, []).append(bytes(data))
    return found


def publish_steadily(publishers, count, rate, make=state):
    """Publish at a rate; catch up after delays, and skip nothing."""
    sent = []
    begin = time.monotonic()
    for k in range(count):
        time.sleep(max(0.0, begin + k / rate - time.monotonic()))
        data = raw(make(k))
        sent.append(data)
        for publisher in publishers:
            publisher.publish(data)  # padding bytes between aligned fields are random
    return sent


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_message_of_four_wheels_at_1_khz_is_lost(node, process, eventually, tmp_path, ending):
    bag = tmp_path / "bag"
    publishers = [node.create_publisher(MotorState, f"/{w}/motor_state", RELIABLE) for w in WHEELS]
    recorder = process("record", "--output", bag)
    eventually(lambda: all(p.get_subscription_count() for p in publishers), deadline=20.0)
    sent = publish_steadily(publishers, 2000, 1000.0)
    if ending == signal.SIGKILL:
        # A kill loses at most the messages since the last flush, half a second.
        eventually(lambda: all_states(so_far(bag)) == [2000] * 4, deadline=10.0, message="flush")
    else:
        for publisher in publishers:
            publisher.wait_for_all_acked()
    recorder.send_signal(ending)
    code = recorder.wait(5.0)
    found = contents(bag)
    for wheel in WHEELS:
        assert found[f"/{wheel}/motor_state"] == sent
    if ending != signal.SIGKILL:
        assert code == 0
        assert "2000  /rear_right/motor_state" in recorder.output
        assert "lost" not in recorder.output
    records = read_records(bag)
    assert all(len(records[wheel]) == 2000 for wheel in WHEELS)
    assert not any("missing" in f.message for f in records["front_left"].findings)


def test_best_effort_messages_are_recorded_or_reported_as_lost(node, process, eventually, tmp_path):
    bag = tmp_path / "bag"
    names = [f"/{wheel}/motor_state" for wheel in WHEELS]
    publishers = [node.create_publisher(MotorState, name, BEST_EFFORT) for name in names]
    recorder = process("record", "--output", bag)
    eventually(lambda: all(p.get_subscription_count() for p in publishers), deadline=20.0)
    sent = publish_steadily(publishers, 1000, 250.0)
    # Best effort has no acknowledgement: the bag is complete when it stops growing.
    seen: list[int] = []

    def at_rest() -> bool:
        seen.append(sum(all_states(so_far(bag))))
        return len(seen) > 5 and 0 < seen[-1] == seen[-5]

    # Looks 0.2 s apart, so that four of them are longer than from flush to flush.
    eventually(at_rest, deadline=20.0, step=lambda: time.sleep(0.2))
    recorder.interrupt()
    assert recorder.wait(5.0) == 0
    found = contents(bag)
    for name in names:
        places = [sent.index(data) for data in found[name]]
        assert places == sorted(set(places))
        # The kernel buffers some hundred messages for a suspended process: half a second of
        # suspension may lose as many.
        assert len(places) > 850
        lost = places[-1] - places[0] + 1 - len(places)
        said = re.search(rf"{name}  \((\d+) lost\)", recorder.output)
        assert lost == (int(said[1]) if said else 0)


def test_late_latched_and_mixed_publishers_are_recorded(node, process, eventually, tmp_path):
    bag = tmp_path / "bag"
    description = node.create_publisher(MotorDescription, "/w/motor_description", LATCHED)
    description.publish(MotorDescription(joint_name="early", gear_ratio=65.5))
    recorder = process("record", "-o", bag)
    eventually(lambda: description.get_subscription_count() > 0, deadline=20.0)
    late = node.create_publisher(Float64, "/late", BEST_EFFORT)
    # A second, reliable publisher of a topic taken best effort changes nothing; a best effort one
    # in addition to a reliable one makes the recorder request best effort.
    mixed = [node.create_publisher(Float64, "/mixed", RELIABLE)]
    eventually(lambda: mixed[0].get_subscription_count() > 0)
    mixed.append(node.create_publisher(Float64, "/mixed", BEST_EFFORT))
    marks = {}
    for publisher in (late, *mixed):
        mark = Float64(data=-1.0 - len(marks))
        marks[raw(mark)] = publisher
        eventually(
            lambda mark=mark: raw(mark) in chain(*so_far(bag).values()),
            step=lambda p=publisher, m=mark: publish_steadily([p], 5, 50.0, lambda _: m),
        )
    sent = publish_steadily([late], 20, 200.0, lambda k: Float64(data=float(k)))
    both = [publish_steadily([p], 5, 200.0, lambda k: Float64(data=float(k))) for p in mixed]

    def found(topic: str) -> list[bytes]:
        return [data for data in so_far(bag).get(topic, []) if data not in marks]

    eventually(lambda: len(found("/mixed")) == 10)
    recorder.interrupt()
    assert recorder.wait(5.0) == 0
    assert len(found("/w/motor_description")) == 1
    assert found("/late") == sent
    assert sorted(found("/mixed")) == sorted(both[0] + both[1])


def test_topics_are_chosen_by_name_and_pattern(node, process, eventually, tmp_path):
    names = ("/a/x", "/a/y", "/b/x", "/c")
    publishers = {name: node.create_publisher(Float64, name, LATCHED) for name in names}
    for publisher in publishers.values():
        publisher.publish(Float64(data=1.0))
    bag = tmp_path / "bag"
    recorder = process("record", "-o", bag, "c", "--regex", "/./x", "--exclude", "/b/.*")
    eventually(lambda: {"/a/x", "/c"} <= set(so_far(bag)), 20.0)
    recorder.interrupt()
    assert recorder.wait(5.0) == 0
    assert set(contents(bag)) == {"/a/x", "/c"}


def test_only_a_bag_is_overwritten_and_only_with_force(process, eventually, tmp_path):
    bag, folder = tmp_path / "bag", tmp_path / "folder"
    with BagWriter(bag) as writer:
        writer.write("/old", "std_msgs/msg/Float64", bytes(12), 1)
    folder.mkdir()
    (folder / "thesis.txt").write_text("important")
    for arguments, reason in (
        (("-o", bag), "exists already"),
        (("-o", folder, "--force"), "is not a bag"),
        (("-o", bag, "--regex", "("), "not a regular expression"),
    ):
        refused = process("record", *arguments)
        assert refused.wait(20.0) == 2
        assert reason in refused.output
        assert "Traceback" not in refused.output
    assert set(contents(bag)) == {"/old"}
    assert (folder / "thesis.txt").exists()
    recorder = process("record", "-o", bag, "--force")
    eventually(lambda: "recording to" in recorder.output, deadline=20.0)
    recorder.interrupt()
    assert recorder.wait(5.0) == 0
    assert "/old" not in contents(bag)


def test_message_with_wrong_type_for_its_topic_is_refused(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write("/number", "std_msgs/msg/Float64", raw(Float64(data=4.0)), 1_000)
        with pytest.raises(BagError, match="is of the type std_msgs/msg/Float64, not"):
            bag.write("/number", "std_msgs/msg/String", raw(String(data="four")), 2_000)
        assert bag.counts == {"/number": 1}


# A DDS participant whose first announcement is lost repeats it after 3 s.
DISCOVERY_DELAY = ("--delay", "5")


Process = Callable[..., Any]


def write_bag(path: Path, count: int = 100, step: int = 10_000_000) -> dict[str, list[bytes]]:
    """Write a bag of two topics, of a size that differs from message to message."""
    written: dict[str, list[bytes]] = {"/number": [], "/text": []}
    start = 1_700_000_000 * 10**9
    with BagWriter(path) as bag:
        for k in range(count):
            for topic, kind, message in (
                ("/number", "std_msgs/msg/Float64", Float64(data=k / 7)),
                ("/text", "std_msgs/msg/String", String(data="x" * (k % 50))),
            ):
                data = raw(message)
                written[topic].append(data)
                bag.write(topic, kind, data, start + k * step)
            if k % 10 == 0:
                bag.flush(force=True)  # several chunks
    return written


class Listener:
    """Receives raw topics, with the time of each message."""

    def __init__(self, node: Node, topics: dict[str, Any]) -> None:
        self.data: dict[str, list[bytes]] = {name: [] for name in topics}
        self.times: dict[str, list[float]] = {name: [] for name in topics}
        for name, kind in topics.items():
            node.create_subscription(kind, name, self._taker(name), RELIABLE, raw=True)

    def _taker(self, name: str) -> Callable[[bytes], None]:
        def take(data: bytes) -> None:
            self.times[name].append(time.monotonic())
            self.data[name].append(data)

        return take


@pytest.fixture
def listener(node: Node) -> Iterator[Listener]:
    made = Listener(node, {"/number": Float64, "/text": String, "/clock": Clock})
    with spinning(node.spin):  # type: ignore[attr-defined]
        yield made


def test_play_reproduces_bytes_and_times(process, listener, eventually, tmp_path):
    written = write_bag(tmp_path / "bag")
    recorder = process("record", "-o", tmp_path / "again", "--regex", "/number|/text")
    eventually(lambda: "recording to" in recorder.output, deadline=20.0)
    player = process("play", tmp_path / "bag", *DISCOVERY_DELAY)
    assert player.wait(30.0) == 0
    assert listener.data == {**written, "/clock": []}
    times = listener.times["/number"]
    # 100 messages 10 ms apart; a loaded machine delays the first or the last a little.
    assert times[-1] - times[0] == pytest.approx(0.99, abs=0.3)
    assert "200  messages sent" in player.output
    eventually(lambda: sum(map(len, so_far(tmp_path / "again").values())) >= 200)
    recorder.interrupt()
    assert recorder.wait(5.0) == 0
    assert contents(tmp_path / "again") == written


def test_play_supports_rate_offset_clock_and_topics(process, listener, tmp_path):
    written = write_bag(tmp_path / "bag")
    arguments = ("--rate", "0.5", "--start-offset", "0.5", "--clock", "100", "--topics", "number")
    arguments += DISCOVERY_DELAY
    player = process("play", tmp_path / "bag", *arguments)
    assert player.wait(30.0) == 0
    assert listener.data["/number"] == written["/number"][50:]
    assert listener.data["/text"] == []
    times = listener.times["/number"]
    assert times[-1] - times[0] == pytest.approx(0.98, abs=0.3)
    # 0.98 s at 100 Hz; a loaded machine may skip some.
    assert 40 <= len(listener.data["/clock"]) <= 110


def test_play_loops_until_it_is_interrupted(process, listener, eventually, tmp_path):
    written = write_bag(tmp_path / "bag", count=10)
    player = process("play", tmp_path / "bag", "--loop", "--rate", "2", *DISCOVERY_DELAY)
    eventually(lambda: len(listener.data["/number"]) >= 25, deadline=20.0)
    player.interrupt()
    assert player.wait(3.0) == 0
    assert listener.data["/number"][:20] == written["/number"] * 2


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("nothing",), "does not exist"),
        (("bag", "--topics", "/other"), "has no topic /other; it has /number, /text"),
        (("bag", "--rate", "0"), "--rate is 0"),
        (("bag", "--rate", "nan"), "--rate is nan"),
        (("bag", "--start-offset", "99"), "no message behind an offset of 99 s"),
        (("bag", "--fast"), "unrecognized arguments"),
    ],
)
def test_play_refuses_invalid_arguments_in_one_line(process, tmp_path, arguments, reason):
    write_bag(tmp_path / "bag", count=3)
    player = process("play", *arguments)
    assert player.wait(20.0) == 2
    assert reason in player.output
    assert "Traceback" not in player.output


def test_play_reports_types_that_it_skips(process, listener, eventually, tmp_path):
    sent = [
        Sent("/odd", "strange_msgs/msg/Thing", 1_000, bytes(8)),
        Sent("/number", "std_msgs/msg/Float64", 1_001, raw(Float64(data=4.0))),
        Sent("/number", "std_msgs/msg/String", 1_002, raw(String(data="four"))),
    ]
    bag = write_mcap(tmp_path / "odd.mcap", sent, define=lambda _: "")
    player = process("play", bag, *DISCOVERY_DELAY)
    assert player.wait(20.0) == 0
    assert "/odd is not played: its type strange_msgs/msg/Thing is not installed" in player.output
    assert "/number: its messages of type std_msgs/msg/String are not played" in player.output
    eventually(lambda: len(listener.data["/number"]) == 1, deadline=2.0)
