"""Two publishers of one topic, such as a forgotten node or a second robot on the domain.

Each publisher numbers its messages, so that the numbers which a subscription sees fall again and
again where two send at once.  They fall once where a publisher was started anew; the graph, which
keeps a killed node for some seconds, does not tell these apart, but knows the names.
"""

import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.node import Node

FALLS = 4
"""How often numbers fall within :data:`WINDOW` where two publishers send at once."""

WINDOW = 1.0  # [s]
UNKNOWN = "_NODE_NAME_UNKNOWN_"
"""What the middleware calls the node of an endpoint that it discovered before the node."""


class PublisherWatch:
    """Watches the numbers of one topic's messages; ``doubled`` says whether two publishers send."""

    def __init__(self) -> None:
        self._last = 0
        self._falls: deque[float] = deque(maxlen=FALLS)

    def hear(self, info: Mapping[str, Any]) -> bool:
        """Take in a message's info; return whether it is of another publisher than the last."""
        number = info["publication_sequence_number"] or 0
        fell = 0 < number <= self._last
        self._last = number
        if fell:
            self._falls.append(time.monotonic())
        return fell

    @property
    def doubled(self) -> bool:
        """Whether two publishers sent within the last second."""
        falls = self._falls
        return len(falls) == FALLS and falls[0] > time.monotonic() - WINDOW


def are_known(node: Node, topic: str) -> bool:
    """Tell whether the nodes of all publishers were discovered."""
    infos = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    return all(info.node_name != UNKNOWN for info in infos)


def publishers_of(node: Node, topic: str) -> str:
    """Return the names of a topic's publishers as the graph has them, such as ``2 x /play``."""
    infos = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    names = Counter(
        "an unknown node"
        if info.node_name == UNKNOWN
        else f"{info.node_namespace.rstrip('/')}/{info.node_name}"
        for info in infos
    )
    return " and ".join(
        name if count == 1 else f"{count} x {name}" for name, count in sorted(names.items())
    )


def two_publishers(node: Node, topic: str) -> str:
    """Return what is to be said of a topic on which two publishers send at once."""
    names = publishers_of(node, topic) or "two nodes"
    return f"{node.resolve_topic_name(topic)} comes from {names} at once: end one of them"


def watched(
    watch: PublisherWatch, take: Callable[[Any], object]
) -> Callable[[Any, Mapping[str, Any]], None]:
    """Return a subscription's callback that lets a watch hear what ``take`` is given."""

    def callback(message: Any, info: Mapping[str, Any]) -> None:
        watch.hear(info)
        take(message)

    return callback
