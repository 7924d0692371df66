"""metadata.yaml as rosbag2 of ROS 2 Jazzy writes it (version 9)."""

import textwrap
from collections.abc import Iterable
from typing import Any

import yaml

_METADATA = """\
rosbag2_bagfile_information:
  version: 9
  storage_identifier: mcap
  duration:
    nanoseconds: {duration}
  starting_time:
    nanoseconds_since_epoch: {start}
  message_count: {total}
  topics_with_message_count:
{topics}  compression_format: ""
  compression_mode: ""
  relative_file_paths:
    - {name}
  files:
    - path: {name}
      starting_time:
        nanoseconds_since_epoch: {start}
      duration:
        nanoseconds: {duration}
      message_count: {total}
  custom_data: ~
  ros_distro: {distribution}
"""
_FOREVER = {"sec": 9223372036, "nsec": 854775807}
DEFAULT_QOS: dict[str, Any] = {
    "history": "keep_last",
    "depth": 10,
    "reliability": "reliable",
    "durability": "volatile",
    "deadline": dict(_FOREVER),
    "lifespan": dict(_FOREVER),
    "liveliness": "automatic",
    "liveliness_lease_duration": dict(_FOREVER),
    "avoid_ros_namespace_conventions": False,
}
"""QoS of a topic as metadata of version 9 write it."""


def topic_entry(name: str, type_name: str, profiles: list[dict[str, Any]], type_hash: str) -> str:
    """Return what the file says of a topic, but for its number of messages."""
    entry = {
        "name": name,
        "type": type_name,
        "serialization_format": "cdr",
        "offered_qos_profiles": profiles,
        "type_description_hash": type_hash,
    }
    return textwrap.indent(yaml.safe_dump(entry, sort_keys=False), " " * 8)


def document(
    file: str, distribution: str, first: int, last: int, topics: Iterable[tuple[str, int]]
) -> str:
    """Return the whole text; it is put together by hand since it is written every half second."""
    entries = list(topics)
    parts = [f"    - topic_metadata:\n{text}      message_count: {n}\n" for text, n in entries]
    return _METADATA.format(
        name=file,
        duration=last - first,
        start=first,
        total=sum(count for _, count in entries),
        distribution=distribution,
        topics="".join(parts) or "    []\n",
    )
