# SPDX-License-Identifier: Apache-2.0
"""Detection of two publishers on one topic, such as a second robot on the domain.

With two publishers the sequence numbers seen by a subscription fall repeatedly; after a restart of
one publisher they fall once.  The graph cannot distinguish these cases, as it keeps a killed node
for some seconds, but it provides the names.
"""

import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.node import Node

DECISIVE_FALLS = 4  # falls of the number within :data:`WINDOW_S` that show two publishers
WINDOW_S = 1.0
UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"
"""The middleware's name of a node whose endpoint is discovered first."""


class PublisherWatch:
    """Watch the sequence numbers of a topic's messages."""

    def __init__(self) -> None:
        self._last = 0
        self._falls: deque[float] = deque(maxlen=DECISIVE_FALLS)

    def hear(self, info: Mapping[str, Any]) -> bool:
        """Add a message's info; return whether its publisher differs from the previous one."""
        number = info["publication_sequence_number"] or 0
        fell = 0 < number <= self._last
        self._last = number
        if fell:
            self._falls.append(time.monotonic())
        return fell

    @property
    def has_two_publishers(self) -> bool:
        """Whether two publishers sent within the last :data:`WINDOW_S`."""
        falls = self._falls
        return len(falls) == DECISIVE_FALLS and falls[0] > time.monotonic() - WINDOW_S


def are_publishers_known(node: Node, topic: str) -> bool:
    """Return whether the nodes of all publishers are discovered."""
    infos = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    return all(info.node_name != UNKNOWN_NODE for info in infos)


def describe_two_publishers(node: Node, topic: str) -> str:
    """Return the message about a topic with two publishers, with their names in the graph."""
    infos = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    names = Counter(
        "an unknown node"
        if info.node_name == UNKNOWN_NODE
        else f"{info.node_namespace.rstrip('/')}/{info.node_name}"
        for info in infos
    )
    each = (f"{count} x {name}" if count > 1 else name for name, count in sorted(names.items()))
    who = " and ".join(each) or "two nodes"
    return f"{node.resolve_topic_name(topic)} comes from {who} at once; end one of them"


def with_watch(
    watch: PublisherWatch, take: Callable[[Any], object]
) -> Callable[[Any, Mapping[str, Any]], None]:
    """Return a callback that passes messages to ``take`` and their info to a watch."""

    def callback(message: Any, info: Mapping[str, Any]) -> None:
        watch.hear(info)
        take(message)

    return callback
