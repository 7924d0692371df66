# SPDX-License-Identifier: Apache-2.0
"""Formats of recordings: one file each, one line each in the registry."""

from pathlib import Path

from smp_motor_ident.bag.readers import apart, csv, json, mcap, ros1, sqlite, wpilog
from smp_motor_ident.bag.readers.format import Format, Messages, Tables
from smp_motor_ident.bag.storage import note_damage
from smp_motor_ident.bag.unpack import MAGIC, Budget, unpack_file
from smp_motor_ident.errors import BagError

FORMATS: tuple[Format, ...] = (
    *(mcap.FORMAT, sqlite.FORMAT, ros1.FORMAT, wpilog.FORMAT),
    *(apart.MATLAB_4, apart.MATLAB_5, apart.MATLAB_73),
    *(apart.EXCEL, json.FORMAT, csv.FORMAT),
)
BAGS = tuple(s for f in FORMATS if not f.tables for s in f.suffixes)
TABLES = tuple(s for f in FORMATS if f.tables for s in f.suffixes)
PACKED = (".zstd", ".zst", ".lz4")


def open_source(path: Path, folder: Path, budget: Budget) -> Messages | Tables:
    """Open a file by its first bytes, else by its name; ``folder`` is for unpacked copies."""
    head, plain, problem = _head(path), path, ""
    if kind := MAGIC.get(head[:4]):
        plain = folder / path.name.removesuffix(path.suffix)
        problem = unpack_file(path, plain, kind, budget)
        head = _head(plain)
    form = recognise(head, plain)
    try:
        if form is None:
            raise BagError(f"{path}: {_explain_unknown(path, head)}")
        source = form.open(plain, path.name, budget)
    except OSError as error:
        raise BagError(f"{path}: cannot be read ({error.strerror})") from None
    except BagError as error:
        raise BagError("; ".join(filter(None, [str(error), problem]))) from None
    if problem:
        source.problems.insert(0, note_damage(problem))
    return source


def is_table(path: Path) -> bool:
    """Return whether a file holds columns instead of messages."""
    form = recognise(_head(path), path)
    return form is not None and form.tables


def recognise(head: bytes, path: Path) -> Format | None:
    """Return the format of a file that begins with ``head``."""
    for form in FORMATS:
        if form.magic and head.startswith(form.magic):
            return form
    suffix = path.suffix.lower()
    return next((f for f in FORMATS if not f.magic and suffix in f.suffixes), None)


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(24)
    except OSError as error:
        raise BagError(f"{path}: cannot be read ({error.strerror})") from None


def _explain_unknown(path: Path, head: bytes) -> str:
    if not head:
        return "is empty"
    if any(form.magic.startswith(head) for form in FORMATS if form.magic):
        return f"is cut off after {path.stat().st_size} bytes; nothing of it can be read"
    if head.startswith(b"version https://git-lfs"):
        return "is a pointer of Git LFS, not the recording; run git lfs pull"
    names = ", ".join(form.name for form in FORMATS)
    return f"is not a recording of a known format ({names})"
