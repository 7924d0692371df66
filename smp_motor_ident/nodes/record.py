# SPDX-License-Identifier: Apache-2.0
"""record: write any topics into a bag that stays readable whenever the recorder dies.

Messages are taken raw and written byte for byte as sent.  They are taken in small batches from
DDS' own queue instead of one callback each: at 4 x 1 kHz that costs a third of the time, and the
queue's reception stamps stay exact.
"""

import argparse
import re
import shutil
import sys
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from smp_motor_control.entry import split_arguments
from smp_motor_control.errors import SmpError
from smp_motor_control.nodes import executor, runtime
from smp_motor_control.nodes.publishers import (
    PublisherWatch,
    are_publishers_known,
    describe_two_publishers,
)
from smp_motor_ident.bag.writer import DEFAULT_QOS, BagWriter
from smp_motor_ident.nodes.bag_arguments import message_class, quality

TAKE_PERIOD_S = 0.004
DISCOVERY_PERIOD_S = 0.05
DEPTH = 2000  # depth of the DDS queue per topic: two seconds of 1 kHz while the disk is busy


ONE_PUBLISHER = ("smp_interfaces/msg/MotorState", "smp_interfaces/msg/PidState")
"""Types with only one publisher per topic; others may have several."""


@dataclass(frozen=True)
class TopicFilter:
    """Topics to record; without names and a pattern all but those with a leading underscore."""

    names: frozenset[str]
    pattern: re.Pattern[str] | None = None
    exclude: re.Pattern[str] | None = None

    def matches(self, topic: str) -> bool:
        if self.exclude and self.exclude.fullmatch(topic):
            return False
        if topic in self.names or "/_" in topic:
            return topic in self.names
        return bool(self.pattern.fullmatch(topic)) if self.pattern else not self.names


@dataclass
class Topic:
    type: str
    subscription: Subscription
    publishers: int
    last_number: int = 0
    lost: int = 0
    watch: PublisherWatch = field(default_factory=PublisherWatch)
    doubled: bool = False  # whether two publishers have been reported


def subscription_qos(offered: list[QoSProfile]) -> QoSProfile:
    """Return the strongest QoS that all publishers offer."""
    reliable = all(q.reliability == ReliabilityPolicy.RELIABLE for q in offered)
    latched = all(q.durability == DurabilityPolicy.TRANSIENT_LOCAL for q in offered)
    return quality(DEPTH, reliable, latched)


def qos_document(qos: QoSProfile) -> dict[str, Any]:
    """Return a profile as the metadata of a bag write it."""
    document = {}
    for name in DEFAULT_QOS:
        value = getattr(qos, name)
        if isinstance(value, Duration):
            seconds, rest = divmod(value.nanoseconds, 1_000_000_000)
            value = {"sec": seconds, "nsec": rest}
        document[name] = value.name.lower() if hasattr(value, "name") else value
    return document


