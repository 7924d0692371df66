# SPDX-License-Identifier: Apache-2.0
"""Decompression of all kinds, of several or truncated frames, and its limit."""

import bz2
import math
import random
from collections.abc import Callable
from dataclasses import replace

import lz4.frame
import numpy as np
import pytest
from backports import zstd

from smp_motor_ident.bag.storage import Channel, join
from smp_motor_ident.bag.unpack import (
    Budget,
    decompress,
    decompress_messages,
    decompress_stream,
    unpack_file,
)
from smp_motor_ident.errors import BagError

PACK: dict[str, Callable[[bytes], bytes]] = {
    "zstd": zstd.compress,
    "lz4": lz4.frame.compress,
    "bz2": bz2.compress,
}
DRAW = random.Random(9)
PLAIN = DRAW.randbytes(30_000) + bytes(3_000_000) + DRAW.randbytes(30_000)
PARTS = (PLAIN[:20_000], PLAIN[20_000:40_000], PLAIN[40_000:])


@pytest.fixture
def budget(monkeypatch: pytest.MonkeyPatch) -> Budget:
    monkeypatch.delenv("SMP_BAG_UNPACKED", raising=False)
    return Budget("a.mcap", 1000)


@pytest.mark.parametrize("kind", PACK)
def test_all_frames_of_a_block_are_unpacked_and_counted(kind, budget):
    one, many = PACK[kind](PLAIN), b"".join(PACK[kind](part) for part in PARTS)
    for packed in (one, many):
        before = budget.left
        assert decompress(packed, kind, budget) == PLAIN
        assert before - budget.left == len(PLAIN)
    assert decompress(PLAIN, "", budget) == decompress(PLAIN, "none", budget) == PLAIN


@pytest.mark.parametrize("kind", PACK)
def test_decompression_does_not_depend_on_block_size(kind):
    packed = b"".join(PACK[kind](part) for part in PARTS)
    for length in (1, 7, 1023, 1024, 1025, 1 << 16):
        if length == 1 and kind == "bz2":
            continue  # slow, and the same code path
        blocks = [packed[k : k + length] for k in range(0, len(packed), length)]
        assert b"".join(decompress_stream(blocks, kind)) == PLAIN
    biggest = max(len(piece) for piece in decompress_stream([packed], kind))
    # 1024 bytes of zstd expand to at most 256 blocks of 128 KiB; the others yield 1 MiB at most.
    assert biggest <= (256 << 17 if kind == "zstd" else 1 << 20)
    with pytest.raises(EOFError):
        list(decompress_stream([], kind))
    with pytest.raises(EOFError):
        list(decompress_stream([packed[:-20]], kind))


@pytest.mark.parametrize("kind", PACK)
def test_truncated_block_is_decompressed_up_to_the_cut(kind, budget):
    packed = PACK[kind](PARTS[0]) + PACK[kind](PARTS[1])[:-300]
    kept = decompress(packed, kind, budget)
    assert PLAIN.startswith(kept) and len(kept) >= len(PARTS[0])
    assert budget.limit - budget.left == len(kept)
    cut = decompress(PACK[kind](PLAIN)[:-40], kind, budget)
    # A small frame is read whole or not at all, a large one up to its last complete block.
    assert PLAIN.startswith(cut)
    assert decompress(b"no frame at all", kind, budget) == b""


def test_unknown_compression_is_refused_by_name(budget):
    with pytest.raises(BagError, match="'snappy' is not supported; use zstd, lz4 or bz2"):
        decompress(b"", "snappy", budget)


@pytest.mark.parametrize(
    ("given", "limit"),
    [("", 256e6), ("1000", 1000), ("2k", 2048), ("3M", 3 * 2**20), (" 1.5G ", 1.5 * 2**30)],
)
def test_decompression_limit_is_set_by_file_size_or_user(given, limit, monkeypatch):
    monkeypatch.setenv("SMP_BAG_UNPACKED", given)
    budget = Budget("a.mcap", 100_000)
    assert budget.limit == budget.left == limit
    big = Budget("a.mcap", 100_000_000)
    assert big.limit == (limit if given else 5e9)  # 50 times the packed size
    for wrong in ("much", "inf", "K"):
        monkeypatch.setenv("SMP_BAG_UNPACKED", wrong)
        with pytest.raises(BagError, match="give bytes, or a size such as 512M or 8G"):
            Budget("a.mcap", 1)


def test_decompression_limit_is_exact_to_the_byte(monkeypatch):
    monkeypatch.setenv("SMP_BAG_UNPACKED", "3000000")
    budget = Budget("a.mcap", 1)
    budget.take(2_999_999)
    budget.take(1)
    with pytest.raises(BagError, match=r"a\.mcap: unpacks to more than 3 MB"):
        budget.take(1)
    for kind, pack in PACK.items():
        budget = Budget("a.mcap", 1)
        with pytest.raises(BagError, match="SMP_BAG_UNPACKED=8G"):
            decompress(pack(PLAIN), kind, budget)
        assert len(PLAIN) > 3_000_000 and math.isfinite(budget.limit)


@pytest.mark.parametrize("kind", PACK)
def test_a_file_is_unpacked_and_damage_is_reported(kind, budget, tmp_path):
    path, plain = tmp_path / "a.mcap.x", tmp_path / "a.mcap"
    path.write_bytes(b"".join(map(PACK[kind], PARTS)))
    assert unpack_file(path, plain, kind, budget) == ""
    assert plain.read_bytes() == PLAIN
    assert budget.limit - budget.left == len(PLAIN)
    path.write_bytes(PACK[kind](PARTS[0]) + PACK[kind](PARTS[1])[:-99])
    assert unpack_file(path, plain, kind, budget) == "a.mcap.x: its compression is cut off"
    assert plain.read_bytes().startswith(PARTS[0])
    path.write_bytes(PACK[kind](PARTS[0]) + b"and then something else, for long enough")
    assert "its compression is damaged" in unpack_file(path, plain, kind, budget)
    with pytest.raises(BagError, match="cannot be unpacked"):
        unpack_file(tmp_path / "none", plain, kind, budget)


def test_individually_compressed_messages_are_decompressed_and_losses_counted(budget):
    channel = Channel(1, "/a", "std_msgs/msg/String")
    blobs = [b"", b"abc", b"plain and long", zstd.compress(b"one" * 50),
             lz4.frame.compress(b"two" * 50), zstd.compress(b"three" * 50)[:9],
             b"\x28\xb5\x2f\xfd"]  # fmt: skip
    batch = join(channel, blobs, np.arange(7, dtype=np.int64))
    batch = replace(batch, sequence=np.arange(10, 17))
    unpacked, lost = decompress_messages(batch, budget)
    kept = [b"abc", b"plain and long", b"one" * 50, b"two" * 50]
    assert [unpacked.message(k) for k in range(len(unpacked))] == kept
    assert lost == 3
    assert unpacked.log_time.tolist() == [1, 2, 3, 4]
    assert unpacked.sequence is not None and unpacked.sequence.tolist() == [11, 12, 13, 14]
    for plain in ([b"plain and long"], [b"abc", b""], [b"abc", b"long enough"]):
        same = join(channel, plain, np.arange(len(plain), dtype=np.int64))
        assert decompress_messages(same, budget) == (same, 0)
    alone = join(channel, [lz4.frame.compress(b"x")], np.zeros(1, np.int64))
    unpacked, lost = decompress_messages(alone, budget)
    assert unpacked.message(0) == b"x" and unpacked.sequence is None and lost == 0
