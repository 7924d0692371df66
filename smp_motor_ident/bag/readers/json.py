"""JSON logs: rows of objects, objects of columns, JSON lines, and WPILib's SysId.

SysId and its forerunner frc-characterization keep lists of rows by the name of the test
(``slow-forward`` and the like); what their columns are follows from the number of them
(github.com/wpilibsuite/sysid, docs/data-collection.md).
"""

import json
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.bag.limits import STRAY_ROWS
from smp_motor_ident.bag.readers import grid
from smp_motor_ident.bag.readers.format import ColumnFile, Format
from smp_motor_ident.bag.storage import damaged
from smp_motor_ident.bag.unpack import Budget
from smp_motor_ident.errors import BagError

_TESTS = ("slow-forward", "slow-backward", "fast-forward", "fast-backward")
_SIMPLE = ("time", "voltage", "position", "velocity")
_SIDES = tuple(f"{side}_{what}" for what in _SIMPLE[1:] for side in ("left", "right"))
_DRIVE = ("time", *_SIDES, "angle", "angular_rate")
_OLD = ("time", "battery", "autospeed", *_SIDES, "gyro")
_DEEPEST = 16
_WIDEST = 64
_MOST_CELLS = 20_000_000


def _open(path: Path, name: str, budget: Budget) -> ColumnFile:
    """Read a ``.json`` or ``.jsonl`` file."""
    try:
        text = path.read_text("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BagError(f"{name}: no readable JSON ({_reason(error)})") from None
    document, problem = _parsed(text, name, whole=path.suffix.lower() == ".json")
    units: dict[str, str] = {}
    dates: set[str] = set()
    if isinstance(document, Mapping) and any(test in document for test in _TESTS):
        columns, units = _sysid(document, name)
    else:
        try:
            columns = dict(_columns("", document, 0, dates))
        except RecursionError:
            raise BagError(f"{name}: is nested too deeply") from None
    return ColumnFile(path, name, columns, units, dates, [damaged(problem)] if problem else [])


def _parsed(text: str, name: str, *, whole: bool) -> tuple[Any, str]:
    """Return what a text holds and what is amiss; lines of JSON may be called ``.json``, too."""
    reason = ""
    if whole:
        try:
            return json.loads(text), ""
        except (ValueError, RecursionError) as error:
            reason = _reason(error)
    try:
        return _lines(text, name)
    except (ValueError, RecursionError) as error:
        raise BagError(f"{name}: no readable JSON ({reason or _reason(error)})") from None


def _lines(text: str, name: str) -> tuple[list[Any], str]:
    """Return the objects of JSON lines; the last line may be cut off."""
    rows, bad = [], 0
    for line in filter(None, map(str.strip, text.splitlines())):
        try:
            rows.append(json.loads(line))
        except ValueError:
            bad += 1
    if not rows or bad > max(1, STRAY_ROWS.value * len(rows)):
        raise ValueError(f"{bad} of {bad + len(rows)} lines are no JSON")
    return rows, f"{name}: {bad} lines that are no JSON were left out" if bad else ""


def _columns(
    prefix: str, value: Any, depth: int, dates: set[str]
) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the columns of a document by their paths."""
    if depth > _DEEPEST:
        return
    if isinstance(value, Mapping):
        for key, inner in value.items():
            path = f"{prefix}.{key}" if prefix else str(key)
            yield from _columns(path, inner, depth + 1, dates)
        return
    if not isinstance(value, list) or len(value) < 2:
        return
    cells: dict[str, list[Any]] = {}
    for k, row in enumerate(value):
        for key, cell in _flat(prefix, row, depth):
            if key in cells or (len(cells) + 1) * len(value) < _MOST_CELLS:
                column = cells.setdefault(key, [])
                column.extend([None] * (k - len(column)))
                column.append(cell)
    for key, column in cells.items():
        column.extend([None] * (len(value) - len(column)))
        try:
            values, _, timed = grid.columns(
                [(cell,) for cell in column], [0], [key], key, range(1, len(column) + 1)
            )
        except BagError:
            continue  # a column of words
        if values[0].size != len(value):  # missing values are no empty rows here
            values = [np.array([_number(cell) for cell in column])]
        yield key, values[0]
        dates |= timed


def _number(cell: Any) -> float:
    try:
        return grid.number(cell)
    except (ValueError, OverflowError):
        return np.nan


def _flat(prefix: str, row: Any, depth: int) -> Iterator[tuple[str, Any]]:
    """Yield the numbers of one row by their paths."""
    if depth > _DEEPEST:
        return
    if isinstance(row, Mapping):
        for key, inner in row.items():
            yield from _flat(f"{prefix}.{key}" if prefix else str(key), inner, depth + 1)
    elif isinstance(row, list):
        for k, inner in enumerate(row[:_WIDEST]):
            yield from _flat(f"{prefix}[{k}]", inner, depth + 1)
    else:
        yield prefix or "value", row


def _sysid(
    document: Mapping[str, Any], name: str
) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Return the columns of all tests, one behind another."""
    every = chain.from_iterable(document.get(test) or [] for test in _TESTS)
    rows = [row for row in every if isinstance(row, list) and len(row) >= 4]
    width = max(map(len, rows), default=0)
    names = _SIMPLE if width == 4 else _DRIVE if document.get("sysid") else _OLD
    try:
        table = np.array([row for row in rows if len(row) == width], np.float64)
    except (TypeError, ValueError):
        raise BagError(f"{name}: its tests hold something else than rows of numbers") from None
    if not table.size or width > len(names):
        raise BagError(f"{name}: its tests hold no rows of {len(names)} numbers")
    table = table[np.argsort(table[:, 0], kind="stable")]
    turns = {"rotations": "rev", "radians": "rad", "degrees": "deg", "meters": "m", "feet": "ft"}
    unit = turns.get(str(document.get("units", "")).lower(), "")
    columns = {key: table[:, k] for k, key in enumerate(names[:width])}
    ends = {"position": unit, "velocity": f"{unit}/s"} if unit else {}
    units = {key: one for key in columns for end, one in ends.items() if key.endswith(end)}
    return columns, units


def _reason(error: BaseException) -> str:
    return "nested too deeply" if isinstance(error, RecursionError) else str(error)[:200]


FORMAT = Format("JSON", (".json", ".jsonl", ".ndjson"), b"", _open)
