# SPDX-License-Identifier: Apache-2.0
"""List a recording's topics and their numeric fields."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import numpy as np

from smp_motor_ident.bag import source, storage, template, unpack
from smp_motor_ident.bag.types import Types
from smp_motor_ident.errors import BagError
from smp_motor_ident.finding import Finding

_MAX_LISTED = 12  # elements of an array without names that are listed


@dataclass
class TopicInfo:
    """One topic, or the columns of a table that have one length."""

    # topic, type: empty for the only table of a file
    topic: str
    type: str
    # Messages that can be read; rows of a table where its columns differ in length, else 0
    count: int = 0
    rate: float = 0.0  # [Hz], mean over the recording; 0 for less than two messages
    fields: list[str] = field(default_factory=list)  # paths of its numbers, as a mapping takes them
    remark: str = ""  # why its fields are unknown
    table: bool = False  # whether it comes from a file of columns
    # Units of the columns, where the file names them
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(kw_only=True)
class Proposal:
    """A mapping that reads a recording."""

    suggestion: list[str] = field(default_factory=list)  # items for ``--map``
    asked: list[str] = field(default_factory=list)  # items that the user must add
    remark: str = ""  # reason for no items, or items that the data do not confirm


@dataclass(kw_only=True)
class Listing(Proposal):
    """Topics of a recording with a tested mapping; empty if it needs no mapping."""

    name: str  # of the recording
    topics: list[TopicInfo]  # by topic
    needs_mapping: bool  # false where the recording holds our own messages
    findings: list[Finding]  # missing or damaged parts


def describe_topics(recording: source.Recording, types: Types) -> list[TopicInfo]:
    """Return the topics of a recording with their fields, by its first messages."""
    if recording.is_table:
        return [
            TopicInfo(c.topic, c.type, count, fields=fields, table=True, units=c.units)
            for c in recording.channels()
            for count, fields in _group_by_length(c)
        ]
    found: dict[str, TopicInfo] = {}
    ends: dict[str, list[int]] = {}
    for channel in recording.channels():
        found.setdefault(channel.topic, TopicInfo(channel.topic, channel.type))
    for batch in chain.from_iterable(recording.batches(lambda _: True)):
        topic = batch.channel.topic
        info = found.setdefault(topic, TopicInfo(topic, batch.channel.type))
        if not info.count:
            plain, _ = unpack.decompress_messages(batch.take(np.arange(1)), recording.budget)
            info.fields, info.remark = _list_fields(types, plain) if len(plain) else ([], "damaged")
        info.count += len(batch)
        times = batch.log_time
        ends.setdefault(topic, []).extend([int(times.min()), int(times.max())])
    for topic, instants in ends.items():
        if span := max(instants) - min(instants):
            found[topic].rate = (found[topic].count - 1) / (span * 1e-9)
    return [found[topic] for topic in sorted(found)]


def _group_by_length(channel: storage.Channel) -> list[tuple[int, list[str]]]:
    """Return the columns of a table by their length, the longest first; 0 where all have one."""
    if not channel.lengths:
        return [(0, list(channel.fields))]
    groups: dict[int, list[str]] = {}
    for name, length in zip(channel.fields, channel.lengths):
        groups.setdefault(length, []).append(name)
    return sorted(groups.items(), reverse=True)


def _list_fields(types: Types, batch: Any) -> tuple[list[str], str]:
    """Return the numeric fields of a batch's first message, or why they are unknown."""
    channel, reason = batch.channel, ""
    if channel.encoding not in ("cdr", "ros1"):
        return [], f"encoded as {channel.encoding}"
    try:
        for definitions in types.candidates(channel):
            try:
                root = template.parse_message(
                    batch.message(0), channel.type, definitions, channel.encoding
                ).root
            except template.DecodeError as error:
                reason = str(error)
                continue
            fields = (_walk(name, value, root) for name, value in root.items() if name != "header")
            return list(chain.from_iterable(fields)), ""
    except BagError:
        return [], "unknown type: give its .msg files"
    return [], f"does not match its type: {reason}"


def _walk(path: str, value: Any, parent: dict[str, Any]) -> Iterator[str]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _walk(f"{path}.{name}", inner, value)
    elif isinstance(value, template.Number) and value.count is None:
        yield path
    elif isinstance(value, template.Number) or (
        isinstance(value, list) and value and isinstance(value[0], dict)
    ):
        count = (value.count or 0) if isinstance(value, template.Number) else len(value)
        keys: list[Any] = list(range(min(count, _MAX_LISTED)))
        for texts in template.find_name_lists(parent).values():
            if len(texts) == count and len({text.value for text in texts}) == count:
                keys = [text.value for text in texts]
                break
        for k, key in enumerate(keys):
            inner = value[k] if isinstance(value, list) else template.Number(0, "")
            yield from _walk(f"{path}[{key}]", inner, parent)
