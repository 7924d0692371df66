# SPDX-License-Identifier: Apache-2.0
"""A truncated recording yields its complete messages and a finding on the loss."""

import sqlite3
from pathlib import Path

import lz4.frame
import mcap.writer
import numpy as np
import pytest
from backports import zstd
from recordings import assert_read, motion, notes, write_mcap, write_metadata, write_sqlite

from smp_motor_ident.bag import BagWriter, read_records
from smp_motor_ident.errors import BagError

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


def test_bag_of_killed_writer_is_readable(tmp_path):
    from rosbags.highlevel import AnyReader

    truth = motion(n=300)
    bag = BagWriter(tmp_path / "bag")
    for sent in truth.messages():
        bag.write(sent.topic, sent.type, sent.data, sent.stamp)
        bag.flush(force=True)
    # Not closed: a killed process leaves the files in this state.
    with AnyReader([tmp_path / "bag"]) as reader:
        assert sum(1 for _ in reader.messages()) == 301
    record = read_records(tmp_path / "bag")["front_left"]
    assert_read(record, truth)
    bag.close()
