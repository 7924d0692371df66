# SPDX-License-Identifier: Apache-2.0
"""Define the interface of a format and its entry in the registry."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.bag.storage import TABLE, Batch, Channel, Table, note_damage
from smp_motor_ident.bag.unpack import Budget
from smp_motor_ident.errors import BagError
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import MAX_COLUMNS


def check_width(count: int, name: str, what: str = "columns") -> None:
    """Raise `BagError` for more columns or topics than a robot's log can have."""
    if count > MAX_COLUMNS:
        raise BagError(f"{name}: has more than {MAX_COLUMNS:.0f} {what}; keep those of the motors")


class Source(ABC):
    """One opened file; ``problems`` collects losses while it is read."""

    def __init__(self, path: Path, name: str) -> None:
        self.path = path
        self.name = name  # for messages, where ``path`` is a temporary copy
        self.problems: list[Finding] = []

    @abstractmethod
    def channels(self) -> list[Channel]:
        """Return the channels, reading the whole file where it has no index."""

    def _damage(self, text: str) -> None:
        self.problems.append(note_damage(f"{self.name}: {text}"))


class Messages(Source):
    """A file of serialized messages, with channels found by reading all of them."""

    def __init__(self, path: Path, name: str, budget: Budget) -> None:
        super().__init__(path, name)
        self._budget = budget
        self._channels: dict[int, Channel] = {}
        self._scanned = False

    def channels(self) -> list[Channel]:
        """Return the channels of the file."""
        if not self._scanned:
            for _ in self.batches(lambda _: False):
                pass
        return [self._channels[key] for key in sorted(self._channels)]

    def declared(self) -> dict[str, int] | None:
        """Return the number of messages by topic if the file states it."""
        return None

    @abstractmethod
    def batches(self, wanted: Callable[[Channel], bool]) -> Iterator[list[Batch]]:
        """Yield blocks of consecutive messages, channel by channel."""


class Tables(Source):
    """A file of columns; its channels have the encoding `TABLE` and name their fields."""

    @abstractmethod
    def table(self, topic: str, fields: Sequence[str]) -> Table:
        """Return columns of a topic; ``log`` is None where the time is a column, too."""

    def _check(self, fields: Sequence[str], there: Collection[str]) -> None:
        for name in fields:
            if name not in there:
                raise BagError(
                    f"{self.path}: has no column {name!r}; it has {', '.join(there)}: map one of "
                    "these in its place, or leave that signal out for all files"
                )


@dataclass(eq=False)
class ColumnFile(Tables):
    """A file of columns, one table of the topic ``""``; ``dates`` are columns of nanoseconds."""

    path: Path
    name: str
    columns: Mapping[str, NDArray[Any]]
    units: Mapping[str, str] = field(default_factory=dict)
    dates: Collection[str] = ()
    problems: list[Finding] = field(default_factory=list)
    wheel_radius: float = 0.0

    def __post_init__(self) -> None:
        if not self.columns:
            raise BagError(f"{self.name}: holds no column of numbers; give a table of samples")
        check_width(len(self.columns), self.name)

    def channels(self) -> list[Channel]:
        """Return the one table."""
        lengths = tuple(column.size for column in self.columns.values())
        lengths = lengths if len(set(lengths)) > 1 else ()
        fields = tuple(self.columns)
        channel = Channel(0, "", "", TABLE, fields=fields, units=self.units, lengths=lengths)
        return [replace(channel, wheel_radius=self.wheel_radius)]

    def table(self, topic: str, fields: Sequence[str]) -> Table:
        """Return columns; all must have the same length."""
        self._check(fields, self.columns)
        columns = {name: self.columns[name] for name in fields}
        sizes = {name: column.size for name, column in columns.items()}
        if len(set(sizes.values())) > 1:
            lengths = ", ".join(f"{name} {size}" for name, size in sizes.items())
            raise BagError(
                f"{self.path}: its columns differ in length: {lengths}; map columns of one length"
            )
        exact = frozenset(n for n in fields if n in self.dates)
        return Table(None, None, {n: np.asarray(c) for n, c in columns.items()}, exact=exact)


@dataclass(frozen=True)
class Format:
    """A kind of file: how to recognise and open it."""

    name: str  # for messages
    suffixes: tuple[str, ...]  # names of such files end so, in lower case
    # First bytes, required whatever the name; empty for plain text, recognised by name only.
    magic: bytes
    # ``open(path, name, budget)``; raises `BagError`
    open: Callable[[Path, str, Budget], Messages | Tables]
    tables: bool = True  # whether it holds columns of numbers instead of serialized messages
