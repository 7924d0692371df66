"""MATLAB files: version 4, version 5 by scipy, version 7.3 by h5py where it is installed.

Vectors and the columns of matrices become columns of one table per length, fields of structures
by their path.  The layout that is checked before scipy may trust it is that of MathWorks' "MAT-File
Format", section 1: elements of type and size, compressed ones by zlib.
"""

import io
import math
import struct
import subprocess
import sys
import warnings
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from smp_motor_ident.bag.readers.format import ColumnFile, Format
from smp_motor_ident.bag.storage import first_line, found
from smp_motor_ident.bag.unpack import Budget
from smp_motor_ident.errors import BagError

_COMPRESSED, _MATRIX = 15, 14
_OPAQUE = 17  # class of a matrix that is an object of MATLAB
_TOLD = 4  # objects that are named in a message
_TYPES_4 = ("<f8", "<f4", "<i4", "<i2", "<u2", "u1")
_DEEPEST = 16
_WIDEST = 64  # columns of a matrix that are taken as signals; a wider one is something else
_PROBE = """
import io, sys
from scipy.io import loadmat
loadmat(io.BytesIO(sys.stdin.buffer.read()), simplify_cells=True, chars_as_strings=False)
"""


def _check_survivable(data: bytes, name: str) -> None:
    """Refuse bytes of which scipy's compiled reader dies: a process of its own tries first."""
    nowhere = subprocess.DEVNULL
    command = [sys.executable, "-c", _PROBE]
    done = subprocess.run(command, input=data, stdout=nowhere, stderr=nowhere, check=False)
    if done.returncode < 0:
        raise BagError(f"{name}: damaged MATLAB file (scipy's reader ends by {-done.returncode})")


