# SPDX-License-Identifier: Apache-2.0
"""Find recordings in paths: folders, split bags, bare files, tables alone and together."""

import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import msgspec
import yaml

from smp_motor_control.errors import printable
from smp_motor_control.parameter_file import load_bounded_yaml
from smp_motor_ident.bag.readers import BAGS, PACKED, TABLES, is_table, open_source
from smp_motor_ident.bag.readers.format import Messages, Tables, check_width
from smp_motor_ident.bag.storage import TABLE, Batch, Channel, Table, note, note_damage
from smp_motor_ident.bag.unpack import Budget, make_temporary_folder
from smp_motor_ident.errors import BagError
from smp_motor_ident.finding import Finding

_SPLIT = re.compile(r"(.+?)_\d+$")
_BAG_NAME = re.compile(rf"({'|'.join(map(re.escape, BAGS))})(\.\w+)?$")
_NAMED_ONLY = (".json", ".txt", ".log", ".dat")
"""Tables that a folder may hold for other reasons: read only when named."""
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_MAX_METADATA_BYTES = 1 << 24
"""Largest read part of a metadata.yaml; one with a thousand topics has some 500 kB."""


class _Topic(msgspec.Struct):
    name: str


class _Counted(msgspec.Struct):
    """One topic of a metadata.yaml; the oldest bags call its entry differently."""

    message_count: int
    topic_metadata: _Topic | None = None
    topic_and_type: _Topic | None = None


class _Information(msgspec.Struct):
    """Used entries of a metadata.yaml, in all versions."""

    relative_file_paths: list[str]
    topics_with_message_count: list[_Counted] | None = None


class _Metadata(msgspec.Struct):
    rosbag2_bagfile_information: _Information


@dataclass
class Recording:
    """One experiment: a bag with its files in order, or tables."""

    name: str  # what to call it in messages and results
    files: list[Path]  # in the order in which they were written
    declared: dict[str, int] | None = None  # messages by topic as metadata.yaml counts them
    # Grows while the files are read
    findings: list[Finding] = field(default_factory=list)
    # Whether it was found in a folder with others, rather than named by the user
    one_of_many: bool = False
    _sources: dict[Path, Messages | Tables | None] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        self.name = printable(self.name)

    @property
    def is_table(self) -> bool:
        """Whether it holds columns instead of messages."""
        return is_table(self.files[0])

    @cached_property
    def budget(self) -> Budget:
        """Bytes that may be unpacked of it."""
        return Budget(self.name, sum(file.stat().st_size for file in self.files))

    @cached_property
    def _folder(self) -> Path:
        return make_temporary_folder(self)

    def channels(self) -> list[Channel]:
        """Return the channels of all files, one per topic, type and file."""
        every: list[Channel] = []
        for path in self.files:
            if (source := self._open(path)) is not None:
                every += [replace(c, topic=self._name_topic(path, c)) for c in source.channels()]
                self._add(*source.problems)
        check_width(len({c.topic for c in every}), self.name, "topics")
        check_width(sum(len(c.fields) for c in every), self.name)
        return every

    def _name_topic(self, path: Path, channel: Channel) -> str:
        """Return a channel's topic, which begins with the file's name for one of several tables."""
        if channel.encoding != TABLE or len(self.files) == 1:
            return channel.topic
        return f"/{path.stem}" + (f"/{channel.topic}" if channel.topic else "")

    def table(self, topic: str, fields: Sequence[str]) -> Table:
        """Return columns of a table."""
        for path in self.files:
            if isinstance(source := self._open(path), Tables):
                for channel in source.channels():
                    if self._name_topic(path, channel) == topic:
                        return source.table(channel.topic, fields)
        raise BagError(f"{self.name}: has no {topic or 'table'}")

    def batches(self, wanted: Callable[[Channel], bool]) -> Iterator[list[Batch]]:
        """Read all files, and report every missing message."""
        counts: Counter[str] = Counter()
        seen: set[str] = set()
        for path in self.files:
            source = cast("Messages | None", self._open(path))
            if source is not None:
                mine: Counter[str] = Counter()
                for batches in source.batches(wanted):
                    for batch in batches:
                        mine[batch.channel.topic] += len(batch)
                    yield batches
                asked = {c.topic for c in source.channels() if wanted(c)}
                seen |= asked
                self._add(*source.problems)
                for topic, count in (source.declared() or {}).items():
                    if topic in asked and mine[topic] < count:
                        self._report_loss(path.name, topic, mine[topic], count)
                counts += mine
        for topic, count in (self.declared or {}).items():
            if topic in seen and counts[topic] < count:
                self._report_loss("metadata.yaml", topic, counts[topic], count)

    def _add(self, *findings: Finding) -> None:
        self.findings += [f for f in findings if f not in self.findings]

    def _report_loss(self, who: str, topic: str, have: int, declared: int) -> None:
        text = (
            f"{self.name}: {topic}: {have} of {declared} messages could be read "
            f"({who} counts {declared}; {declared - have} are lost)"
        )
        self._add(note("messages_lost", text, "warning", read=have, counted=declared))

    def _open(self, path: Path) -> Messages | Tables | None:
        """Open a file; an unreadable one among several becomes a finding."""
        if path not in self._sources:
            try:
                source = open_source(path, self._folder, self.budget)
                if is_table(path) is not self.is_table:
                    raise BagError(
                        f"{path}: is not of the kind of the other files; give tables or bags"
                    )
                self._sources[path] = source
            except BagError as error:
                if len(self.files) == 1 or self.is_table:
                    raise
                self._sources[path] = None
                self._add(note_damage(str(error)))
        return self._sources[path]


