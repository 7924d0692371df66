# SPDX-License-Identifier: Apache-2.0
"""play: publish a bag's messages again, byte for byte and at their times."""

import argparse
import math
import sys
import threading
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

import yaml
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

from smp_motor_control.entry import split_arguments
from smp_motor_control.errors import SmpError
from smp_motor_control.nodes import runtime
from smp_motor_ident.bag.source import find_recordings
from smp_motor_ident.bag.storage import Batch, Channel
from smp_motor_ident.bag.unpack import decompress_messages
from smp_motor_ident.errors import BagError
from smp_motor_ident.nodes.bag_arguments import message_class, quality

Entry = tuple[int, Batch, int]


class Replay:
    """The messages of one bag: a folder or a bare file."""

    def __init__(self, path: Path) -> None:
        found = find_recordings(path)
        if len(found) > 1:
            names = ", ".join(recording.name for recording in found)
            raise BagError(f"{path}: holds several bags ({names}); name one")
        self._recording = found[0]
        if self._recording.is_table:
            raise BagError(f"{path}: is a table, not a bag")
        channels = self._recording.channels()
        self.channels = list({(c.topic, c.type): c for c in channels}.values())
        self.findings = self._recording.findings  # missing or damaged parts

    def messages(
        self, wanted: Callable[[Channel], bool] = lambda _: True
    ) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield channel, log time [ns] and data in the order of the log times, chunk by chunk.

        Where chunks overlap by more than one, a late message comes late.
        """

        waiting: list[Entry] = []
        self._recording.findings.clear()
        for together in self._recording.batches(wanted):
            plain = [decompress_messages(packed, self._recording.budget)[0] for packed in together]
            fresh = [
                (t, batch, k) for batch in plain for k, t in enumerate(batch.log_time.tolist())
            ]
            begin = min((time for time, _, _ in fresh), default=-math.inf)
            due = bisect_right(waiting, begin, key=itemgetter(0))
            yield from map(_read_message, waiting[:due])
            waiting = sorted(waiting[due:] + fresh, key=itemgetter(0))
        yield from map(_read_message, waiting)


def _read_message(entry: Entry) -> tuple[Channel, int, bytes]:
    time, batch, k = entry
    return batch.channel, time, batch.message(k)


def find_offered_qos(channel: Channel) -> tuple[bool, bool]:
    """Return whether reliable and transient local messages were offered; reliable if unknown."""
    try:
        profiles = yaml.safe_load(channel.qos) if channel.qos else []
        reliability = {str(profile["reliability"]).lower() for profile in profiles}
        durability = {str(profile["durability"]).lower() for profile in profiles}
    except (yaml.YAMLError, TypeError, KeyError):
        return True, False
    best_effort = bool(reliability) and reliability <= {"2", "best_effort"}
    return not best_effort, bool(durability & {"1", "transient_local"})


DEPTH = 1000
DISCOVERY_TIME_S = 1.0
"""Shortest wait [s] before the first message, so that subscribers find the publishers."""
FIRST_SUBSCRIBER_TIMEOUT_S = 3.0  # longest wait [s] for a first subscriber
CONNECTION_TIMEOUT_S = 5.0  # longest wait [s] until everybody whom the graph shows is connected


class Player(Node):
    """Publisher of a bag's messages in a separate thread."""

    def __init__(
        self, replay: Replay, channels: list[Channel], options: argparse.Namespace
    ) -> None:
        super().__init__("play")
        self._replay, self._options = replay, options
        self._outputs: dict[str, tuple[str, Publisher]] = {}
        for channel in channels:
            self._add_publisher(channel)
        if not self._outputs:
            raise SmpError("no topic of the bag can be played")
        self._clock = self.create_publisher(Clock, "/clock", 10) if options.clock else None
        self._clock_due = 0.0
        self.sent: Counter[str] = Counter()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _add_publisher(self, channel: Channel) -> None:
        kept, _ = self._outputs.get(channel.topic, (channel.type, None))
        if kept != channel.type:  # a node cannot offer one topic with two types
            self.get_logger().warning(
                f"{channel.topic}: its messages of type {channel.type} are not played, "
                f"only those of type {kept}"
            )
            return
        message = message_class(channel.type)
        if message is None or channel.encoding != "cdr":
            why = f"its type {channel.type} is not installed here"
            if channel.encoding != "cdr":
                why = f"its messages are encoded as {channel.encoding}"
            self.get_logger().warning(f"{channel.topic} is not played: {why}")
            return
        qos = quality(DEPTH, *find_offered_qos(channel))
        publisher = self.create_publisher(message, channel.topic, qos)
        self._outputs[channel.topic] = (channel.type, publisher)

    def _run(self) -> None:
        """Play until the end or until the node stops."""
        code = 0
        try:
            self._wait_for_subscribers()
            while not self._ended.is_set():
                if not self._play_once() or not self._options.loop:
                    break
            for _, publisher in self._outputs.values():
                if not self._ended.is_set():
                    publisher.wait_for_all_acked(Duration(seconds=2.0))
        except SmpError as error:
            print(f"play: {error}", file=sys.stderr, flush=True)
            code = error.exit_code
        except Exception as error:
            if not self._ended.is_set():
                print(f"play: stopped by {error!r}", file=sys.stderr, flush=True)
                code = 1
        runtime.finish(code)

    def _wait_for_subscribers(self) -> None:
        """Wait until there is a subscriber, and all are connected, within time limits."""
        begin = time.monotonic()
        while not self._ended.wait(0.02):
            waited = time.monotonic() - begin
            linked = [p.get_subscription_count() for _, p in self._outputs.values()]
            known = [self.count_subscribers(p.topic_name) for _, p in self._outputs.values()]
            enough = FIRST_SUBSCRIBER_TIMEOUT_S if not any(known) else 0.0
            if any(link < count for link, count in zip(linked, known)):
                enough = CONNECTION_TIMEOUT_S
            if waited >= max(enough, self._options.delay):
                return

    def _play_once(self) -> bool:
        """Play the bag from the offset to its end; return whether there was anything."""
        options = self._options
        begin: float | None = None
        first: int | None = None  # stamp at which to begin
        for channel, stamp, data in self._replay.messages(lambda c: c.topic in self._outputs):
            if first is None:
                first = stamp + round(options.start_offset * 1e9)
            if stamp < first:
                continue
            if begin is None:
                begin = time.monotonic()
            due = begin + (stamp - first) * 1e-9 / options.rate
            if not self._wait_until(due, begin, first):
                return False
            type_name, publisher = self._outputs[channel.topic]
            if channel.type == type_name:
                publisher.publish(data)
                self.sent[channel.topic] += 1
        if begin is None:
            where = (
                "in the bag" if first is None else f"behind an offset of {options.start_offset:g} s"
            )
            raise SmpError(f"there is no message {where}")
        return True

    def _wait_until(self, due: float, begin: float, first: int) -> bool:
        """Wait for a message's time and publish the clock; return False when stopped."""
        while not self._ended.is_set():
            now = time.monotonic()
            if self._clock is not None and now >= self._clock_due:
                elapsed = (min(now, due) - begin) * self._options.rate
                message = Clock()
                shown = divmod(first + round(elapsed * 1e9), 1_000_000_000)
                message.clock.sec, message.clock.nanosec = shown
                self._clock.publish(message)
                self._clock_due = now + 1.0 / self._options.clock
            if now >= due:
                return True
            until = due if self._clock is None else min(due, self._clock_due)
            # Short waits sleep: the event's own wait is too coarse for them.
            if until - now > 0.05:
                self._ended.wait(until - now - 0.02)
            else:
                time.sleep(max(until - now, 0.0))
        return False

    def on_stop(self) -> None:
        """Stop the thread and report the number of sent messages."""
        self._ended.set()
        self._thread.join(timeout=1.0)
        for finding in self._replay.findings:
            print(f"play: {finding.message}", file=sys.stderr, flush=True)
        for name, count in sorted(self.sent.items()):
            print(f"{count:9d}  {name}", flush=True)
        print(f"{sum(self.sent.values()):9d}  messages sent", flush=True)


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog="play",
        description="Publish the messages of a bag (MCAP or SQLite) again, as they were.",
        epilog="Arguments for ROS, such as remappings, follow --ros-args.",
    )
    add = made.add_argument
    add("bag", metavar="BAG", help="folder of the bag, or a bare .mcap or .db3 file")
    add("--topics", nargs="+", default=[], metavar="TOPIC", help="play only these topics")
    add("--rate", "-r", type=float, default=1.0, metavar="R",
        help="speed of playback: 2 is twice as fast; default 1")  # fmt: skip
    add("--start-offset", type=float, default=0.0, metavar="S",
        help="start this long after the beginning of the bag")  # fmt: skip
    add("--loop", "-l", action="store_true", help="start again at the end")
    add("--clock", nargs="?", type=float, const=40.0, default=0.0, metavar="HZ",
        help="publish /clock, 40 times a second by default")  # fmt: skip
    add("--delay", type=float, default=DISCOVERY_TIME_S, metavar="S",
        help="wait before the first message")  # fmt: skip
    return made


