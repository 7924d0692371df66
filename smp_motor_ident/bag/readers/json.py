# SPDX-License-Identifier: Apache-2.0
"""JSON logs: rows of objects, objects of columns, JSON lines, and WPILib's SysId.

SysId and its forerunner frc-characterization keep lists of rows by the name of the test
(``slow-forward`` and the like); the number of columns determines their meaning.

References
----------
github.com/wpilibsuite/sysid: docs/data-collection.md (rows and units), AnalysisManager.cpp
(``unitsPerRotation``); github.com/wpilibsuite/frc-characterization: data_logger.py,
data_analyzer.py, Robot.java.mako (its rows, and since when they are in rotations).
"""

import json
from collections.abc import Iterator, Mapping
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.bag.readers import grid
from smp_motor_ident.bag.readers.format import ColumnFile, Format
from smp_motor_ident.bag.storage import note, note_damage
from smp_motor_ident.bag.units import UNITS, needs, parse_unit
from smp_motor_ident.bag.unpack import Budget
from smp_motor_ident.errors import BagError
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import MAX_COLUMNS, MAX_STRAY_ROW_SHARE

_TESTS = ("slow-forward", "slow-backward", "fast-forward", "fast-backward")
_ONE_MOTOR = ("Simple", "Arm", "Elevator")
_SIGNALS = ("voltage", "position", "velocity")
_SIDES = tuple(f"{side}_{what}" for what in _SIGNALS for side in ("left", "right"))
_FORERUNNER_COLUMNS = ("time", "battery", "autospeed")
_FORMS = {
    **dict.fromkeys(((True, 4), (False, 4)), ("time", *_SIGNALS)),
    (True, 9): ("time", *_SIDES, "angle", "angular_rate"),
    (False, 6): (*_FORERUNNER_COLUMNS, *_SIGNALS),
    (False, 9): (*_FORERUNNER_COLUMNS, *_SIDES),
    (False, 10): (*_FORERUNNER_COLUMNS, *_SIDES, "gyro"),
}
"""Names of the columns by their number: of SysId, or of its forerunner."""
_UNITS_TOLERANCE = 0.01  # of a file's units per rotation
_MAX_DEPTH = 16
_MAX_ELEMENTS = 64
_MAX_CELLS = 5_000_000


def _open(path: Path, name: str, budget: Budget) -> ColumnFile:
    """Read a ``.json`` or ``.jsonl`` file."""
    document, problem = _parse(path, name)
    units: dict[str, str] = {}
    dates: set[str] = set()
    radius = 0.0
    problems: list[Finding] = []
    if isinstance(document, Mapping) and any(test in document for test in _TESTS):
        columns, units, radius, problems = _read_sysid(document, name)
    else:
        try:
            columns = dict(islice(_columns("", document, 0, dates), round(MAX_COLUMNS) + 1))
        except RecursionError:
            raise BagError(f"{name}: is nested too deeply") from None
    problems += [note_damage(problem)] if problem else []
    return ColumnFile(path, name, columns, units, dates, problems, radius)


def _parse(path: Path, name: str) -> tuple[Any, str]:
    """Return the content of a file and a remark on errors; accept JSON lines in ``.json``."""
    reason = ""
    try:
        text = path.read_text("utf-8-sig")
        if path.suffix.lower() == ".json":
            try:
                return json.loads(text), ""
            except (ValueError, RecursionError) as error:
                reason = _describe_error(error)
        return _parse_lines(text, name)
    except (ValueError, RecursionError) as error:
        raise BagError(f"{name}: no readable JSON ({reason or _describe_error(error)})") from None


def _parse_lines(text: str, name: str) -> tuple[list[Any], str]:
    """Return the objects of JSON lines; the last line may be cut off."""
    lines = list(filter(None, map(str.strip, text.splitlines())))
    try:
        return json.loads(f"[{','.join(lines)}]"), ""
    except ValueError:
        pass  # not every file with this name is one document
    rows, bad = [], 0
    for line in lines:
        try:
            rows.append(json.loads(line))
        except ValueError:
            bad += 1
            if bad > 1 + MAX_STRAY_ROW_SHARE * len(lines):
                break
    if not rows or bad > max(1, MAX_STRAY_ROW_SHARE * len(rows)):
        raise ValueError(f"{bad} of {bad + len(rows)} lines are not JSON")
    return rows, f"{name}: {bad} lines that are not JSON were left out" if bad else ""


