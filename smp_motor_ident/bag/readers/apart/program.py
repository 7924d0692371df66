# SPDX-License-Identifier: Apache-2.0
"""Read a file with an external library; arguments: ``MATLAB`` or ``Excel``, path, memory [byte].

Writes a line of JSON (``error``, ``too_large``, ``objects``, ``columns``, ``sheets``): names of the
columns, which follow as arrays, or how many rows each sheet has, which follow as lines of JSON.
"""

import io
import json
import resource
import struct
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any, cast

import numpy as np

_HEADER_BYTES = 128  # bytes of a file of version 5 before its first variable
_MAX_DEPTH = 16
_MAX_COLUMNS = 64  # columns of a matrix of signals; a wider matrix holds something else
_MAX_SHEET_ROWS = 1_048_576  # of a sheet, by Excel's own limits
_MEMORY_LIMIT = resource.getrlimit(resource.RLIMIT_AS)[1]
_READER_MEMORY = 1 << 26  # memory that readers need in addition to the file's contents [byte]


class Unreadable(Exception):
    """The file cannot be read; the text is for the user."""


def main() -> None:
    """Read a file and write its contents."""
    kind, path, memory = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
    head: dict[str, Any] = {"error": "", "too_large": False, "objects": []}
    parts: list[bytes] = []
    try:
        read = _workbook(path, memory) if kind == "Excel" else _variables_of(path, memory, head)
        for name, part in read:
            head.setdefault(name[0], []).append(name[1])
            parts.append(part)
            if sum(map(len, parts)) > memory:
                raise MemoryError
    except Unreadable as error:
        head["error"] = str(error)
    except MemoryError:
        head["too_large"], parts = True, []
    except Exception as error:  # libraries raise any error on damaged bytes
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        head["error"] = f"no readable {kind} file ({reason[:200]})"
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_LIMIT, _MEMORY_LIMIT))
    sys.stdout.buffer.write(json.dumps(head).encode() + b"\n")
    sys.stdout.buffer.writelines(parts)


Part = tuple[tuple[str, Any], bytes]
"""Description of a part in the head, and its bytes."""


def _variables_of(path: Path, memory: int, head: dict[str, Any]) -> Iterator[Part]:
    """Yield the vectors of a MATLAB file."""
    for content in _contents(path.read_bytes(), head["objects"], memory):
        for name, values in _columns("", content, 0, head["objects"]):
            answer = io.BytesIO()
            np.save(answer, values, allow_pickle=False)
            yield ("columns", name), answer.getvalue()


def _workbook(path: Path, memory: int) -> Iterator[Part]:
    """Yield the sheets of a workbook: their rows with cells, as they are shown."""
    try:
        import openpyxl
    except ImportError:
        raise Unreadable(
            "is an Excel workbook, which needs openpyxl (pip install openpyxl); or save it as CSV"
        ) from None
    _bound_memory(memory)
    warnings.simplefilter("ignore")
    book = openpyxl.load_workbook(path, read_only=True, data_only=True)
    left = memory
    for sheet in book.worksheets:
        if not hasattr(sheet, "reset_dimensions"):  # a chart
            continue
        sheet.reset_dimensions()  # the stated width may be wrong
        lines = []
        for k, row in enumerate(sheet.iter_rows()):
            if k >= _MAX_SHEET_ROWS:
                raise Unreadable(
                    f"says that it has more than the {_MAX_SHEET_ROWS:,} rows of a sheet"
                )
            if row and (cells := _cells(row)):
                lines.append(json.dumps(cells).encode() + b"\n")
                left -= len(lines[-1])
                if left < 0:
                    raise MemoryError
        yield ("sheets", len(lines)), b"".join(lines)


def _cells(row: Iterable[Any]) -> list[Any]:
    """Return the values of a row as displayed, up to the last; empty if it has none."""
    cells, filled = [], 0
    for k, cell in enumerate(row, 1):
        value = cell.value
        if value is not None:
            filled = k
            if isinstance(value, timedelta):
                minutes, seconds = divmod(value.total_seconds(), 60)
                value = f"{int(minutes // 60)}:{int(minutes % 60):02}:{seconds:09.6f}"
            elif hasattr(value, "isoformat"):
                value = value.isoformat()
            elif isinstance(value, (int, float)) and "%" in (cell.number_format or ""):
                value = f"{100 * value:.15g}%"
        cells.append(value)
    return cells[:filled]


