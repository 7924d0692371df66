"""What a recording offers, and a first guess of how it maps to motors."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from smp_motor_ident.bag.decode import Progress
from smp_motor_ident.bag.source import Recording, recordings
from smp_motor_ident.bag.template import (
    DecodeError,
    Number,
    Template,
    names_beside,
    take_apart,
)
from smp_motor_ident.bag.types import Types
from smp_motor_ident.bag.unpack import decompress_messages
from smp_motor_ident.errors import BagError
from smp_motor_ident.finding import Finding

_LISTED = 12
"""Elements of an array without names that are listed."""

_ROLES = {
    # What a field or its topic is called, the most telling first.
    "voltage": r"volt|pwm|duty|(?:^|\W|_)(?:cmd|command|effort|u|input)(?:$|\W|_)",
    "current": r"current|amp(?:s|ere)?(?:$|\W|_)",
    "count": r"tick|count|encoder|(?:^|\W|_)enc(?:$|\W|_)",
    "velocity": r"rpm|velocit|speed|omega|(?:^|\W|_)(?:vel|w|y)(?:$|\W|_)",
    "position": r"position|angle|theta|(?:^|\W|_)pos(?:$|\W|_)",
}
_HINTS = (
    ("velocity", r"rpm", ":rpm"),
    ("velocity", r"deg", ":deg/s"),
    ("position", r"deg", ":deg"),
    ("voltage", r"duty", ":duty"),
    ("voltage", r"pwm", "*12/255"),
    ("voltage", r"(?:^|_)m(?:illi)?v", ":mV"),
    ("current", r"(?:^|_)m(?:illi)?a(?:mp|$|_)", ":mA"),
    ("time", r"ms|milli", ":ms"),
    ("time", r"us|micro", ":us"),
    ("time", r"ns|nano", ":ns"),
)
_SIDES = ("front", "rear", "back", "left", "right", "fl", "fr", "rl", "rr", "bl", "br")
_OWN = "smp_interfaces/msg/MotorState"


@dataclass
class Offer:
    """One topic, or the columns of a CSV file.

    Attributes
    ----------
    topic, type : str
        Empty for a CSV file.
    count : int
        Messages that can be read; rows of a CSV file are not counted (0).
    rate : float
        [Hz], mean over the recording; 0 for less than two messages.
    fields : list of str
        Paths of its numbers, as a mapping takes them.
    remark : str
        Why its fields cannot be told.
    """

    topic: str
    type: str
    count: int = 0
    rate: float = 0.0
    fields: list[str] = field(default_factory=list)
    remark: str = ""


@dataclass
class Listing:
    """What a recording offers.

    Attributes
    ----------
    name : str
        Of the recording.
    offers : list of Offer
        By topic.
    suggestion : list of str
        Items for ``--map``; empty where nothing fits or nothing is needed.
    needs_mapping : bool
        False where the recording holds our own messages.
    findings : list of Finding
        What is missing or damaged.
    """

    name: str
    offers: list[Offer]
    suggestion: list[str]
    needs_mapping: bool
    findings: list[Finding]


def list_topics(
    paths: Any, msg_files: Iterable[str] = (), *, progress: Progress | None = None
) -> list[Listing]:
    """List what recordings offer, and suggest how to map it.

    Parameters
    ----------
    paths : path or sequence of paths
        As for `smp_motor_ident.bag.read_records`.
    msg_files : iterable of str
        ``.msg`` files for types that the bag does not define.
    progress : callable, optional
        ``progress(fraction, name)``.

    Returns
    -------
    list of Listing
        One per recording.

    Raises
    ------
    BagError
        When a path cannot be read.
    """
    types = Types(msg_files)
    listings = []
    for recording in recordings(paths):
        if recording.is_table:
            offers = [Offer(c.topic, c.type, fields=list(c.fields)) for c in recording.channels()]
        else:
            offers = _offers(recording, types, progress)
        needed = all(offer.type != _OWN for offer in offers)
        suggestion = suggest(offers) if needed else []
        listings.append(Listing(recording.name, offers, suggestion, needed, recording.findings))
    return listings


def _offers(recording: Recording, types: Types, progress: Progress | None) -> list[Offer]:
    """Return the topics of a bag with their fields, by its first messages."""
    found: dict[str, Offer] = {}
    spans: dict[str, tuple[int, int]] = {}
    for channel in recording.channels():
        found.setdefault(channel.topic, Offer(channel.topic, channel.type))
    for fraction, batch in recording.batches(lambda _: True):
        topic = batch.channel.topic
        offer = found.setdefault(topic, Offer(topic, batch.channel.type))
        if not offer.count:
            plain, _ = decompress_messages(batch.take(np.arange(1)), recording.budget)
            offer.fields, offer.remark = _fields(types, plain) if len(plain) else ([], "damaged")
        offer.count += len(batch)
        first, last = spans.get(topic, (2**63 - 1, -(2**63)))
        times = batch.log_time
        spans[topic] = (min(first, int(times.min())), max(last, int(times.max())))
        if progress is not None:
            progress(fraction, recording.name)
    for topic, (first, last) in spans.items():
        if last > first:
            found[topic].rate = (found[topic].count - 1) / ((last - first) * 1e-9)
    return [found[topic] for topic in sorted(found)]


def _fields(types: Types, batch: Any) -> tuple[list[str], str]:
    """Return the numeric fields of a batch's first message, or why they cannot be told."""
    if batch.channel.encoding not in ("cdr", "ros1"):
        return [], f"encoded as {batch.channel.encoding}"
    try:
        candidates = types.candidates(batch.channel)
    except BagError:
        return [], "unknown type: give its .msg files"
    reason = ""
    for definitions in candidates:
        try:
            template = take_apart(
                batch.message(0), batch.channel.type, definitions, batch.channel.encoding
            )
        except DecodeError as error:
            reason = str(error)
            continue
        return list(fields_of(template)), ""
    return [], f"not as its type says: {reason}"


