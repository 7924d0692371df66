# SPDX-License-Identifier: Apache-2.0
"""Rows recovered from the pages of a SQLite file, compared with those written by sqlite3."""

import random
import sqlite3
from pathlib import Path

import pytest

from smp_motor_ident.bag.salvage import Row, salvage

# Every integer size of SQLite, with both signs: none (0 and 1), 1 to 4, 6 and 8 bytes.
NUMBERS = [0, 1, 2, -1, 127, -128, 128, 32767, -32768, 32768, 2**23 - 1, -(2**23), 2**23,
           2**31 - 1, -(2**31), 2**31, 2**47 - 1, -(2**47), 2**47, 2**63 - 1, -(2**63)]  # fmt: skip


def write(path: Path, page_size: int, rows: list[Row], more: str = "") -> None:
    base = sqlite3.connect(path)
    base.executescript(
        f"PRAGMA page_size={page_size}; PRAGMA auto_vacuum=NONE;"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
        f" data BLOB); {more}"
    )
    base.executemany("INSERT INTO messages VALUES (?,?,?,?)", rows)
    base.commit()
    base.close()


def salvage_rows(path: Path) -> list[Row]:
    return [row for rows in salvage(path) for row in rows]


def draw_rows(page_size: int, seed: int, count: int = 60) -> list[Row]:
    """Return rows that fill about one page, slightly less or more, or several pages."""
    draw = random.Random(seed)
    around = page_size - 35  # the largest row that fits in a page, with its header
    sizes = [0, 1, 5, 57, 58, 100, *range(around - 20, around + 4), 2 * page_size,
             5 * page_size + 7]  # fmt: skip
    rows = []
    for k in range(1, count):
        key, data = draw.choice((k, 200 + k, 2**35 + k, 2**62 + k)), draw.choice(sizes)
        rows.append((key, draw.choice(NUMBERS), draw.choice(NUMBERS), draw.randbytes(data)))
    return rows


@pytest.mark.parametrize("page_size", [512, 1024, 4096, 65536])
def test_all_rows_are_recovered_from_sqlite_pages(tmp_path, page_size):
    path = tmp_path / "a.db3"
    # All numbers in both columns, and rows of every length, some with overflow pages.
    rows = [(k + 1, a, b, b"x") for k, (a, b) in enumerate(zip(NUMBERS, NUMBERS[::-1]))]
    rows += [(10**6 + key, *rest) for key, *rest in draw_rows(page_size, page_size)]
    write(path, page_size, rows)
    assert sorted(salvage_rows(path)) == sorted(rows)


def test_rows_of_other_tables_are_not_recovered(tmp_path):
    path = tmp_path / "a.db3"
    rows = [(k, 1, 10 * k, b"data") for k in range(1, 30)]
    others = (
        "CREATE TABLE a(id INTEGER PRIMARY KEY, topic_id INTEGER, at INTEGER, data TEXT);"
        "INSERT INTO a VALUES (1, 1, 1, 'a text is no message');"  # an odd serial type
        "CREATE TABLE b(x, topic_id INTEGER, at INTEGER, data BLOB);"
        "INSERT INTO b VALUES (7, 1, 1, x'00');"  # its first column is not a key
        "CREATE TABLE c(id INTEGER PRIMARY KEY, one INTEGER, two INTEGER);"
        "INSERT INTO c VALUES (1, 1, 1);"
        "CREATE TABLE d(id INTEGER PRIMARY KEY, one REAL, two INTEGER, data BLOB);"
        "INSERT INTO d VALUES (1, 0.5, 1, x'00');"
        "CREATE TABLE e(id INTEGER PRIMARY KEY, one INTEGER, two REAL, data BLOB);"
        "INSERT INTO e VALUES (1, 1, 0.5, x'00');"
        "CREATE TABLE f(id INTEGER PRIMARY KEY, one INTEGER, two INTEGER, data INTEGER);"
        "INSERT INTO f VALUES (1, 2, 3, 4);"
        "CREATE TABLE g(id INTEGER PRIMARY KEY, one INTEGER, two INTEGER, data BLOB, rest);"
        "INSERT INTO g VALUES (1, 2, 3, x'00', 5);"
    )
    write(path, 1024, rows, others)
    assert sorted(salvage_rows(path)) == rows


@pytest.mark.parametrize("page_size", [512, 4096])
def test_rows_of_complete_pages_are_recovered_from_truncated_file(tmp_path, page_size):
    path = tmp_path / "a.db3"
    rows = (
        draw_rows(page_size, 7)
        if page_size == 512
        else [(k, 1, k, bytes(200)) for k in range(1, 99)]
    )
    rows = [(k, *row[1:]) for k, row in enumerate(rows, 1)]
    write(path, page_size, rows)
    whole, last = path.read_bytes(), 0
    for end in range(len(whole), 0, -page_size // 2):
        path.write_bytes(whole[:end])
        found = salvage_rows(path)
        assert set(found) <= set(rows)
        last = last or len(found)
        assert len(found) <= last
        last = len(found)
    assert last == 0


def test_corrupted_bytes_lose_only_rows_of_their_pages(tmp_path):
    path = tmp_path / "a.db3"
    rows = [(k, 1, k, bytes([k]) * 90) for k in range(1, 100)]
    write(path, 512, rows)
    whole, draw = path.read_bytes(), random.Random(4)
    sound = salvage_rows(path)
    assert sorted(sound) == rows
    for _ in range(100):
        spoilt = bytearray(whole)
        for _ in range(3):
            spoilt[draw.randrange(512, len(spoilt))] = draw.choice((0, 0x7F, 0x80, 0xFF))
        path.write_bytes(spoilt)
        assert len(salvage_rows(path)) >= len(rows) - 5 * 3, "a leaf holds five rows"


def test_file_with_invalid_page_size_yields_no_rows(tmp_path):
    path = tmp_path / "a.db3"
    write(path, 512, [(1, 1, 1, b"x")])
    whole = bytearray(path.read_bytes())
    for size, reserved in ((256, 0), (512, 33), (0, 0)):
        whole[16:18], whole[20] = size.to_bytes(2, "big"), reserved
        path.write_bytes(whole)
        assert salvage_rows(path) == []
    whole[16:18], whole[20] = (512).to_bytes(2, "big"), 32
    path.write_bytes(whole)
    assert salvage_rows(path) == [(1, 1, 1, b"x")]