def _columns(
    prefix: str, value: Any, depth: int, dates: set[str]
) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the columns of a document by their paths."""
    if depth > _MAX_DEPTH:
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
        for key, cell in _flatten(prefix, row, depth):
            if key in cells or (len(cells) + 1) * len(value) < _MAX_CELLS:
                column = cells.setdefault(key, [])
                column.extend([None] * (k - len(column)))
                column.append(cell)
    for key, column in cells.items():
        column.extend([None] * (len(value) - len(column)))
        if {*map(type, column)} <= {int, float} and max(map(abs, column)) < 2**53:
            yield key, np.array(column, np.float64)
            continue
        try:
            values, _, timed = grid.columns(
                [(cell,) for cell in column], [0], [key], key, range(1, len(column) + 1)
            )
        except BagError:
            continue  # a column of words
        if values[0].size != len(value):  # missing values are no empty rows here
            filled = (grid.number(c) if grid.is_convertible(c) else np.nan for c in column)
            values = [np.array([*filled])]
        yield key, values[0]
        dates |= timed


def _flatten(prefix: str, row: Any, depth: int) -> Iterator[tuple[str, Any]]:
    """Yield the numbers of one row by their paths."""
    if depth > _MAX_DEPTH:
        return
    if isinstance(row, Mapping):
        for key, inner in row.items():
            yield from _flatten(f"{prefix}.{key}" if prefix else str(key), inner, depth + 1)
    elif isinstance(row, list):
        for k, inner in enumerate(row[:_MAX_ELEMENTS]):
            yield from _flatten(f"{prefix}[{k}]", inner, depth + 1)
    else:
        yield prefix or "value", row


def _read_sysid(
    document: Mapping[str, Any], name: str
) -> tuple[dict[str, NDArray[Any]], dict[str, str], float, list[Finding]]:
    """Return the joined columns of all tests, their units, the wheel's radius and findings.

    With ``unitsPerRotation`` the rows are in rotations (in SysId always, in its forerunner since
    April 2020), and that number converts them to ``units``; otherwise they are in ``units``.  A
    number that contradicts a unit of angle is replaced.
    """
    every = chain.from_iterable(document.get(test) or [] for test in _TESTS)
    rows = [row for row in every if isinstance(row, list) and len(row) >= 4]
    width = max(map(len, rows), default=0)
    form = _FORMS.get((bool(document.get("sysid")), width), ())
    try:
        table = np.array([row for row in rows if len(row) == width], np.float64)
        factor = float(document.get("unitsPerRotation") or 1.0)
    except (TypeError, ValueError, OverflowError):
        raise BagError(f"{name}: its tests do not hold rows of numbers") from None
    if not table.size or not form or not 0 < factor < np.inf:
        widths = ", ".join(sorted({str(width) for _, width in _FORMS}))
        raise BagError(f"{name}: its tests hold no rows of {widths} numbers, or no valid units")
    table = table[np.argsort(table[:, 0], kind="stable")]
    columns = {key: table[:, k] for k, key in enumerate(form)}
    if str(document.get("test", "Drivetrain")) in _ONE_MOTOR and "left_voltage" in columns:
        columns = {k.removeprefix("left_"): c for k, c in columns.items() if "right" not in k}
    unit = parse_unit(str(document.get("units", ""))) or ""
    unit = unit if unit in UNITS["position"] else ""
    rim = needs("position", unit, "wheel_radius")
    problems = []
    right = 2 * np.pi / UNITS["position"][unit].factor if unit and not rim else factor
    if document.get("unitsPerRotation") and abs(factor / right - 1) > _UNITS_TOLERANCE:
        text = f"{name}: says {factor:g} {unit} per rotation, which has {right:g}; correct it"
        problems.append(note("units_per_rotation", text, "warning", stated=factor))
        factor = right
    units = {}
    for key in columns:
        what = key.rpartition("_")[2]
        if unit and what in ("position", "velocity"):
            units[key] = unit if what == "position" else f"{unit}/s"
            columns[key] = factor * columns[key]
    metres = UNITS["position"][unit].factor if rim else 0.0
    return columns, units, factor * metres / (2 * np.pi), problems


def _describe_error(error: BaseException) -> str:
    return "nested too deeply" if isinstance(error, RecursionError) else str(error)[:200]


FORMAT = Format("JSON", (".json", ".jsonl", ".ndjson"), b"", _open)