def fields_of(template: Template) -> Iterator[str]:
    """Yield the paths of a message's numbers, without its header."""
    for name, value in template.root.items():
        if name != "header":
            yield from _paths(name, value, template.root)


def _paths(path: str, value: Any, parent: dict[str, Any]) -> Iterator[str]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _paths(f"{path}.{name}", inner, value)
    elif isinstance(value, Number) and value.count is None:
        yield path
    elif isinstance(value, Number) or (
        isinstance(value, list) and value and isinstance(value[0], dict)
    ):
        count = (value.count or 0) if isinstance(value, Number) else len(value)
        keys: list[Any] = list(range(min(count, _LISTED)))
        for texts in names_beside(parent).values():
            if len(texts) == count and len({text.value for text in texts}) == count:
                keys = [text.value for text in texts]
                break
        for k, key in enumerate(keys):
            inner = value[k] if isinstance(value, list) else Number(0, "")
            yield from _paths(f"{path}[{key}]", inner, parent)


def suggest(offers: list[Offer]) -> list[str]:
    """Guess which fields are voltage and motion of which wheel, by their names."""
    wheels: dict[str, dict[str, str]] = {}
    time = ""
    for offer in offers:
        for path in offer.fields:
            source = f"{offer.topic}.{path}" if offer.topic else _quoted(path)
            if not offer.topic and re.search(r"time|stamp|^t$", path, re.IGNORECASE):
                time = time or source + _hint("time", path)
                continue
            role = _role(offer.topic, path)
            if role:
                wheels.setdefault(_wheel(source), {}).setdefault(role, source + _hint(role, source))
    items = []
    motions = ("count", "position", "velocity")
    for wheel, roles in sorted(wheels.items()):
        if "voltage" in roles and any(role in roles for role in motions):
            prefix = f"{wheel}." if wheel else ""
            items += [f"{prefix}{role}={roles[role]}" for role in _ROLES if role in roles]
    return [*items, f"time={time}"] if items and time else items


def _quoted(column: str) -> str:
    return column if re.fullmatch(r"[\w()\[\]]+", column) else f'"{column}"'


def _role(topic: str, path: str) -> str:
    """Return what a field is by its own name, or else by its topic's."""
    for text in (path.partition("[")[0], topic):
        for role, pattern in _ROLES.items():
            if re.search(pattern, text, re.IGNORECASE):
                return role
    return ""


def _hint(role: str, source: str) -> str:
    for wanted, pattern, text in _HINTS:
        if wanted == role and re.search(pattern, source, re.IGNORECASE):
            return text
    return ""


def _wheel(source: str) -> str:
    """Return the side of the robot that a name tells."""
    words = re.split(r"[^a-z]+", source.lower())
    sides = [side for side in _SIDES if side in words]
    return "_".join(sides)
