# SPDX-License-Identifier: Apache-2.0
"""Parse one message into the positions of its numbers, strings and lengths.

CDR aligns every field to its size, counted from the end of the four bytes of encapsulation.  ROS 1
neither aligns fields nor has these bytes.
"""

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from smp_motor_ident.bag.types import Definitions
from smp_motor_ident.errors import BagError

_NUMBERS = ("float32", "float64", *(f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32, 64)))
_KINDS = {name: np.dtype(name).str[1:] for name in _NUMBERS}
_KINDS |= dict.fromkeys(("bool", "byte", "char", "octet"), "u1")
_MAX_ELEMENTS = 100_000  # messages inside one
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
    """A string and its position."""

    value: str
    begin: int
    end: int


@dataclass
class Template:
    """Positions of the values and lengths of one message."""

    root: dict[str, Any]
    lengths: list[int]


def parse_path(path: str) -> list[str | int]:
    """Split a field path such as ``velocity[left_wheel_joint]`` or ``a.b[2].c``."""
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
    """Parser of one message."""

    def __init__(self, data: bytes, definitions: Definitions, ros1: bool) -> None:
        if not ros1 and (len(data) < 4 or data[0] != 0 or data[1] > 1):
            raise DecodeError(f"its first bytes are {data[:4].hex()}, not those of CDR")
        self.data, self.definitions, self.position = data, definitions, 0 if ros1 else 4
        self.ros1 = ros1
        self.order = "<" if ros1 or data[1] else ">"
        self.lengths: list[int] = []
        self.left = min(_MAX_ELEMENTS, 64 + 4 * len(data))

    def parse(self, name: str) -> Template:
        root = self.message(name)
        rest = len(self.data) - self.position
        if not 0 <= rest <= (0 if self.ros1 else 3):  # writers may pad to a multiple of four
            raise DecodeError(f"{rest} bytes follow its last field")
        return Template(root, self.lengths)

    def message(self, name: str) -> dict[str, Any]:
        fields = self.definitions[name]
        if not fields and not self.ros1:  # ROS 2 gives an empty message one byte
            self.take(1, 1)
        self.left -= 1
        if self.left < 0:
            raise DecodeError("it claims more parts than its length can hold")
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
        """Return the position of the next bytes, and skip them."""
        begin = self._aligned(alignment)
        if begin + size > len(self.data):
            raise DecodeError(f"it ends at byte {len(self.data)}, inside a field")
        self.position = begin + size
        return begin

    def _aligned(self, alignment: int) -> int:
        return self.position + (0 if self.ros1 else -(self.position - 4) % alignment)

    def length(self) -> int:
        begin = self.take(4, 4)
        self.lengths.append(begin)
        return int(struct.unpack_from(f"{self.order}I", self.data, begin)[0])

    def text(self) -> Text:
        begin = self._aligned(4)
        size = self.length()
        at = self.take(size, 1)
        end = size if self.ros1 else max(size - 1, 0)  # CDR ends a string with a zero
        value = self.data[at : at + end].decode("utf-8", "replace")
        return Text(value, begin, at + size)

    def numbers(self, name: str, count: int | None) -> Number:
        if name not in _KINDS:
            raise DecodeError(f"a field of type {name} cannot be read")
        kind = np.dtype(_KINDS[name])
        if count == 0:
            return Number(self.position, kind.str, 0)
        begin = self.take(kind.itemsize * (1 if count is None else count), kind.itemsize)
        return Number(begin, self.order + _KINDS[name], count)


def parse_message(data: bytes, name: str, definitions: Definitions, encoding: str) -> Template:
    """Return the positions in a message; the encoding is ``cdr`` or ``ros1``."""
    try:
        return _Parser(data, definitions, encoding == "ros1").parse(name)
    except RecursionError:
        raise DecodeError("its type is nested too deeply") from None


def find_name_lists(parent: Mapping[str, Any]) -> dict[str, list[Text]]:
    """Return the lists of strings of a message, those called a name first."""
    lists = {
        key: value
        for key, value in parent.items()
        if isinstance(value, list) and value and all(isinstance(v, Text) for v in value)
    }
    return dict(sorted(lists.items(), key=lambda item: "name" not in item[0]))


def locate(template: Template, path: Sequence[str | int]) -> tuple[Number | None, list[Text]]:
    """Find a number in a template."""
    here: Any = template.root
    parent: Mapping[str, Any] = template.root
    names: list[Text] = []
    for step in path:
        if isinstance(step, str) and not step.startswith("["):
            if not isinstance(here, dict):
                raise BagError(f"has no field {step!r} there")
            if step not in here:
                raise BagError(f"does not exist: no {step!r} among {', '.join(here)}")
            parent, here = here, here[step]
            continue
        index = step if isinstance(step, int) else _index_of(step[1:], parent, here, names)
        here = None if index is None else _element(here, index)
        if here is None:
            return None, names
    if not isinstance(here, Number):
        raise BagError("is not a number")
    if here.count is not None:
        raise BagError("is an array; say which element, such as [0] or [name]")
    return here, names


def _element(here: Any, index: int) -> Any:
    """Return an array's element, or None where the array is too short."""
    if isinstance(here, list):
        return here[index] if index < len(here) else None
    if not isinstance(here, Number) or here.count is None:
        raise BagError("is not an array, but an index is given")
    if index >= here.count:
        return None
    return Number(here.offset + index * np.dtype(here.kind).itemsize, here.kind)


def _index_of(name: str, parent: Mapping[str, Any], here: Any, used: list[Text]) -> int | None:
    """Return the index of a name among the names next to an array, or in its elements."""
    beside = find_name_lists(parent)
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
        raise BagError(f"has no list of names, so [{name}] is undefined; use an index such as [0]")
    used.extend(text for texts in beside.values() for text in texts)
    return None