def find_recordings(paths: Any, topics: Collection[str] = ()) -> list[Recording]:
    """Find the recordings behind paths, in the order given, folders by name.

    Tables whose names are among ``topics`` (``/STEM``) are one recording, on one clock.
    """
    if isinstance(paths, (str, os.PathLike)):
        paths = [paths]
    every: list[Recording] = []
    for path in map(Path, paths):
        if not path.exists():
            raise BagError(f"{path}: does not exist")
        if not (path.is_dir() or path.is_file()):
            raise BagError(f"{path}: is a pipe or a device; save its output as a file")
        try:
            inside = _search_folder(path) if path.is_dir() else [Recording(path.name, [path])]
        except OSError as error:
            raise BagError(f"{path}: cannot be read ({error.strerror})") from None
        for recording in inside:
            recording.one_of_many = len(inside) > 1
        if not inside:
            raise BagError(f"{path}: holds no bag ({', '.join(BAGS)}) and no table such as .csv")
        every += inside
    if not every:
        raise BagError("no recording is given; name a file or a folder")
    return _join_by_columns(_join_topics(every, topics), topics)


def _join_by_columns(every: list[Recording], columns: Collection[str]) -> list[Recording]:
    """Join tables that each have some of the mapped columns."""
    if len(every) < 2 or not columns or any(not r.is_table or r.one_of_many for r in every):
        return every
    held = [{name for c in one.channels() for name in c.fields} & set(columns) for one in every]
    apart = sum(map(len, held)) == len(set.union(*held)) == len(set(columns))
    stems = [one.files[0].stem for one in every]
    if not apart or not all(held) or len(set(stems)) < len(stems):
        return every
    return [Recording("+".join(stems), [one.files[0] for one in every])]


def _join_topics(every: list[Recording], topics: Collection[str]) -> list[Recording]:
    """Join the tables that a mapping names as topics; leave out the others."""
    begins = {r.files[0]: f"/{r.files[0].stem}" for r in every if len(r.files) == 1}
    named = {f for f, name in begins.items() if any(f"{t}.".startswith(f"{name}.") for t in topics)}
    parts = [r for r in every if r.files[0] in named]
    if len(parts) < 2 or not all(part.is_table for part in parts):
        return every
    stems = [part.files[0].stem for part in parts]
    if len(set(stems)) < len(stems):
        raise BagError(
            f"{parts[0].files[0]}: several files have this name, by which the mapping tells "
            "them apart; rename one"
        )
    whole = Recording("+".join(stems), [part.files[0] for part in parts])
    return [whole, *(r for r in every if r not in parts and not r.is_table)]


