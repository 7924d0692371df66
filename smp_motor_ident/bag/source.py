"""From paths to recordings: folders, split bags, bare files, compressed files, CSV."""

from __future__ import annotations

import os
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lz4.frame
import yaml
import zstandard

from smp_motor_ident.bag import mcap_file, sqlite_file
from smp_motor_ident.bag.storage import LZ4_MAGIC, ZSTD_MAGIC, Batch, Channel, Storage
from smp_motor_ident.errors import BagError

_SPLIT = re.compile(r"(.+?)_\d+$")
_SUFFIXES = (".mcap", ".db3", ".zstd", ".zst", ".lz4")


@dataclass
class Recording:
    """One experiment: a bag with its files in order, or a CSV file.

    Attributes
    ----------
    name : str
        What to call it in messages and results.
    files : list of Path
        In the order in which they were written.
    promised : dict of str to int, or None
        Messages by topic as metadata.yaml counts them.
    distribution : str
        ROS distribution that wrote it, where known.
    notes : list of str
        What was found amiss, grows while the files are read.
    one_of_many : bool
        Whether it was found in a folder with others, so that nobody asked for it by name.
    """

    name: str
    files: list[Path]
    promised: dict[str, int] | None = None
    distribution: str = ""
    notes: list[str] = field(default_factory=list)
    one_of_many: bool = False
    _storages: dict[Path, Storage | None] = field(default_factory=dict, repr=False)
    _folder: tempfile.TemporaryDirectory[str] | None = field(default=None, repr=False)

    @property
    def is_table(self) -> bool:
        """Whether it is a CSV file."""
        return self.files[0].suffix.lower() in (".csv", ".tsv", ".txt")

    def size(self) -> int:
        """Return the bytes of all files."""
        return sum(file.stat().st_size for file in self.files)

    def channels(self) -> list[Channel]:
        """Return the channels of all files.

        Returns
        -------
        list of Channel
            One per topic, type and file.
        """
        found: list[Channel] = []
        for path in self.files:
            if (storage := self._storage(path)) is not None:
                found += storage.channels()
                self._note(*storage.problems)
        return found

    def batches(self, wanted: Callable[[Channel], bool]) -> Iterator[tuple[float, Batch]]:
        """Read all files, and note every message that is missing."""
        counts: Counter[str] = Counter()
        seen: set[str] = set()
        total, before = max(self.size(), 1), 0
        for path in self.files:
            size = path.stat().st_size
            storage = self._storage(path)
            if storage is not None:
                mine: Counter[str] = Counter()
                for fraction, batch in storage.batches(wanted):
                    mine[batch.channel.topic] += len(batch)
                    yield (before + fraction * size) / total, batch
                asked = {c.topic for c in storage.channels() if wanted(c)}
                seen |= asked
                self._note(*storage.problems)
                for topic, count in (storage.promised() or {}).items():
                    if topic in asked and mine[topic] < count:
                        self._lost(path.name, topic, mine[topic], count)
                counts += mine
            before += size
        for topic, count in (self.promised or {}).items():
            if topic in seen and counts[topic] < count:
                self._lost("metadata.yaml", topic, counts[topic], count)

    def _note(self, *notes: str) -> None:
        self.notes += [note for note in dict.fromkeys(notes) if note not in self.notes]

    def _lost(self, who: str, topic: str, have: int, promised: int) -> None:
        self._note(
            f"{self.name}: {topic}: {have} of {promised} messages could be read "
            f"({who} counts {promised}; {promised - have} are lost)"
        )

    def _storage(self, path: Path) -> Storage | None:
        """Open a file; where others remain, one that cannot be read becomes a note."""
        if path not in self._storages:
            self._folder = self._folder or tempfile.TemporaryDirectory(prefix="smp_bag_")
            try:
                self._storages[path] = open_storage(path, Path(self._folder.name))
            except BagError as error:
                if len(self.files) == 1:
                    raise
                self._storages[path] = None
                self._note(str(error))
        return self._storages[path]


def open_storage(path: Path, folder: Path) -> Storage:
    """Open a file by what it begins with, whatever it is called."""
    head = _head(path)
    problems: list[str] = []
    plain = path
    if head[:4] in (ZSTD_MAGIC, LZ4_MAGIC):
        plain = folder / path.name.removesuffix(path.suffix)
        problems = _unpack(path, plain, head[:4] == ZSTD_MAGIC)
        head = _head(plain)
    try:
        if head.startswith(mcap_file.MAGIC):
            storage: Storage = mcap_file.McapFile(plain, path.name)
        elif head.startswith(sqlite_file.MAGIC):
            storage = sqlite_file.SqliteFile(plain, path.name)
        else:
            raise BagError(f"{path}: {_what(path, head)}")
    except BagError as error:
        raise BagError("; ".join([str(error), *problems])) from None
    storage.problems[:0] = problems
    return storage


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(16)
    except OSError as error:
        raise BagError(f"{path}: cannot be read ({error.strerror})") from None


def _what(path: Path, head: bytes) -> str:
    if not head:
        return "is empty"
    if head.startswith(b"#ROSBAG V"):
        return "is a ROS 1 bag; convert it with rosbags-convert first"
    if mcap_file.MAGIC.startswith(head) or sqlite_file.MAGIC.startswith(head):
        return f"is cut off after {path.stat().st_size} bytes; nothing of it can be read"
    return "is neither an MCAP nor a SQLite bag"


