# SPDX-License-Identifier: Apache-2.0
"""Decompress with a limit on memory.

A few bytes of zstd, lz4 or bz2 may expand to gigabytes.  The unpacked size of a recording is
limited to a multiple of its packed size; the environment variable ``SMP_BAG_UNPACKED`` (bytes, or
a size such as ``8G``) raises the limit.
"""

import bz2
import os
import shutil
import tempfile
import weakref
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
from backports import zstd  # from Python 3.14 on: compression.zstd

from smp_motor_ident.bag.storage import Batch, gather, join
from smp_motor_ident.errors import BagError
from smp_motor_ident.limits import MAX_UNPACKING_RATIO, MIN_UNPACKED_LIMIT

VARIABLE = "SMP_BAG_UNPACKED"
MAGIC = {b"\x28\xb5\x2f\xfd": "zstd", b"\x04\x22\x4d\x18": "lz4"}
_CHUNK = 1024  # bytes fed at once, which limits the loss of output before damage
_PIECE = 1 << 20
_DAMAGE = (zstd.ZstdError, RuntimeError, EOFError, OSError, ValueError)
_ENGINES = {
    "zstd": zstd.ZstdDecompressor,
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "bz2": bz2.BZ2Decompressor,
}


class Budget:
    """Remaining limit of unpacked bytes for a recording of ``packed`` bytes."""

    def __init__(self, name: str, packed: int) -> None:
        self.name = name
        self.limit = _read_user_limit() or int(
            max(MIN_UNPACKED_LIMIT, MAX_UNPACKING_RATIO * packed)
        )
        self.left = self.limit

    def take(self, size: int) -> None:
        """Count bytes; raise an error beyond the limit."""
        self.left -= size
        if self.left < 0:
            raise BagError(
                f"{self.name}: unpacks to more than {self.limit / 1e6:.0f} MB, which a file of its "
                f"size is not expected to hold; {VARIABLE}=8G in the environment allows 8 GB"
            )


def make_temporary_folder(owner: object) -> Path:
    """Return a new folder for unpacked or repaired files, deleted with its owner."""
    folder = tempfile.mkdtemp(prefix="smp_bag_")
    weakref.finalize(owner, shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def _read_user_limit() -> int:
    """Return the limit that the user set, 0 if none."""
    text = os.environ.get(VARIABLE, "").strip().upper()
    if not text:
        return 0
    factor = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30}.get(text[-1], 1)
    try:
        return int(float(text.rstrip("KMG")) * factor)
    except (ValueError, OverflowError):
        raise BagError(
            f"{VARIABLE} is {text!r}; give bytes, or a size such as 512M or 8G"
        ) from None


def decompress_stream(blocks: Iterable[bytes], kind: str) -> Iterator[bytes]:
    """Unpack all frames of a stream; EOFError where it is cut off."""
    engine: Any = None
    for block in blocks:
        for k in range(0, len(block), _CHUNK):
            rest = block[k : k + _CHUNK]
            while rest:
                if engine is None or engine.eof:  # another frame follows
                    engine = _ENGINES[kind]()
                yield engine.decompress(rest, _PIECE)
                while not (engine.eof or engine.needs_input):
                    yield engine.decompress(b"", _PIECE)
                rest = engine.unused_data if engine.eof else b""
    if engine is None or not engine.eof:
        raise EOFError("cut off")


def decompress(data: bytes, compression: str, budget: Budget) -> bytes:
    """Decompress a block, or the readable part of one that is cut off."""
    if compression in ("", "none"):
        return data
    if compression not in _ENGINES:
        raise BagError(f"compression {compression!r} is not supported; use zstd, lz4 or bz2")
    parts: list[bytes] = []
    try:
        for piece in decompress_stream([data], compression):
            budget.take(len(piece))
            parts.append(piece)
    except _DAMAGE:
        pass  # keep the part before the damage
    return b"".join(parts)


def unpack_file(path: Path, plain: Path, kind: str, budget: Budget) -> str:
    """Decompress a file; return a remark on damage, empty if it is whole."""
    try:
        with path.open("rb") as packed, plain.open("wb") as out:
            for piece in decompress_stream(iter(lambda: packed.read(1 << 16), b""), kind):
                budget.take(len(piece))
                out.write(piece)
    except EOFError:
        return f"{path.name}: its compression is cut off"
    except _DAMAGE as error:
        if isinstance(error, OSError) and error.errno is not None:  # of the disk, not of bz2
            raise BagError(f"{path}: cannot be unpacked ({error.strerror})") from None
        return f"{path.name}: its compression is damaged ({error})"
    return ""


def decompress_messages(batch: Batch, budget: Budget) -> tuple[Batch, int]:
    """Decompress messages that were compressed one by one; return how many were lost, too."""
    sound = batch.length >= 4
    if not sound.any():
        return batch, 0
    first = gather(batch.data, np.where(sound, batch.offset, batch.offset[sound][0]), "<u4")
    if not np.any(sound & np.isin(first, [int.from_bytes(magic, "little") for magic in MAGIC])):
        return batch, 0
    messages = map(batch.message, range(len(batch)))
    blobs = [decompress(data, MAGIC.get(data[:4], ""), budget) for data in messages]
    kept = np.array([bool(blob) for blob in blobs])
    joined = join(batch.channel, [b for b in blobs if b], batch.log_time[kept])
    if batch.sequence is not None:
        joined = replace(joined, sequence=batch.sequence[kept])
    return joined, int((~kept).sum())