def _open_4(path: Path, name: str, budget: Budget) -> ColumnFile:
    """Read a file of version 4, as QUARC writes: before every matrix five numbers and its name."""
    data, at = path.read_bytes(), 0
    taken: dict[str, Any] = {}
    while at < len(data):
        try:
            kind, rows, columns, imaginary, length = struct.unpack_from("<5i", data, at)
            if min(kind, rows, columns, length - 1) < 0:
                raise ValueError
            begin = at + 20 + length
            flat = np.frombuffer(data, _TYPES_4[kind // 10], rows * columns, begin)
        except (struct.error, LookupError, ValueError):
            raise BagError(f"{name}: is cut off or damaged at byte {at} of {len(data)}") from None
        if kind % 10 == 0:  # no text
            key = data[begin - length : begin].rstrip(b"\0").decode("latin-1")
            taken[key] = flat.reshape(columns, rows).T
        at = begin + flat.nbytes * (1 + (imaginary != 0))
    return ColumnFile(path, name, dict(_columns("", taken, 0)))


def _open_5(path: Path, name: str, budget: Budget) -> ColumnFile:
    """Read a file of version 5."""
    objects: list[str] = []
    data = _unpacked(path.read_bytes(), name, budget, objects)
    _check_survivable(data, name)
    from scipy import io as scipy_io  # takes a while to load, for one of many formats

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of objects, which have no names there
            content = scipy_io.loadmat(
                cast(Any, io.BytesIO(data)), simplify_cells=True, chars_as_strings=False
            )
    except Exception as error:  # scipy's reader raises whatever its bytes lead it to
        raise BagError(f"{name}: no readable MATLAB file ({first_line(error)[:200]})") from None
    visible = {key: value for key, value in content.items() if not key.startswith("__")}
    columns = dict(_columns("", visible, 0))
    if objects and not columns:
        raise BagError(f"{name}: {_advice(objects)}")
    file = ColumnFile(path, name, columns)
    if objects:
        file.problems.append(found("matlab_object", f"{name}: {_advice(objects)}", "warning"))
    return file


def _open_73(path: Path, name: str, budget: Budget) -> ColumnFile:
    """Read a file of version 7.3, which is HDF5."""
    try:
        import h5py
    except ImportError:
        raise BagError(
            f"{name}: is a MATLAB file of version 7.3, which needs h5py (pip install h5py); "
            "or save it in MATLAB with -v7"
        ) from None
    taken: dict[str, Any] = {}

    def take(key: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "fiub" and "#" not in key:
            budget.take(item.nbytes)
            taken[key.replace("/", ".")] = np.asarray(item).T  # MATLAB counts columns first

    try:
        with h5py.File(path, "r") as file:
            file.visititems(take)
    except (OSError, RuntimeError, ValueError, KeyError) as error:
        raise BagError(f"{name}: no readable MATLAB file ({first_line(error)[:200]})") from None
    return ColumnFile(path, name, dict(_columns("", taken, 0)))


def _columns(prefix: str, value: Any, depth: int) -> Iterator[tuple[str, np.ndarray[Any, Any]]]:
    """Yield the vectors of a structure by their paths."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            if depth < _DEEPEST:
                yield from _columns(f"{prefix}.{key}" if prefix else str(key), inner, depth + 1)
        return
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub" or value.size < 2:
        return
    value = np.squeeze(value)
    if value.ndim == 1:
        yield prefix, value
    elif value.ndim == 2:
        rows = value if value.shape[0] >= value.shape[1] else value.T
        if rows.shape[1] <= _WIDEST:
            for k in range(rows.shape[1]):
                yield f"{prefix}[{k}]", rows[:, k]


def _unpacked(data: bytes, name: str, budget: Budget, objects: list[str]) -> bytes:
    """Return the file with its elements unpacked, each within what holds it; note its objects."""
    if len(data) < 128 or data[126:128] not in (b"IM", b"MI"):
        raise BagError(f"{name}: is cut off or no MATLAB file of version 5")
    order = "<" if data[126:128] == b"IM" else ">"
    parts, at = [data[:128]], 128
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(order + "II", data, at)
        if at + 8 + size > len(data):
            raise BagError(f"{name}: is cut off at byte {at} of {len(data)}; save it again")
        body = data[at : at + 8 + size]
        if kind == _COMPRESSED:
            body = _inflated(body[8:], name, budget)
        _check(body, order, name, 0, objects)
        parts.append(body)
        at += 8 + size
    return b"".join(parts)


def _inflated(body: bytes, name: str, budget: Budget) -> bytes:
    engine, parts = zlib.decompressobj(), []
    try:
        while body and not engine.eof:
            parts.append(engine.decompress(body, 1 << 20))
            budget.take(len(parts[-1]))
            body = engine.unconsumed_tail
    except zlib.error as error:
        raise BagError(f"{name}: a variable is damaged ({error})") from None
    return b"".join(parts)


def _check(body: bytes, order: str, name: str, depth: int, objects: list[str]) -> None:
    """Refuse an element that says it is longer than what holds it, or has more cells."""
    at = 0
    while at + 8 <= len(body):
        kind, size = struct.unpack_from(order + "II", body, at)
        if kind >> 16:  # a small element: type and size share four bytes
            at += 8
            continue
        if at + 8 + size > len(body) or depth > _DEEPEST:
            raise BagError(f"{name}: a variable is damaged (an element of {size} bytes)")
        inside = body[at + 8 : at + 8 + size]
        if kind == _MATRIX and size:
            if struct.unpack_from(order + "I", inside.ljust(12, b"\0"), 8)[0] & 0xFF == _OPAQUE:
                objects.append(_object(inside, order))  # which has no dimensions
            else:
                _check_size(inside, order, name)
            _check(inside, order, name, depth + 1, objects)
        at += 8 + size + -size % 8


def _object(inside: bytes, order: str) -> str:
    """Return the name and class of an object: behind its flags, about the kind of system."""
    texts: list[str] = []
    at = 16
    while len(texts) < 3 and at + 8 <= len(inside):
        kind, size = struct.unpack_from(order + "II", inside, at)
        small = kind >> 16  # type and size share four bytes
        begin, size, step = (at + 4, small, 8) if small else (at + 8, size, 8 + size + -size % 8)
        text = inside[begin : begin + size].decode("latin-1")
        texts.append("".join(filter(str.isprintable, text))[:80])
        at += step
    name, _, kind_of = (*texts, "", "", "")[:3]
    return f"{name or 'a field'} ({kind_of or 'of an unknown class'})"


def _advice(objects: list[str]) -> str:
    """Return what to do about objects, which MATLAB alone can open."""
    some = ", ".join(list(dict.fromkeys(objects))[:_TOLD])
    return (
        "holds MATLAB objects, such as a timeseries or a Simulink Dataset, which only MATLAB can "
        f"read: {some}; save its Time and Data as arrays there: "
        "t = x.Time; y = x.Data; save('log.mat', 't', 'y')"
    )


def _check_size(inside: bytes, order: str, name: str) -> None:
    """Refuse a matrix with more elements than bytes: dimensions are its second element."""
    if len(inside) < 32:
        return
    _, size = struct.unpack_from(order + "II", inside, 16)
    count = min(size // 4, (len(inside) - 24) // 4, 32)
    dimensions = struct.unpack_from(f"{order}{count}i", inside, 24)
    product = math.prod(float(max(dimension, 0)) for dimension in dimensions)
    if product > len(inside):
        raise BagError(
            f"{name}: a variable is damaged ({product:g} elements in {len(inside)} bytes)"
        )


FORMAT_4 = Format("MATLAB 4", (".mat",), b"\0\0\0\0", _open_4)
FORMAT_5 = Format("MATLAB", (".mat",), b"MATLAB 5.0 MAT", _open_5)
FORMAT_73 = Format("MATLAB 7.3", (".mat",), b"MATLAB 7.3 MAT", _open_73)