def _unpack(path: Path, plain: Path, zstd: bool) -> list[str]:
    """Decompress a file block by block; return what is amiss."""

    def begin() -> Any:
        if zstd:
            return zstandard.ZstdDecompressor().decompressobj()
        return lz4.frame.LZ4FrameDecompressor()

    engine = begin()
    try:
        with path.open("rb") as packed, plain.open("wb") as out:
            while block := packed.read(1 << 16):
                while block:
                    if engine.eof:  # another frame follows
                        engine = begin()
                    out.write(engine.decompress(block))
                    block = engine.unused_data if engine.eof else b""
    except (zstandard.ZstdError, EOFError, RuntimeError, MemoryError) as error:
        return [f"{path.name}: its compression is damaged ({error})"]
    except OSError as error:
        raise BagError(f"{path}: cannot be unpacked ({error.strerror})") from None
    return [] if engine.eof else [f"{path.name}: its compression is cut off"]


def recordings(paths: Any) -> list[Recording]:
    """Find the recordings behind paths.

    Parameters
    ----------
    paths : path or iterable of paths
        A bag's folder, a folder of bags, a bare ``.mcap`` or ``.db3``, or a CSV file.

    Returns
    -------
    list of Recording
        In the order given, folders by name.

    Raises
    ------
    BagError
        When a path does not exist or holds no recording.
    """
    if isinstance(paths, (str, os.PathLike)):
        paths = [paths]
    found: list[Recording] = []
    for path in map(Path, paths):
        if not path.exists():
            raise BagError(f"{path}: does not exist")
        try:
            inside = _of_folder(path) if path.is_dir() else [Recording(path.name, [path])]
        except OSError as error:
            raise BagError(f"{path}: cannot be read ({error.strerror})") from None
        for recording in inside:
            recording.one_of_many = len(inside) > 1
        if not inside:
            raise BagError(f"{path}: holds no bag (.mcap, .db3) and no CSV file")
        found += inside
    if not found:
        raise BagError("no bag is given")
    return found


def _of_folder(path: Path) -> list[Recording]:
    """Return the recordings of a folder: one bag, or what lies in it."""
    if (path / "metadata.yaml").is_file():
        return [_bag(path)]
    here = sorted(p for p in path.iterdir() if p.is_file())
    groups: dict[str, list[Path]] = {}
    for file in _storages(here):
        split = _SPLIT.match(_stem(file))
        groups.setdefault(split[1] if split else _stem(file), []).append(file)
    name = path.resolve().name
    found = [
        Recording(
            name if len(groups) == 1 else f"{name}/{key}",
            sorted(files, key=_order),
            notes=[f"{name}: has no metadata.yaml; all its files are read"],
        )
        for key, files in groups.items()
    ]
    found += [Recording(p.name, [p]) for p in here if p.suffix.lower() in (".csv", ".tsv")]
    for folder in sorted(p for p in path.iterdir() if p.is_dir() and not p.name.startswith(".")):
        found += _of_folder(folder)
    return found


def _storages(files: Iterable[Path]) -> list[Path]:
    """Return the bag files; not a plain one beside its own compressed form, or the reverse."""
    storages = [p for p in files if p.suffix in _SUFFIXES and re.search(r"\.(mcap|db3)", p.name)]
    plain = {p.name for p in storages if p.suffix in (".mcap", ".db3")}
    return [p for p in storages if p.name in plain or p.name.removesuffix(p.suffix) not in plain]


def _stem(path: Path) -> str:
    return re.sub(r"\.(mcap|db3)(\.\w+)?$", "", path.name)


def _order(path: Path) -> tuple[str, int]:
    match = re.fullmatch(r"(.*?)_?(\d*)", _stem(path))
    assert match is not None
    return match[1], int(match[2] or 0)


def _bag(path: Path) -> Recording:
    """Return a bag by its metadata.yaml, of any version, as far as it can be trusted."""
    name = path.resolve().name
    bag = Recording(name, [])
    try:
        text = (path / "metadata.yaml").read_text("utf-8", "replace")
        information = yaml.safe_load(text)["rosbag2_bagfile_information"]
        listed = [Path(str(file)).name for file in information["relative_file_paths"]]
        bag.promised = _promise(information)
        bag.distribution = str(information.get("ros_distro") or "")
    except (yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError, OSError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        bag.notes.append(f"{name}: metadata.yaml is damaged ({reason}); all files are read")
        bag.promised, listed = None, []
    there = _storages(sorted(path.iterdir()))
    for file in listed:
        options = [file, file.removesuffix(Path(file).suffix), f"{file}.zstd", f"{file}.lz4"]
        match = next((path / o for o in options if o and (path / o).is_file()), None)
        if match is None:
            bag.notes.append(f"{name}: {file} is missing, which metadata.yaml lists")
        elif match not in bag.files:
            bag.files.append(match)
    extra = sorted((f for f in there if f not in bag.files), key=_order)
    stems = {_stem(file) for file in bag.files}
    extra = [file for file in extra if _stem(file) not in stems]
    if extra and listed:
        names = ", ".join(file.name for file in extra)
        bag.notes.append(f"{name}: {names} is not listed in metadata.yaml and is read too")
    bag.files += extra
    if not bag.files:
        raise BagError(f"{path}: " + (bag.notes[-1] if bag.notes else "holds no .mcap or .db3"))
    return bag


def _promise(information: dict[str, Any]) -> dict[str, int]:
    """Return the messages by topic; the oldest bags call the topic's entry differently."""
    counts: Counter[str] = Counter()
    for entry in information.get("topics_with_message_count") or []:
        topic = entry.get("topic_metadata") or entry.get("topic_and_type") or {}
        counts[str(topic["name"])] += int(entry["message_count"])
    return dict(counts)
