# SPDX-License-Identifier: Apache-2.0
"""Recover messages from the pages of a SQLite file with a damaged tree.

A truncated tree cannot be read from its root, since a page near the root may be lost; but every
leaf page holds whole rows.  The layout of pages, cells and
records is that of https://www.sqlite.org/fileformat2.html, sections 1.6 and 2.1.
"""

from collections.abc import Iterator
from mmap import ACCESS_READ, mmap
from pathlib import Path

Row = tuple[int, int, int, bytes]
"""id, topic_id, timestamp, data: a row of the bag's table of messages."""

_LEAF = 0x0D
_INTEGER_SIZE = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    """Return a number of one to nine bytes, and where the next begins."""
    value = 0
    for k in range(8):
        byte = data[at + k]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + k + 1
    return value << 8 | data[at + 8], at + 9


def _read_integer(data: bytes, at: int, kind: int) -> int:
    if kind in (8, 9):
        return kind - 8
    return int.from_bytes(data[at : at + _INTEGER_SIZE[kind]], "big", signed=True)


class _Pages:
    """Access to the pages of a file."""

    def __init__(self, data: mmap) -> None:
        size = int.from_bytes(data[16:18], "big")
        self.size = 65536 if size == 1 else size
        self.usable = self.size - data[20]
        self.data = data

    def read(self, number: int) -> bytes:
        page = self.data[(number - 1) * self.size : number * self.size]
        if len(page) < self.size:
            raise IndexError("the page is cut off")
        return page

    def payload(self, page: bytes, at: int, size: int) -> bytes:
        """Return a cell's content, which may go on in overflow pages."""
        if size > len(self.data):
            raise IndexError("the row is longer than the file")
        most = self.usable - 35
        if size <= most:
            return page[at : at + size]
        least = (self.usable - 12) * 32 // 255 - 23
        local = least + (size - least) % (self.usable - 4)
        local = local if local <= most else least
        parts = [page[at : at + local]]
        following = int.from_bytes(page[at + local : at + local + 4], "big")
        left = size - local
        while left > 0:
            if not following:
                raise IndexError("the chain of pages is broken")
            more = self.read(following)
            following = int.from_bytes(more[:4], "big")
            parts.append(more[4 : 4 + min(left, self.usable - 4)])
            left -= len(parts[-1])
        return b"".join(parts)


def _read_row(pages: _Pages, page: bytes, at: int) -> Row | None:
    """Return the message in a cell, or None where it is something else."""
    size, at = _read_varint(page, at)
    key, at = _read_varint(page, at)
    record = pages.payload(page, at, size)
    head, position = _read_varint(record, 0)
    kinds = []
    while position < head:
        kind, position = _read_varint(record, position)
        kinds.append(kind)
    if len(kinds) != 4 or kinds[0] != 0 or kinds[3] < 12 or kinds[3] % 2:
        return None
    if kinds[1] not in _INTEGER_SIZE or kinds[2] not in _INTEGER_SIZE:
        return None
    topic = _read_integer(record, head, kinds[1])
    at = head + _INTEGER_SIZE[kinds[1]]
    stamp = _read_integer(record, at, kinds[2])
    at += _INTEGER_SIZE[kinds[2]]
    length = (kinds[3] - 12) // 2
    data = record[at : at + length]
    return (key, topic, stamp, data) if len(data) == length else None


def salvage(path: Path) -> Iterator[list[Row]]:
    """Read the messages of every whole leaf page, in the order of the file."""
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        pages = _Pages(data)
        if pages.size < 512 or pages.usable < 480:
            return
        for number in range(2, len(data) // pages.size + 1):
            page = pages.read(number)
            if page[0] != _LEAF:
                continue
            rows = []
            for k in range(int.from_bytes(page[3:5], "big")):
                at = int.from_bytes(page[8 + 2 * k : 10 + 2 * k], "big")
                try:
                    row = _read_row(pages, page, at)
                except IndexError:
                    continue
                if row is not None:
                    rows.append(row)
            if rows:
                yield rows
