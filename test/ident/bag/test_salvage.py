# SPDX-License-Identifier: Apache-2.0
"""A truncated or damaged recording yields its complete messages and a finding on the loss."""

import random
import sqlite3
from pathlib import Path

import lz4.frame
import mcap.writer
import numpy as np
import pytest
from backports import zstd
from recordings import assert_read, motion, notes, write_mcap, write_metadata, write_sqlite

from smp_motor_ident.bag import read_records
from smp_motor_ident.bag.salvage import Row, salvage
from smp_motor_ident.errors import BagError

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


KILOBYTE = 1024
LOST = ("cut off", "damaged", "could be read", "is empty", "compression", "not a readable")


def read_damaged(path: Path) -> tuple[int, str]:
    """Return the number of samples of a damaged bag, and its messages."""
    try:
        record = next(iter(read_records(path).values()))
    except BagError as error:
        count, words = 0, str(error)
    else:
        return len(record), notes(record)
    assert "\n" not in words
    assert path.name in words or path.parent.name in words
    return count, words


def assert_truncations_are_reported(whole: bytes, path: Path, samples: int, most_lost: int) -> None:
    """Truncate at every kilobyte: no unexpected error, no silent loss, no excessive loss."""
    per_byte = samples / len(whole)
    before = 0
    for size in range(0, len(whole), KILOBYTE):
        path.write_bytes(whole[:size])
        count, words = read_damaged(path)
        if count < samples:
            assert any(word in words for word in LOST), (size, words)
        assert count >= before, f"a longer file gave less at {size} bytes"
        assert count >= min(size * per_byte, samples) - most_lost, (size, count, words)
        before = count
    path.write_bytes(whole)
    assert read_damaged(path)[0] == samples


@pytest.mark.parametrize(
    ("options", "most_lost"),
    [
        # Uncompressed messages are read up to the byte of the cut; the data are followed by an
        # index, so that a given fraction of the file holds at least that fraction of messages.
        (dict(compression=mcap.writer.CompressionType.NONE), 20),
        (dict(compression=mcap.writer.CompressionType.NONE, use_chunking=False), 20),
        # Of a truncated compressed chunk the complete blocks are read; a chunk has 30 messages.
        (dict(compression=mcap.writer.CompressionType.ZSTD), 60),
        (dict(compression=mcap.writer.CompressionType.LZ4), 60),
    ],
)
def test_mcap_file_truncated_at_any_kilobyte_yields_messages_before_the_cut(
    tmp_path, options, most_lost
):
    truth = motion(n=400)
    path = write_mcap(tmp_path / "bag.mcap", truth.messages(), **options)
    assert_truncations_are_reported(path.read_bytes(), path, 400, most_lost)


def test_sqlite_file_truncated_at_any_kilobyte_yields_messages_before_the_cut(tmp_path):
    truth = motion(n=400)
    path = write_sqlite(tmp_path / "bag.db3", truth.messages())
    # The first seven of its twenty pages hold no messages: by size, those of 140 samples.
    assert_truncations_are_reported(path.read_bytes(), path, 400, 140)


def test_sqlite_file_with_keys_out_of_order_is_read_in_finite_time(tmp_path):
    path = write_sqlite(tmp_path / "bag.db3", motion(n=400).messages())
    database = sqlite3.connect(path)
    last = max(database.execute("SELECT max(id) FROM messages").fetchone())
    database.execute("UPDATE messages SET data = '' WHERE id = ?", (last,))  # an invalid message
    database.commit()
    database.close()
    # Its key, a varint of two bytes before a header of five numbers, becomes that of the first.
    high, low = divmod(last, 128)
    key, header = bytes([0x80 + high, low]), bytes([5, 0])
    spoilt = path.read_bytes()
    assert key + header in spoilt
    path.write_bytes(spoilt.replace(key + header, b"\x80\x01" + header))
    samples, words = read_damaged(path)
    assert samples >= 399 and "out of order" in words


@pytest.mark.parametrize("pack", [zstd.compress, lz4.frame.compress])
@pytest.mark.parametrize("storage", ["mcap", "db3"])
def test_compressed_file_truncated_at_any_kilobyte_reports_its_loss(tmp_path, storage, pack):
    truth = motion(n=400)
    write = write_mcap if storage == "mcap" else write_sqlite
    plain = write(tmp_path / f"bag.{storage}", truth.messages())
    assert callable(pack)
    path = tmp_path / f"bag.{storage}.packed"
    # The file may be a single compressed block: then only the whole file yields messages.
    assert_truncations_are_reported(pack(plain.read_bytes()), path, 400, 400)


def test_truncated_bag_reports_share_of_messages_in_metadata(tmp_path):
    truth = motion(n=400)
    bag = tmp_path / "bag"
    bag.mkdir()
    path = write_mcap(bag / "bag_0.mcap", truth.messages())
    write_metadata(bag, ["bag_0.mcap"], truth.messages())
    path.write_bytes(path.read_bytes()[:20_000])
    count, words = read_damaged(bag)
    assert 0 < count < 400
    assert f"{count} of 400 messages could be read" in words
    assert_read(read_records(bag)["front_left"], truth, count)


def test_damaged_chunk_loses_only_its_messages(tmp_path):
    truth = motion(n=400)
    path = write_mcap(tmp_path / "bag.mcap", truth.messages())
    data = bytearray(path.read_bytes())
    data[20_000] ^= 0xFF
    path.write_bytes(data)
    count, words = read_damaged(path)
    # A chunk of 4096 bytes has about 30 messages.
    assert 360 <= count < 400
    assert f"is damaged and was left out with {400 - count} messages" in words
    assert f"{count} of 400 messages" in words


def test_zeros_at_end_of_file_are_not_read_as_messages(tmp_path):
    truth = motion(n=400)
    path = write_mcap(tmp_path / "bag.mcap", truth.messages(), use_chunking=False)
    data = path.read_bytes()
    path.write_bytes(data[:30_000] + bytes(len(data) - 30_000))
    count, words = read_damaged(path)
    assert 200 < count < 400
    assert "cut off or damaged" in words
    record = read_records(path)["front_left"]
    # The last message lies half in the zeros; without a checksum this is not detectable.
    np.testing.assert_array_equal(record.voltage[:-1], truth.voltage[: count - 1])
