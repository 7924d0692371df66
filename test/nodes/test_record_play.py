"""record and play as processes: nothing lost, nothing changed, whatever ends them."""

from __future__ import annotations

import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mcap.writer
import pytest

rclpy = pytest.importorskip("rclpy")

from rclpy.context import Context  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy  # noqa: E402
from rclpy.serialization import serialize_message  # noqa: E402
from rosbags.rosbag2 import Reader  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from std_msgs.msg import Float64, String  # noqa: E402

from smp_interfaces.msg import MotorDescription, MotorState  # noqa: E402
from smp_motor_ident.bag import BagWriter, read_records  # noqa: E402
from smp_motor_ident.errors import BagError  # noqa: E402

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
BEGIN = time.time_ns()
# Where the first word of a DDS participant is lost, its next follows after 3 s.
UNHURRIED = ("--delay", "5")
RELIABLE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(
    depth=5,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


@pytest.fixture
def node(ros_domain: int) -> Iterator[Node]:
    context = Context()
    rclpy.init(context=context, domain_id=ros_domain)
    made = rclpy.create_node("tester", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(made)
    made.spin = lambda: executor.spin_once(timeout_sec=0.01)  # type: ignore[attr-defined]
    yield made
    executor.shutdown()
    made.destroy_node()
    rclpy.shutdown(context=context)


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
    """Read a bag that is being written; in the middle of a write its end may be of two flushes."""
    try:
        return contents(bag)
    except Exception:  # whatever a reader stumbles over in a torn file: look again
        return {}


def all_states(found: dict[str, list[bytes]]) -> list[int]:
    """Count each wheel's messages; the bag also holds what nodes log."""
    return [len(found.get(f"/{wheel}/motor_state", [])) for wheel in WHEELS]


def contents(bag: Path) -> dict[str, list[bytes]]:
    """Read a bag with rosbags."""
    found: dict[str, list[bytes]] = {}
    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            found.setdefault(connection.topic, []).append(bytes(data))
    return found


def publish_steadily(
    publishers: list[Any], count: int, rate: float, make: Callable[[int], Any] = state
) -> list[bytes]:
    """Publish at a rate; what is late is made up for, nothing is left out."""
    sent = []
    begin = time.monotonic()
    for k in range(count):
        while time.monotonic() < begin + k / rate:
            time.sleep(0.0002)
        data = raw(make(k))
        sent.append(data)
        for publisher in publishers:
            publisher.publish(data)  # the bytes that lie between aligned fields are random
    return sent


@pytest.mark.parametrize(
    ("ending", "qos"),
    [
        (signal.SIGINT, RELIABLE),
        (signal.SIGTERM, RELIABLE),
        (signal.SIGKILL, RELIABLE),
    ],
)
def test_four_wheels_at_a_kilohertz_are_recorded_without_a_lost_message(
    node: Node,
    process: Callable[..., Any],
    eventually: Callable[..., None],
    tmp_path: Path,
    ending: signal.Signals,
    qos: QoSProfile,
) -> None:
    bag = tmp_path / "bag"
    publishers = [node.create_publisher(MotorState, f"/{w}/motor_state", qos) for w in WHEELS]
    recorder = process("record", "--output", bag)
    eventually(lambda: all(p.get_subscription_count() for p in publishers), deadline=20.0)
    sent = publish_steadily(publishers, 2000, 1000.0)
    if ending == signal.SIGKILL:
        # What a kill may cost is what came since the last flush, half a second ago at most.
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
    assert not any("missing" in note for note in records["front_left"].notes)


def test_best_effort_messages_are_recorded_or_told_as_lost(
    node: Node, process: Callable[..., Any], eventually: Callable[..., None], tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    names = [f"/{wheel}/motor_state" for wheel in WHEELS]
    publishers = [node.create_publisher(MotorState, name, BEST_EFFORT) for name in names]
    recorder = process("record", "--output", bag)
    eventually(lambda: all(p.get_subscription_count() for p in publishers), deadline=20.0)
    sent = publish_steadily(publishers, 2000, 1000.0)
    # Nobody acknowledges best effort: it is all there when no more comes.
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
        # The kernel of DDS holds some hundred messages for a process that does not run: a machine
        # that stands still for a tenth of a second may lose as many.
        assert len(places) > 1700
        lost = places[-1] - places[0] + 1 - len(places)
        told = re.search(rf"{name}  \((\d+) lost\)", recorder.output)
        assert lost == (int(told[1]) if told else 0)


def test_late_publishers_latched_ones_and_mixed_qos_are_recorded(
    node: Node, process: Callable[..., Any], eventually: Callable[..., None], tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    description = node.create_publisher(MotorDescription, "/w/motor_description", LATCHED)
    description.publish(MotorDescription(joint_name="early", gear_ratio=65.5))
    recorder = process("record", "-o", bag)
    eventually(lambda: description.get_subscription_count() > 0, deadline=20.0)
    late = node.create_publisher(Float64, "/late", BEST_EFFORT)
    eventually(lambda: late.get_subscription_count() > 0)
    sent = publish_steadily([late], 20, 200.0, lambda k: Float64(data=float(k)))
    # A second, reliable publisher of a topic that is taken best effort changes nothing; a best
    # effort one beside a reliable one makes the recorder ask for less.
    mixed = [node.create_publisher(Float64, "/mixed", RELIABLE)]
    eventually(lambda: mixed[0].get_subscription_count() > 0)
    mixed.append(node.create_publisher(Float64, "/mixed", BEST_EFFORT))
    eventually(lambda: all(p.get_subscription_count() for p in mixed))
    both = [publish_steadily([p], 5, 200.0, lambda k: Float64(data=float(k))) for p in mixed]
    eventually(lambda: len(so_far(bag).get("/mixed", [])) == 10)
    recorder.interrupt()
    assert recorder.wait(5.0) == 0
    found = contents(bag)
    assert len(found["/w/motor_description"]) == 1
    assert found["/late"] == sent
    assert sorted(found["/mixed"]) == sorted(both[0] + both[1])


def test_topics_are_chosen_by_name_and_pattern(
    node: Node, process: Callable[..., Any], eventually: Callable[..., None], tmp_path: Path
) -> None:
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


def test_a_bag_is_replaced_only_by_force_and_nothing_else_ever(
    process: Callable[..., Any], eventually: Callable[..., None], tmp_path: Path
) -> None:
    bag, folder = tmp_path / "bag", tmp_path / "folder"
    with BagWriter(bag) as writer:
        writer.write("/old", "std_msgs/msg/Float64", bytes(12), 1)
    folder.mkdir()
    (folder / "thesis.txt").write_text("important")
    for arguments, reason in (
        (("-o", bag), "exists already"),
        (("-o", folder, "--force"), "is no bag"),
        (("-o", bag, "--regex", "("), "no regular expression"),
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
    """Takes topics raw in a thread of its own, with the time of each message."""

    def __init__(self, node: Node, topics: dict[str, Any]) -> None:
        self.data: dict[str, list[bytes]] = {name: [] for name in topics}
        self.times: dict[str, list[float]] = {name: [] for name in topics}
        for name, kind in topics.items():
            node.create_subscription(kind, name, self._taker(name), RELIABLE, raw=True)
        self._node, self._over = node, threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _taker(self, name: str) -> Callable[[bytes], None]:
        def take(data: bytes) -> None:
            self.times[name].append(time.monotonic())
            self.data[name].append(data)

        return take

    def _spin(self) -> None:
        while not self._over.is_set():
            self._node.spin()  # type: ignore[attr-defined]

    def close(self) -> None:
        self._over.set()
        self._thread.join()


@pytest.fixture
def listener(node: Node) -> Iterator[Listener]:
    made = Listener(node, {"/number": Float64, "/text": String, "/clock": Clock})
    yield made
    made.close()


def test_play_sends_byte_for_byte_what_was_recorded_in_its_own_time(
    process: Callable[..., Any], listener: Listener, tmp_path: Path
) -> None:
    written = write_bag(tmp_path / "bag")
    player = process("play", tmp_path / "bag")
    assert player.wait(30.0) == 0
    assert listener.data["/number"] == written["/number"]
    assert listener.data["/text"] == written["/text"]
    assert listener.data["/clock"] == []
    times = listener.times["/number"]
    # 100 messages 10 ms apart; a loaded machine delays the first or the last a little.
    assert times[-1] - times[0] == pytest.approx(0.99, abs=0.3)
    assert "200  messages sent" in player.output


def test_play_goes_faster_from_an_offset_with_a_clock_and_chosen_topics(
    process: Callable[..., Any], listener: Listener, tmp_path: Path
) -> None:
    written = write_bag(tmp_path / "bag")
    arguments = ("--rate", "0.5", "--start-offset", "0.5", "--clock", "100", "--topics", "number")
    arguments += UNHURRIED
    player = process("play", tmp_path / "bag", *arguments)
    assert player.wait(30.0) == 0
    assert listener.data["/number"] == written["/number"][50:]
    assert listener.data["/text"] == []
    times = listener.times["/number"]
    assert times[-1] - times[0] == pytest.approx(0.98, abs=0.3)
    # 0.98 s at 100 Hz, of which a loaded machine may skip some.
    assert 40 <= len(listener.data["/clock"]) <= 110


def test_play_loops_until_it_is_interrupted(
    process: Callable[..., Any],
    listener: Listener,
    eventually: Callable[..., None],
    tmp_path: Path,
) -> None:
    written = write_bag(tmp_path / "bag", count=10)
    player = process("play", tmp_path / "bag", "--loop", "--rate", "2", *UNHURRIED)
    eventually(lambda: len(listener.data["/number"]) >= 25, deadline=20.0)
    player.interrupt()
    assert player.wait(3.0) == 0
    assert listener.data["/number"][:20] == written["/number"] * 2


def test_what_is_recorded_while_playing_is_the_same_bag(
    process: Callable[..., Any], eventually: Callable[..., None], tmp_path: Path
) -> None:
    written = write_bag(tmp_path / "bag")
    recorder = process("record", "-o", tmp_path / "again", "--regex", "/number|/text")
    eventually(lambda: "recording to" in recorder.output, deadline=20.0)
    player = process("play", tmp_path / "bag", *UNHURRIED)
    assert player.wait(30.0) == 0
    eventually(lambda: sum(map(len, so_far(tmp_path / "again").values())) >= 200)
    recorder.interrupt()
    assert recorder.wait(5.0) == 0
    assert contents(tmp_path / "again") == written


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
def test_play_refuses_what_it_cannot_do_in_one_line(
    process: Callable[..., Any], tmp_path: Path, arguments: tuple[str, ...], reason: str
) -> None:
    write_bag(tmp_path / "bag", count=3)
    player = process("play", *arguments)
    assert player.wait(20.0) == 2
    assert reason in player.output
    assert "Traceback" not in player.output


def test_topics_of_unknown_types_are_told_and_the_others_played(
    process: Callable[..., Any],
    listener: Listener,
    eventually: Callable[..., None],
    tmp_path: Path,
) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.write("/odd", "strange_msgs/msg/Thing", bytes(8), 1_000)
        bag.write("/number", "std_msgs/msg/Float64", raw(Float64(data=4.0)), 2_000)
    player = process("play", tmp_path / "bag")
    assert player.wait(20.0) == 0
    assert "/odd is not played: its type strange_msgs/msg/Thing is not installed" in player.output
    eventually(lambda: len(listener.data["/number"]) == 1, deadline=2.0)


def test_topic_with_two_types_is_played_with_one_and_the_other_told(
    process: Callable[..., Any],
    listener: Listener,
    eventually: Callable[..., None],
    tmp_path: Path,
) -> None:
    bag = tmp_path / "two.mcap"
    with bag.open("wb") as file:
        writer = mcap.writer.Writer(file)
        writer.start(profile="ros2")
        for stamp, message in ((1_000, Float64(data=4.0)), (2_000, String(data="four"))):
            name = f"std_msgs/msg/{type(message).__name__}"
            schema = writer.register_schema(name, "ros2msg", b"")
            channel = writer.register_channel("/number", "cdr", schema)
            writer.add_message(channel, stamp, raw(message), stamp)
        writer.finish()
    player = process("play", bag)
    assert player.wait(20.0) == 0
    assert "/number: its messages of type std_msgs/msg/String are not played" in player.output
    eventually(lambda: len(listener.data["/number"]) == 1, deadline=2.0)


def test_message_of_another_type_than_its_topic_is_not_written(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.write("/number", "std_msgs/msg/Float64", raw(Float64(data=4.0)), 1_000)
        with pytest.raises(BagError, match="is of the type std_msgs/msg/Float64, not"):
            bag.write("/number", "std_msgs/msg/String", raw(String(data="four")), 2_000)
        assert bag.counts == {"/number": 1}
