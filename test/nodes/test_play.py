# SPDX-License-Identifier: Apache-2.0
"""play as a process: it sends exactly the recorded messages, at their times."""

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mcap.writer
import pytest
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64, String
from traffic import RELIABLE, contents, raw, so_far

from smp_motor_ident.bag import BagWriter

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
    """Receives raw topics in its own thread, with the time of each message."""

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
    bag = tmp_path / "odd.mcap"
    with bag.open("wb") as file:
        writer = mcap.writer.Writer(file)
        writer.start(profile="ros2")
        for stamp, (topic, kind, data) in enumerate(
            (
                ("/odd", "strange_msgs/msg/Thing", bytes(8)),
                ("/number", "std_msgs/msg/Float64", raw(Float64(data=4.0))),
                ("/number", "std_msgs/msg/String", raw(String(data="four"))),
            ),
            start=1_000,
        ):
            schema = writer.register_schema(kind, "ros2msg", b"")
            channel = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    player = process("play", bag, *DISCOVERY_DELAY)
    assert player.wait(20.0) == 0
    assert "/odd is not played: its type strange_msgs/msg/Thing is not installed" in player.output
    assert "/number: its messages of type std_msgs/msg/String are not played" in player.output
    eventually(lambda: len(listener.data["/number"]) == 1, deadline=2.0)
