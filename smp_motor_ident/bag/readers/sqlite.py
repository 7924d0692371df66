# SPDX-License-Identifier: Apache-2.0
"""SQLite bags of every rosbag2 schema, whole or cut off."""

import shutil
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import numpy as np

from smp_motor_ident.bag.readers.format import Format, Messages
from smp_motor_ident.bag.salvage import salvage
from smp_motor_ident.bag.storage import Batch, Channel, join, message_type
from smp_motor_ident.bag.unpack import Budget, make_temporary_folder
from smp_motor_ident.errors import BagError

MAGIC = b"SQLite format 3\0"
_MAX_BLOCK_ROWS = 8192
_MIN_ROW_BYTES = 64  # minimum size of a row [byte]
_TABLES = ("topics", "messages", "message_definitions")
_NO_ID = -(2**63)
_MAX_BLOCK_BYTES = 1 << 25


class _SqliteFile(Messages):
    """One ``.db3`` file, which is not changed."""

    def __init__(self, path: Path, name: str, budget: Budget) -> None:
        super().__init__(path, name, budget)
        self._cut_off = False
        self._path_read = self._apply_journal()
        self._database = self._connect(self._path_read)
        try:
            self._topics = self._read_channels()
        except (sqlite3.Error, UnicodeDecodeError, TypeError) as error:
            reasons = "; ".join([" ".join(str(error).split()), *(p.message for p in self.problems)])
            raise BagError(f"{self.name}: not a readable bag ({reasons})") from None

    def _apply_journal(self) -> Path:
        """Return the file, or a copy with its journal applied if one lies next to it.

        A killed recorder leaves its last messages there, and SQLite must write to apply them.
        """
        beside = (self.path.with_name(self.path.name + end) for end in ("-wal", "-journal"))
        journals = [path for path in beside if path.is_file() and path.stat().st_size]
        if not journals:
            return self.path
        copy = make_temporary_folder(self) / self.path.name
        for original in (self.path, *journals):
            shutil.copyfile(original, copy.with_name(original.name))
        self._damage(f"was not closed; its journal {journals[0].name} was applied to a copy")
        return copy

    def _connect(self, path: Path) -> sqlite3.Connection:
        mode = "immutable=1" if path == self.path else "mode=rw"
        database = sqlite3.connect(f"file:{quote(str(path.resolve()))}?{mode}", uri=True)
        if hasattr(database, "setlimit"):  # limit 0 is the length of a blob
            database.setlimit(0, path.stat().st_size + (1 << 20))
        database.text_factory = lambda text: text.decode("utf-8", "replace")
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(100)
        page = int.from_bytes(head[16:18], "big")
        page = 65536 if page == 1 else page
        pages = int.from_bytes(head[28:32], "big")
        if path == self.path and size < pages * page:
            self._damage(f"cut off at byte {size} of {pages * page} that it had")
            self._cut_off = True
            # With this, SQLite reads a file shorter than stated in its header.
            database.execute("PRAGMA writable_schema=ON")
        return database

    def _read_channels(self) -> list[Channel]:
        columns = {row[1] for row in self._database.execute("PRAGMA table_info(topics)")}
        if not {"id", "name", "type"} <= columns:
            raise sqlite3.DatabaseError("it has no table of topics")
        query = "SELECT name FROM sqlite_master WHERE type != 'table' AND sql IS NOT NULL"
        views = [name for (name,) in self._database.execute(query) if str(name).lower() in _TABLES]
        if views:  # views may have endless rows
            raise sqlite3.DatabaseError(f"its {views[0]} are not a table")
        definitions: dict[str, tuple[str, str]] = {}
        if self._database.execute("PRAGMA table_info(message_definitions)").fetchall():
            query = "SELECT topic_type, encoded_message_definition, encoding"
            try:
                for kind, *given in self._database.execute(f"{query} FROM message_definitions"):
                    definitions[message_type(kind)] = tuple(given)
            except sqlite3.DatabaseError as error:
                self._damage(f"its definitions cannot be read ({error})")
        names = ("serialization_format", "offered_qos_profiles")
        optional = ", ".join(name if name in columns else "''" for name in names)
        rows = self._database.execute(f"SELECT id, name, type, {optional} FROM topics ORDER BY id")
        channels = []
        for key, topic, kind, encoding, qos in rows:
            own = definitions.get(message_type(kind), ("", ""))
            channels.append(
                Channel(key, topic, message_type(kind), encoding or "cdr", *own, qos=qos)
            )
        return channels

    def channels(self) -> list[Channel]:
        """Return the topics of the file."""
        return self._topics

    def batches(self, wanted: Callable[[Channel], bool]) -> Iterator[list[Batch]]:
        """Read the messages in the order in which they were written."""
        asked = {channel.id: channel for channel in self._topics if wanted(channel)}
        if not asked:
            return
        last = _NO_ID
        try:
            if self._cut_off:
                raise sqlite3.DatabaseError("cut off")
            for last, batches in self._read_blocks(asked):  # noqa: B007 (where damage begins)
                yield batches
        except sqlite3.DatabaseError as error:
            if not self._cut_off:
                where = "before its first message" if last == _NO_ID else f"behind message {last}"
                self._damage(f"damaged {where} ({error})")
            for rows in salvage(self._path_read):  # of single pages, after the last of the tree
                wanted_rows = [row for row in rows if row[0] > last and row[1] in asked]
                self._budget.take(sum(len(row[3]) for row in wanted_rows))
                if wanted_rows:
                    yield self._split(wanted_rows, asked)

    def _read_blocks(self, asked: dict[int, Channel]) -> Iterator[tuple[int, list[Batch]]]:
        """Yield the number of the last row, and a block of rows by topic."""
        ids = ",".join(str(key) for key in asked)
        among = "" if len(asked) == len(self._topics) else f"WHERE topic_id IN ({ids}) "
        query = f"SELECT id, topic_id, timestamp, data FROM messages {among}ORDER BY id"
        rows: list[tuple[int, int, int, bytes]] = []
        last, size = _NO_ID, 0
        for row in self._database.execute(query):
            if not isinstance(row[0], int) or row[0] <= last:  # damaged pages may repeat rows
                raise sqlite3.DatabaseError("its rows are out of order")
            last = row[0]
            rows.append(row)
            size += _MIN_ROW_BYTES + (len(row[3]) if isinstance(row[3], (bytes, str)) else 0)
            if size > _MAX_BLOCK_BYTES or len(rows) == _MAX_BLOCK_ROWS:
                self._budget.take(size)
                yield last, self._split(rows, asked)
                rows, size = [], 0
        self._budget.take(size)
        if rows:
            yield last, self._split(rows, asked)

    def _split(
        self, rows: list[tuple[int, int, int, bytes]], asked: dict[int, Channel]
    ) -> list[Batch]:
        """Return rows as batches, topic by topic."""
        _, keys, times, blobs = zip(*rows)
        every = next(iter(asked.values()))
        try:
            joined = join(every, list(blobs), np.array(times, np.int64))
        except (TypeError, OverflowError):
            sound = [r for r in rows if isinstance(r[3], bytes) and isinstance(r[2], int)]
            self._damage(f"{len(rows) - len(sound)} messages without data were left out")
            return self._split(sound, asked) if sound else []
        which = {key: np.flatnonzero(np.array(keys, np.int64) == key) for key in asked}
        return [replace(joined.take(k), channel=asked[key]) for key, k in which.items() if k.size]


FORMAT = Format("SQLite bag", (".db3",), MAGIC, _SqliteFile, tables=False)