class Recorder(Node):
    """Recorder of topics as they appear, for ``duration`` [s] or without end."""

    def __init__(self, writer: BagWriter, choice: TopicFilter, duration: float = 0.0) -> None:
        super().__init__("record")
        self._writer = writer
        own = {self.resolve_topic_name(name) for name in choice.names}
        self._choice = replace(choice, names=frozenset(own))
        self._topics: dict[str, Topic] = {}
        self._refused: set[str] = set()
        self._group = executor.PolledSubscriptions()
        self._update_subscriptions()
        runtime.steady_timer(self, DISCOVERY_PERIOD_S, self._update_subscriptions)
        runtime.steady_timer(self, TAKE_PERIOD_S, self._take_all)
        if duration:
            runtime.steady_timer(self, duration, runtime.finish)
        self.get_logger().info(f"recording to {writer.path}")

    def _update_subscriptions(self) -> None:
        """Subscribe to new topics, and match publishers with weaker QoS than the others."""
        for name, types in self.get_topic_names_and_types():
            if not self._choice.matches(name) or name in self._refused:
                continue
            infos = self.get_publishers_info_by_topic(name)
            known = self._topics.get(name)
            if not infos or (known is not None and known.publishers == len(infos)):
                continue
            if known is None:
                if len(types) > 1:
                    self._refuse(name, f"has several types ({', '.join(types)})")
                    continue
                self._start(name, types[0], infos)
            else:
                self._reduce_qos(name, known, infos)

    def _refuse(self, name: str, why: str) -> None:
        self._refused.add(name)
        self.get_logger().warning(f"{name} is not recorded: it {why}")

    def _start(self, name: str, type_name: str, infos: list[TopicEndpointInfo]) -> None:
        message = message_class(type_name)
        if message is None:
            self._refuse(name, f"has the type {type_name}, which is not installed here")
            return
        qos = subscription_qos([info.qos_profile for info in infos])
        subscription = self._subscribe(name, message, qos)
        profiles = [qos_document(info.qos_profile) for info in infos]
        if not self._writer.add_topic(name, type_name, profiles, numbered=True):
            self.get_logger().warning(f"{name}: {type_name} is kept without its definition")
        self._topics[name] = Topic(type_name, subscription, len(infos))
        self.get_logger().info(f"{name} ({type_name})")

    def _subscribe(self, name: str, message: Any, qos: QoSProfile) -> Subscription:
        return self.create_subscription(
            message, name, lambda _: None, qos, raw=True, callback_group=self._group
        )

    def _reduce_qos(self, name: str, topic: Topic, infos: list[TopicEndpointInfo]) -> None:
        """Reduce the requested QoS to that of a weaker new publisher."""
        topic.publishers, topic.last_number = len(infos), 0
        qos = subscription_qos([info.qos_profile for info in infos])
        old = topic.subscription.qos_profile
        weaker = old.reliability != qos.reliability == ReliabilityPolicy.BEST_EFFORT
        if not weaker and qos.durability == old.durability:
            return
        self._take(name, topic)
        self.get_logger().info(f"{name}: following a publisher that offers another QoS")
        self.destroy_subscription(topic.subscription)
        topic.subscription = self._subscribe(name, topic.subscription.msg_type, qos)

    def _take_all(self) -> None:
        for name, topic in self._topics.items():
            self._take(name, topic)
            doubled = topic.type in ONE_PUBLISHER and topic.watch.has_two_publishers
            if doubled and not topic.doubled and are_publishers_known(self, name):
                topic.doubled = True
                self.get_logger().warning(describe_two_publishers(self, name))
        self._writer.flush()

    def _take(self, name: str, topic: Topic) -> None:
        """Write all pending messages of a topic."""
        handle, write = topic.subscription.handle, self._writer.write
        with handle:
            while (taken := handle.take_message(topic.subscription.msg_type, True)) is not None:
                data, info = taken
                # Publishers number their messages, each for itself: a gap is a loss.
                number = info["publication_sequence_number"] or 0
                topic.watch.hear(info)
                if topic.publishers != 1:
                    number = 0
                elif 0 < topic.last_number < number - 1:
                    topic.lost += number - topic.last_number - 1
                topic.last_number = number
                received, sent = info["received_timestamp"], info["source_timestamp"]
                write(name, topic.type, data, received, sent=sent, number=number)

    def on_stop(self) -> None:
        """Take pending messages, close the bag and report its contents."""
        try:
            self._take_all()
            self._writer.close()
        except SmpError as error:  # the disk is full, but the bag is readable
            print(f"record: {error}", file=sys.stderr, flush=True)
        counts = self._writer.counts
        for name, count in sorted(counts.items()):
            topic = self._topics[name]
            notes = f"  ({topic.lost} lost)" if topic.lost else ""
            notes += "  (of two publishers)" if topic.doubled else ""
            print(f"{count:9d}  {name}{notes}", flush=True)
        print(f"{sum(counts.values()):9d}  messages in {self._writer.path}", flush=True)


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog="record",
        description="Record topics into a bag (MCAP, readable by ros2 bag). Ctrl-C ends it. The "
        "bag stays readable if the process is killed.",
        epilog="Arguments for ROS follow --ros-args.",
    )
    add = made.add_argument
    add("topics", nargs="*", metavar="TOPIC", help="topics to record (default: all)")
    add("--output", "-o", metavar="DIR", help="folder of the bag (default: rosbag2_DATE)")
    add("--regex", "-e", type=_pattern, metavar="PATTERN",
        help="record topics whose whole name matches")  # fmt: skip
    add("--exclude", "-x", type=_pattern, metavar="PATTERN", help="leave out topics that match")
    add("--duration", "-d", type=float, default=0.0, metavar="S",
        help="end after this time; default: at Ctrl-C")  # fmt: skip
    add("--force", action="store_true", help="replace an existing bag")
    return made


def _pattern(text: str) -> re.Pattern[str]:
    try:
        return re.compile(text)
    except re.error as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a regular expression: {error}") from None


def _remove_old_bag(path: Path, force: bool) -> None:
    """Remove a bag to be replaced; refuse anything else."""
    if not path.exists():
        return
    if not force:
        raise SmpError(f"{path} exists already; choose another --output or use --force")
    if not path.is_dir() or (any(path.iterdir()) and not (path / "metadata.yaml").exists()):
        raise SmpError(f"{path} is not a bag; --force replaces bags only")
    shutil.rmtree(path)


def main(argv: list[str] | None = None) -> int:
    own, ros = split_arguments(sys.argv[1:] if argv is None else argv)
    arguments = parser().parse_args(own)
    output = Path(arguments.output or f"rosbag2_{datetime.now():%Y_%m_%d-%H_%M_%S}")

    def make() -> Recorder:
        choice = TopicFilter(frozenset(arguments.topics), arguments.regex, arguments.exclude)
        _remove_old_bag(output, arguments.force)
        return Recorder(BagWriter(output), choice, arguments.duration)

    return runtime.run("record", make, ros)