def _contents(data: bytes, objects: list[str], memory: int) -> Iterator[dict[str, Any]]:
    """Yield the variables of a file by their names; note the objects of version 7.3."""
    if data.startswith(b"MATLAB 7.3 MAT"):
        try:
            import h5py
        except ImportError:
            raise Unreadable(
                "is a MATLAB file of version 7.3, which needs h5py (pip install h5py); "
                "or save it in MATLAB with -v7"
            ) from None
        _bound_memory(memory)
        taken: dict[str, Any] = {}

        def take(key: str, item: Any) -> None:
            if not isinstance(item, h5py.Dataset) or "#" in key:
                return
            if "MATLAB_object_decode" in item.attrs:  # references, stored as integers
                objects.append(f"{key} ({_printable(item.attrs.get('MATLAB_class', b''))})")
            elif item.dtype.kind in "fiub":
                taken[key.replace("/", ".")] = np.asarray(item).T  # MATLAB counts columns first

        with h5py.File(io.BytesIO(data)) as file:
            file.visititems(take)
        yield taken
        return
    from scipy.io import loadmat  # takes a while to load, for one of many formats

    _bound_memory(memory)
    for part in _variables(data) if data.startswith(b"MATLAB 5.0 MAT") else [data]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of objects, which have no names there
            whole = loadmat(
                cast(Any, io.BytesIO(part)), simplify_cells=True, chars_as_strings=False
            )
        yield {key: value for key, value in whole.items() if not key.startswith("__")}


def _bound_memory(memory: int) -> None:
    """Limit the memory this process may take in addition to its present use."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + memory + _READER_MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, _MEMORY_LIMIT))


def _variables(data: bytes) -> Iterator[bytes]:
    """Yield every variable as a file of its own: scipy gives all objects one and the same name."""
    order = "<" if data[126:_HEADER_BYTES] == b"IM" else ">"
    at = _HEADER_BYTES
    while at + 8 <= len(data):
        size = struct.unpack_from(order + "I", data, at + 4)[0]
        if at + 8 + size > len(data):
            raise Unreadable(f"is cut off at byte {at} of {len(data)}; save it again")
        yield data[:_HEADER_BYTES] + data[at : at + 8 + size]
        at += 8 + size


def _columns(
    prefix: str, value: Any, depth: int, objects: list[str]
) -> Iterator[tuple[str, np.ndarray[Any, Any]]]:
    """Yield the vectors of a structure by their paths; note its objects."""
    parts = _parts(prefix, value)
    if parts is not None:
        for path, inner in parts if depth < _MAX_DEPTH else []:
            yield from _columns(path, inner, depth + 1, objects)
        return
    if not isinstance(value, np.ndarray):
        return
    if value.dtype.names and value.dtype.names[:3] == ("s0", "s1", "s2"):  # only MATLAB opens it
        name, _, kind = (_printable(text) for text in value.ravel()[0].tolist()[:3])
        objects.append(f"{name or 'a field'} ({kind or 'of an unknown class'})")
    if value.dtype.kind not in "fiub" or value.size < 2:
        return
    value = np.squeeze(value)
    if value.ndim == 1:
        yield prefix, value
    elif value.ndim == 2:
        rows = value if value.shape[0] >= value.shape[1] else value.T
        if rows.shape[1] <= _MAX_COLUMNS:
            for k in range(rows.shape[1]):
                yield f"{prefix}[{k}]", rows[:, k]


def _parts(prefix: str, value: Any) -> list[tuple[str, Any]] | None:
    """Return the parts of a structure, or of an array of structures or cells, by path."""
    if isinstance(value, Mapping):
        return [(f"{prefix}.{k}" if prefix else str(k), inner) for k, inner in value.items()]
    if isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object):
        return [(f"{prefix}[{k}]", inner) for k, inner in enumerate(np.ravel(value)[:_MAX_COLUMNS])]
    return None


def _printable(text: Any) -> str:
    text = text.decode("latin-1") if isinstance(text, bytes) else str(text)
    return "".join(filter(str.isprintable, text))[:80]


if __name__ == "__main__":
    main()
