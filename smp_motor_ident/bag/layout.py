"""Where a message's numbers lie: one template decodes all messages of the same layout at once.

CDR puts a field behind everything that precedes it, aligned to its size from the byte
after the four of the encapsulation.  So the position of a number depends on nothing but the
lengths of the strings and sequences before it: messages of one topic that agree in these have
their numbers at the same places, and one indexing per field reads them all.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from smp_motor_ident.bag.storage import Batch, gather
from smp_motor_ident.bag.types import Definitions
from smp_motor_ident.errors import BagError

_KINDS = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "octet": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
_STEP = re.compile(r"(\w+)((?:\[[^\]]*\])*)")


class DecodeError(Exception):
    """The bytes are not a message of the type."""


@dataclass(frozen=True)
class Number:
    """A number, or ``count`` of them side by side, at a byte of the message."""

    offset: int
    kind: str
    count: int | None = None


@dataclass(frozen=True)
class Text:
    """A string and the bytes where it stands."""

    value: str
    begin: int
    end: int


@dataclass
class Template:
    """One message taken apart: positions instead of values.

    ``lengths`` are the positions of all lengths of strings and sequences.
    """

    root: dict[str, Any]
    lengths: list[int] = field(default_factory=list)
    order: str = "<"


def parse_path(path: str) -> list[str | int]:
    """Split a field path such as ``velocity[left_wheel_joint]`` or ``a.b[2].c``.

    Parameters
    ----------
    path : str
        Fields joined by dots; an index or a name in brackets.

    Returns
    -------
    list of str or int
        Steps; a name in brackets keeps its opening bracket.

    Raises
    ------
    BagError
        When it is no such path.
    """
    steps: list[str | int] = []
    position = 0
    while position < len(path):
        match = _STEP.match(path, position)
        if match is None:
            break
        steps.append(match[1])
        for key in re.findall(r"\[([^\]]*)\]", match[2]):
            key = key.rpartition("=")[2].strip().strip("'\"")
            steps.append(int(key) if re.fullmatch(r"\d+", key) else "[" + key)
        position = match.end()
        if position == len(path):
            return steps
        if path[position] != ".":
            break
        position += 1
    raise BagError(f"field path {path!r}: write fields with dots and [index] or [name]")


class _Parser:
    """Takes one message apart."""

    def __init__(self, data: bytes, definitions: Definitions) -> None:
        if len(data) < 4 or data[0] != 0 or data[1] > 1:
            raise DecodeError(f"its first bytes are {data[:4].hex()}, not those of CDR")
        self.data, self.definitions, self.position = data, definitions, 4
        self.order = "<" if data[1] else ">"
        self.lengths: list[int] = []

    def parse(self, name: str) -> Template:
        root = self.message(name)
        rest = len(self.data) - self.position
        if not 0 <= rest <= 3:  # writers may pad to a multiple of four
            raise DecodeError(f"{rest} bytes are left behind its last field")
        return Template(root, self.lengths, self.order)

    def message(self, name: str) -> dict[str, Any]:
        fields = self.definitions[name]
        if not fields:  # ROS gives an empty message one byte
            self.take(1, 1)
        return {key: self.value(description) for key, description in fields}

    def value(self, description: Any) -> Any:
        kind, detail = description
        if kind == Nodetype.BASE:
            return self.text() if detail[0] == "string" else self.numbers(detail[0], None)
        if kind == Nodetype.NAME:
            return self.message(detail)
        element, count = detail
        if kind == Nodetype.SEQUENCE:
            count = self.length()
        if element[0] == Nodetype.BASE and element[1][0] != "string":
            return self.numbers(element[1][0], count)
        if count > len(self.data):
            raise DecodeError(f"a sequence of {count} is longer than the message")
        return [self.value(element) for _ in range(count)]

    def take(self, size: int, alignment: int) -> int:
        """Return where the next bytes begin, and go behind them."""
        begin = self.position + (-(self.position - 4)) % alignment
        if begin + size > len(self.data):
            raise DecodeError(f"it ends at byte {len(self.data)}, inside a field")
        self.position = begin + size
        return begin

    def length(self) -> int:
        begin = self.take(4, 4)
        self.lengths.append(begin)
        return int.from_bytes(
            self.data[begin : begin + 4], "little" if self.order == "<" else "big"
        )

    def text(self) -> Text:
        begin = self.position + (-(self.position - 4)) % 4
        size = self.length()
        at = self.take(size, 1)
        value = self.data[at : at + max(size - 1, 0)].decode("utf-8", "replace")
        return Text(value, begin, at + size)

    def numbers(self, name: str, count: int | None) -> Number:
        if name not in _KINDS:
            raise DecodeError(f"a field of type {name} cannot be read")
        kind = np.dtype(_KINDS[name])
        if count == 0:
            return Number(self.position, kind.str, 0)
        begin = self.take(kind.itemsize * (1 if count is None else count), kind.itemsize)
        return Number(begin, self.order + _KINDS[name], count)


def take_apart(data: bytes, name: str, definitions: Definitions) -> Template:
    """Return where everything in a message stands.

    Parameters
    ----------
    data : bytes
        The serialized message.
    name : str
        Its type.
    definitions : Definitions
        Of that type and all in it.

    Returns
    -------
    Template
        Positions instead of values.

    Raises
    ------
    DecodeError
        When the bytes are no such message.
    """
    return _Parser(data, definitions).parse(name)


def names_beside(parent: Mapping[str, Any]) -> dict[str, list[Text]]:
    """Return the lists of strings of a message, those called a name first.

    Parameters
    ----------
    parent : mapping
        A message of a template.

    Returns
    -------
    dict of str to list of Text
        By field.
    """
    lists = {
        key: value
        for key, value in parent.items()
        if isinstance(value, list) and value and all(isinstance(v, Text) for v in value)
    }
    return dict(sorted(lists.items(), key=lambda item: "name" not in item[0]))


def locate(template: Template, path: Sequence[str | int]) -> tuple[Number | None, list[Text]]:
    """Find a number in a template.

    Parameters
    ----------
    template : Template
        Of one message.
    path : sequence of str or int
        From `parse_path`.

    Returns
    -------
    number : Number or None
        None where the message lacks the name or the index that is asked for.
    names : list of Text
        Names on which the place depends.

    Raises
    ------
    BagError
        When no message of the type can have it.
    """
    here: Any = template.root
    parent: Mapping[str, Any] = template.root
    names: list[Text] = []
    for step in path:
        if isinstance(step, str) and not step.startswith("["):
            if not isinstance(here, dict):
                raise BagError(f"has no field {step!r} there")
            if step not in here:
                raise BagError(f"has no field {step!r}; it has {', '.join(here)}")
            parent, here = here, here[step]
            continue
        index = step if isinstance(step, int) else _index_of(step[1:], parent, here, names)
        here = None if index is None else _element(here, index)
        if here is None:
            return None, names
    if not isinstance(here, Number):
        raise BagError("is no number")
    if here.count is not None:
        raise BagError("is an array; say which element, such as [0] or [name]")
    return here, names


def _element(here: Any, index: int) -> Any:
    """Return an array's element, or None where the array is too short."""
    if isinstance(here, list):
        return here[index] if index < len(here) else None
    if not isinstance(here, Number) or here.count is None:
        raise BagError("is no array where an index is given")
    if index >= here.count:
        return None
    return Number(here.offset + index * np.dtype(here.kind).itemsize, here.kind)