def _search_folder(top: Path) -> list[Recording]:
    """Return the recordings of a folder: one bag, or its contents; skip links to parents."""
    every: list[Recording] = []
    waiting, seen = [top], set[tuple[int, int]]()
    while waiting:
        path = waiting.pop()
        if (place := (path.stat().st_dev, path.stat().st_ino)) in seen:
            continue
        seen.add(place)
        if (path / "metadata.yaml").is_file():
            every.append(_read_bag_folder(path))
            continue
        here = sorted(path.iterdir())
        every += _group_files(_name_folder(path), [p for p in here if p.is_file()])
        waiting += [p for p in reversed(here) if p.is_dir() and not p.name.startswith(".")]
    return every


def _name_folder(path: Path) -> str:
    return path.name if path.name.strip(".") else path.resolve().name


def _group_files(name: str, here: Sequence[Path]) -> list[Recording]:
    """Return the recordings among the files of a folder without metadata."""
    groups: dict[str, list[Path]] = {}
    for file in _select_bag_files(here):
        split = _SPLIT.match(_stem(file))
        groups.setdefault(split[1] if split else _stem(file), []).append(file)
    text = f"{name}: has no metadata.yaml; all its files are read"
    every = []
    for key, files in groups.items():
        amiss = [] if files[0].suffix == ".bag" else [note("no_metadata", text)]
        whole = name if len(groups) == 1 else f"{name}/{key}"
        every.append(Recording(whole, sorted(files, key=_sort_key), findings=amiss))
    tables = [s for s in TABLES if s not in _NAMED_ONLY]
    return every + [Recording(p.name, [p]) for p in here if p.suffix.lower() in tables]


def _select_bag_files(files: Iterable[Path]) -> list[Path]:
    """Return the bag files, each once where it is there both plain and compressed."""
    storages = [p for p in files if _BAG_NAME.search(p.name) and p.suffix in (*BAGS, *PACKED)]
    plain = {p.name for p in storages if p.suffix in BAGS}
    return [p for p in storages if p.name in plain or p.name.removesuffix(p.suffix) not in plain]


def _stem(path: Path) -> str:
    return _BAG_NAME.sub("", path.name)


def _sort_key(path: Path) -> tuple[str, int]:
    match = re.fullmatch(r"(.*?)_?(\d*)", _stem(path))
    assert match is not None
    return match[1], int(match[2] or 0)


def _read_bag_folder(path: Path) -> Recording:
    """Return a bag by its metadata.yaml, of any version, ignoring invalid entries."""
    name = _name_folder(path)
    bag = Recording(name, [])
    try:
        with (path / "metadata.yaml").open("rb") as metadata:
            text = metadata.read(_MAX_METADATA_BYTES).decode("utf-8", "replace")
        given = msgspec.convert(load_bounded_yaml(text, _LOADER), _Metadata)
        information = given.rosbag2_bagfile_information
        listed = [Path(file).name for file in information.relative_file_paths]
        counts: Counter[str] = Counter()
        for entry in information.topics_with_message_count or ():
            if (topic := entry.topic_metadata or entry.topic_and_type) is not None:
                counts[topic.name] += entry.message_count
        bag.declared = dict(counts)
    except (yaml.YAMLError, ValueError, OSError, ArithmeticError) as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        bag.findings.append(
            note_damage(f"{name}: metadata.yaml is damaged ({reason}); all files are read")
        )
        bag.declared, listed = None, []
    there = _select_bag_files(sorted(path.iterdir()))
    for file in listed:
        options = [file, file.removesuffix(Path(file).suffix), f"{file}.zstd", f"{file}.lz4"]
        match = next((path / o for o in options if o and (path / o).is_file()), None)
        if match is None:
            bag.findings.append(
                note_damage(f"{name}: {file} is missing, which metadata.yaml lists")
            )
        elif match not in bag.files:
            bag.files.append(match)
    extra = sorted((f for f in there if f not in bag.files), key=_sort_key)
    stems = {_stem(file) for file in bag.files}
    extra = [file for file in extra if _stem(file) not in stems]
    if extra and listed:
        names = ", ".join(file.name for file in extra)
        text = f"{name}: {names} is not listed in metadata.yaml and is read too"
        bag.findings.append(note("unlisted_files", text))
    bag.files += extra
    if not bag.files:
        reason = bag.findings[-1].message if bag.findings else "holds no .mcap or .db3"
        raise BagError(f"{path}: {reason}")
    return bag