def _check(arguments: argparse.Namespace) -> None:
    for name, low in (("rate", 1e-6), ("start_offset", 0.0), ("clock", 0.0), ("delay", 0.0)):
        value = getattr(arguments, name)
        if not low <= value < float("inf"):
            what = "positive" if low else "0 or more"
            raise SmpError(f"--{name.replace('_', '-')} is {value:g}; it must be {what}")


def _select_channels(replay: Replay, arguments: argparse.Namespace) -> list[Channel]:
    names = {name if name.startswith("/") else f"/{name}" for name in arguments.topics}
    there = {channel.topic for channel in replay.channels}
    if missing := names - there:
        known = ", ".join(sorted(there)) or "none"
        raise SmpError(f"{arguments.bag}: has no topic {sorted(missing)[0]}; it has {known}")
    played = (names or there) - {"/clock" if arguments.clock else ""}
    return [channel for channel in replay.channels if channel.topic in played]


def main(argv: list[str] | None = None) -> int:
    own, ros = split_arguments(sys.argv[1:] if argv is None else argv)
    arguments = parser().parse_args(own)

    def make() -> Any:
        _check(arguments)
        replay = Replay(Path(arguments.bag))
        return Player(replay, _select_channels(replay, arguments), arguments)

    return runtime.run("play", make, ros)