def _index_of(name: str, parent: Mapping[str, Any], here: Any, used: list[Text]) -> int | None:
    """Return the index of a name in the strings beside an array, or inside its elements."""
    beside = names_beside(parent)
    for texts in beside.values():
        if name in (values := [text.value for text in texts]):
            used.extend(texts)
            return values.index(name)
    if isinstance(here, list) and here and isinstance(here[0], dict):
        for k, element in enumerate(here):
            texts = [value for value in element.values() if isinstance(value, Text)][:1]
            used.extend(texts)
            if texts and texts[0].value == name:
                return k
        return None
    if not beside and not any(isinstance(v, list) for v in parent.values()):
        raise BagError(f"has no names beside it, so that [{name}] says nothing; use [0]")
    used.extend(text for texts in beside.values() for text in texts)
    return None


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the wanted numbers lie in all messages that agree with one template."""

    length: int
    checks: tuple[tuple[int, int], ...]
    numbers: tuple[Number | None, ...]

    def matches(self, batch: Batch) -> NDArray[np.bool_]:
        """Return which messages have this layout.

        Parameters
        ----------
        batch : Batch
            Messages of the type.

        Returns
        -------
        ndarray of bool
            One per message.
        """
        same: NDArray[np.bool_] = np.equal(batch.length, self.length)
        for offset, word in self.checks:
            if not same.any():
                return same
            at = np.where(same, batch.offset, batch.offset[int(np.argmax(same))])
            same &= gather(batch.data, at + offset, "<u4") == word
        return same


class Decoder:
    """Reads the wanted fields of one channel, template by template.

    Parameters
    ----------
    name : str
        Message type.
    candidates : sequence of Definitions
        What that type may be; the first that fits a message is used from then on.
    paths : sequence of str
        Fields that are wanted.
    """

    KEPT = 64

    def __init__(self, name: str, candidates: Sequence[Definitions], paths: Sequence[str]) -> None:
        self.name = name
        self.paths = tuple(paths)
        self._steps = [parse_path(path) for path in paths]
        self._candidates = list(candidates)
        self._layouts: list[Layout] = []
        self.undecodable = 0
        self.reason = ""

    def decode(self, batch: Batch) -> Decoded:
        """Decode a batch.

        Parameters
        ----------
        batch : Batch
            Messages of this decoder's channel.

        Returns
        -------
        Decoded
            Columns; messages that are no such messages are missing and counted.

        Raises
        ------
        BagError
            When a path does not exist in the type.
        """
        rows: list[NDArray[np.int64]] = []
        columns: list[list[NDArray[Any] | None]] = []
        left: NDArray[np.int64] = np.arange(len(batch))
        while left.size:
            rest = batch.take(left)
            for layout in self._layouts:
                if (same := layout.matches(rest)).any():
                    rows.append(left[same])
                    columns.append(_read(rest, same, layout))
                    left = left[~same]
                    rest = batch.take(left)
                if not left.size:
                    break
            if left.size and not self._learn(rest.message(0)):
                self.undecodable += 1
                left = left[1:]
        return Decoded.joined(rows, columns, len(self.paths))

    def _learn(self, data: bytes) -> bool:
        """Take a message as template; False where it cannot be taken apart."""
        template = None
        for definitions in self._candidates:
            try:
                template = take_apart(data, self.name, definitions)
            except DecodeError as error:
                self.reason = self.reason or str(error)
                continue
            self._candidates = [definitions]
            break
        if template is None:
            return False
        numbers: list[Number | None] = []
        texts: list[Text] = []
        for path, steps in zip(self.paths, self._steps):
            try:
                number, used = locate(template, steps)
            except BagError as error:
                raise BagError(f"{self.name}: field {path!r} {error}") from None
            numbers.append(number)
            texts += used
        # Everything up to the last wanted number must have the template's lengths; beyond
        # it, the message's whole length is enough.
        last = max((n.offset for n in numbers if n is not None), default=len(data))
        positions = {at for at in template.lengths if at < last}
        for text in texts:
            positions.update(range(text.begin, max(text.end - 3, text.begin + 1), 4))
            if text.end - text.begin > 4:
                positions.add(text.end - 4)
        words = tuple((at, int.from_bytes(data[at : at + 4], "little")) for at in sorted(positions))
        self._layouts.insert(0, Layout(len(data), words, tuple(numbers)))
        del self._layouts[self.KEPT :]
        return True


@dataclass(frozen=True, eq=False)
class Decoded:
    """Columns of a batch.

    ``rows`` tells for each entry which message it comes from; a column is None where no
    message had it, and ``present`` tells which entries hold a number.
    """

    rows: NDArray[np.int64]
    columns: list[NDArray[Any] | None]
    present: list[NDArray[np.bool_] | None]

    @classmethod
    def joined(
        cls,
        rows: list[NDArray[np.int64]],
        parts: list[list[NDArray[Any] | None]],
        width: int,
    ) -> Decoded:
        """Return what several layouts gave as one, in the order of the messages.

        Parameters
        ----------
        rows : list of ndarray of int64
            Indices of the messages of each layout.
        parts : list of list of ndarray or None
            The columns that each layout gave; None: a column that it does not have.
        width : int
            Number of columns.

        Returns
        -------
        Decoded
            All of them, sorted by message.
        """
        if not rows:
            return cls(np.zeros(0, np.int64), [None] * width, [None] * width)
        if len(rows) == 1:
            return cls(rows[0], parts[0], [None] * width)
        every = np.concatenate(rows)
        order = np.argsort(every, kind="stable")
        columns: list[NDArray[Any] | None] = []
        present: list[NDArray[np.bool_] | None] = []
        for k in range(width):
            had = [part[k] for part in parts]
            if all(column is None for column in had):
                columns.append(None)
                present.append(None)
                continue
            filled = [np.zeros(r.size) if c is None else c for r, c in zip(rows, had)]
            kinds = {column.dtype for column in had if column is not None}
            kind = kinds.pop() if len(kinds) == 1 else np.dtype(np.float64)
            columns.append(np.concatenate([f.astype(kind, copy=False) for f in filled])[order])
            flags = [np.full(r.size, c is not None) for r, c in zip(rows, had)]
            present.append(
                None if all(c is not None for c in had) else np.concatenate(flags)[order]
            )
        return cls(every[order], columns, present)


def _read(batch: Batch, which: NDArray[np.bool_], layout: Layout) -> list[NDArray[Any] | None]:
    """Return the columns of the messages that have the layout."""
    offset = batch.offset if which.all() else batch.offset[which]
    return [
        None if number is None else gather(batch.data, offset + number.offset, number.kind)
        for number in layout.numbers
    ]
