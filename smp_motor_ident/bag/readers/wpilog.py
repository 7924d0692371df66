# SPDX-License-Identifier: Apache-2.0
"""WPILib data logs (``.wpilog``): entries by name, each with its own times.

The format is that of github.com/wpilibsuite/allwpilib, ``wpiutil/doc/datalog.adoc``, version 1.0:
records of entry, payload size and microseconds, each of as many bytes as the record's first
byte says; entry 0 holds control records that start and finish entries.  The metadata of an entry is
its unit where SysId writes the log, and has a key ``unit`` where AdvantageKit does.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from smp_motor_ident.bag.readers.format import Format, Tables, check_width
from smp_motor_ident.bag.storage import TABLE, Channel, Table, gather
from smp_motor_ident.bag.units import parse_unit
from smp_motor_ident.bag.unpack import Budget
from smp_motor_ident.errors import BagError

MAGIC = b"WPILOG"
_KINDS = {"double": "<f8", "float": "<f4", "int64": "<i8", "boolean": "u1"}


@dataclass
class _Entry:
    """One entry: its type, and the positions of its records."""

    name: str
    kind: str
    unit: str
    times: list[int] = field(default_factory=list)
    begins: list[int] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)


class _Wpilog(Tables):
    """One ``.wpilog`` file."""

    def __init__(self, path: Path, name: str, budget: Budget) -> None:
        super().__init__(path, name)
        self._data = path.read_bytes()
        self._entries: dict[str, _Entry] = {}
        if len(self._data) < 12 or self._data[7] != 1:
            raise BagError(f"{name}: is not a data log of version 1")
        self._walk(12 + int.from_bytes(self._data[8:12], "little"))

    def _walk(self, at: int) -> None:
        """Store the position of every numeric record."""
        data, active, end = self._data, dict[int, _Entry](), len(self._data)
        while at < end:
            sizes = data[at]
            a = at + 2 + (sizes & 3)
            b = a + 1 + (sizes >> 2 & 3)
            c = b + 1 + (sizes >> 4 & 7)
            size = int.from_bytes(data[a:b], "little")
            if c + size > end:
                self._damage(f"cut off at byte {at} of {end}")
                return
            key = int.from_bytes(data[at + 1 : a], "little")
            if key == 0:
                self._control(data[c : c + size], active)
            elif (entry := active.get(key)) is not None:
                entry.times.append(int.from_bytes(data[b:c], "little"))
                entry.begins.append(c)
                entry.sizes.append(size)
            at = c + size

    def _control(self, body: bytes, active: dict[int, _Entry]) -> None:
        """Start or finish an entry."""
        key = int.from_bytes(body[1:5], "little")
        if body[:1] == b"\1":
            active.pop(key, None)
        elif body[:1] == b"\0":
            texts, at = [], 5
            for _ in range(3):
                size = int.from_bytes(body[at : at + 4], "little")
                texts.append(body[at + 4 : at + 4 + size].decode("utf-8", "replace"))
                at += 4 + size
            if texts[1].removesuffix("[]") in _KINDS:
                entry = _Entry(texts[0], texts[1], _unit(texts[2]))
                active[key] = self._entries.setdefault(texts[0], entry)
                check_width(len(self._entries), self.name, "entries")

    def channels(self) -> list[Channel]:
        """Return the entries of numbers."""
        found = []
        for k, (name, entry) in enumerate(sorted(self._entries.items())):
            fields = self._fields(entry)
            units = dict.fromkeys(fields, entry.unit)
            found.append(Channel(k, name, entry.kind, TABLE, fields=fields, units=units))
        return found

    @staticmethod
    def _fields(entry: _Entry) -> tuple[str, ...]:
        if not entry.kind.endswith("[]"):
            return ("value",)
        width = np.dtype(_KINDS[entry.kind[:-2]]).itemsize
        return tuple(f"value[{k}]" for k in range(min(max(entry.sizes, default=0) // width, 64)))

    def table(self, topic: str, fields: Sequence[str]) -> Table:
        """Return an entry's values; those of a wrong length are left out."""
        entry = self._entries[topic]
        kind = np.dtype(_KINDS[entry.kind.removesuffix("[]")])
        index = [int(f[6:-1]) if f.startswith("value[") else 0 for f in fields]
        least = kind.itemsize * (max(index) + 1)
        size, begin = np.array(entry.sizes, np.int64), np.array(entry.begins, np.int64)
        sound = size >= least if entry.kind.endswith("[]") else size == least
        log = 1000 * np.array(entry.times, np.uint64).astype(np.int64)
        raw = np.frombuffer(self._data, np.uint8)
        places = {name: begin[sound] + k * kind.itemsize for name, k in zip(fields, index)}
        columns = {name: gather(raw, at, kind.str) for name, at in places.items()}
        return Table(log[sound], None, columns)


def _unit(metadata: str) -> str:
    """Return the unit that an entry's metadata states; empty without one."""
    if metadata.startswith("{"):
        try:
            metadata = str(json.loads(metadata).get("unit", ""))
        except (ValueError, RecursionError):
            return ""
    return parse_unit(metadata) or ""


FORMAT = Format("WPILib data log", (".wpilog",), MAGIC, _Wpilog)
