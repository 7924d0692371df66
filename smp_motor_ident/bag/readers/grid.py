# SPDX-License-Identifier: Apache-2.0
"""Parse rows of cells of spreadsheets and loggers: names, units, numbers, times."""

import re
from array import array
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import date, datetime, time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.bag.readers.format import check_width
from smp_motor_ident.bag.storage import note
from smp_motor_ident.bag.units import parse_unit
from smp_motor_ident.errors import BagError
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import MAX_STRAY_ROW_SHARE

Row = Sequence[Any]
_MISSING = ("", "nan", "na", "n/a", "null", "none", "-", "inf", "-inf", "#n/a")
_WORDS = {
    **dict.fromkeys(("true", "on", "fwd", "forward", "forwards", "f", "cw"), 1),
    **dict.fromkeys(("false", "off", "stop", "stopped", "neutral", "n"), 0),
    **dict.fromkeys(("rev", "reverse", "backward", "backwards", "bwd", "r", "b", "ccw"), -1),
}
_ISO = re.compile(
    r"(?:(\d{4}-\d\d-\d\d)[T _.])?(\d\d?):(\d\d):(\d\d)(?:[.,](\d{1,9}))? ?(Z|[+-]\d\d:?\d\d)?"
)
_BRACKETS = re.compile(r"\s*[\[(]([^\])]*)[\])]\s*$")
_EXAMINED_ROWS = 60  # rows examined to tell names from numbers
_MAX_EXAMINED = 1000  # examined cells of a row; examined rows without a number
_MAX_NAME_LENGTH = 200  # characters of a column's name
_YEARS = range(1678, 2262)  # range of nanoseconds in 64 bits


@dataclass
class Grid:
    """First row of numbers of a table, and the names of its columns."""

    names: list[str]
    units: dict[str, str]
    first: int
    findings: list[Finding] = field(default_factory=list)

    @property
    def named(self) -> bool:
        """Whether the columns have names of the file."""
        return all(finding.code != "no_column_names" for finding in self.findings)


def head(rows: Sequence[Row], where: str) -> Grid:
    """Find the rows of names, of units and of numbers."""
    seen = rows[:_EXAMINED_ROWS]
    data = [*map(is_data, seen), True]
    first = next((k for k in range(len(seen)) if data[k] and data[k + 1]), None)
    if first is None:
        raise BagError(f"{where}: has no rows of numbers; give a table of samples")
    width = len(seen[first])
    check_width(width, where)
    above = [row for row in seen[:first] if sum(not _is_empty(c) for c in row) > width / 2]
    if not above:
        names = [f"c{k}" for k in range(1, width + 1)]
        text = f"{where}: has no row of names; its columns are called {names[0]} to {names[-1]}"
        return Grid(names, {}, first, [note("no_column_names", text)])
    named, given = above[-1], [""] * width
    if len(above) > 1 and all(_is_empty(c) or parse_unit(_strip(c)) is not None for c in above[-1]):
        named, given = above[-2], [_strip(c) for c in above[-1]]
    units: dict[str, str] = {}
    columns: dict[str, int] = {}
    for k in range(width):
        text = str(named[k]).strip() if k < len(named) and not _is_empty(named[k]) else f"c{k + 1}"
        text = text[:_MAX_NAME_LENGTH]
        text = f"{text}_{k + 1}" if text in columns else text
        columns[text] = k
        bracket = _BRACKETS.search(text)
        unit = parse_unit(given[k] if k < len(given) else "") or (
            parse_unit(bracket[1]) if bracket else None
        )
        if unit or str(seen[first][k]).endswith("%"):
            units[text] = unit or "%"
    return Grid(list(columns), units, first)


def numeric(names: Sequence[str], rows: Sequence[Row]) -> tuple[str, ...]:
    """Return the names of the columns with numbers."""
    filled = [[row[k] for row in rows if k < len(row)] for k in range(len(names))]
    filled = [[cell for cell in column if not _is_empty(cell)] for column in filled]
    return tuple(
        name for name, cells in zip(names, filled) if not cells or any(map(is_convertible, cells))
    )


def words(cells: Sequence[str]) -> tuple[str, ...]:
    """Return the words of a column without outliers; none for numbers, states or one word."""
    counts = Counter(filter(None, cells))
    usual = tuple(c for c, n in counts.items() if n > MAX_STRAY_ROW_SHARE * len(cells))
    if len(usual) < 2 or any(map(_is_number, usual)) or all(c.lower() in _WORDS for c in usual):
        return ()
    return usual


def strip_unit(name: str) -> str:
    """Return a column's name without the unit in brackets behind it."""
    return _BRACKETS.sub("", name)


def _is_empty(cell: Any) -> bool:
    return cell is None or not str(cell).strip()


def _strip(cell: Any) -> str:
    return str(cell).strip().strip("[]()")


def is_data(row: Row) -> bool:
    """Return whether at least half of a row's cells are numbers."""
    return share_of_numbers(row) >= 0.5


def share_of_numbers(row: Row) -> float:
    """Return the share of numbers among a row's cells that are not empty."""
    sound = [_is_number(cell) for cell in row[:_MAX_EXAMINED] if not _is_empty(cell)]
    return sum(sound) / max(len(sound), 1)


def _is_number(cell: Any) -> bool:
    return is_convertible(cell) and not (isinstance(cell, str) and cell.strip().lower() in _WORDS)


def is_convertible(cell: Any) -> bool:
    """Return whether a cell is a number, empty, or a word or time that counts as one."""
    try:
        number(cell)
    except (ValueError, OverflowError):
        return False
    return True


def number(cell: Any) -> float:
    """Return a cell's number, NaN where it is empty; ValueError where it is something else."""
    if cell is None:
        return np.nan
    if isinstance(cell, (int, float)):
        return float(cell)
    text = str(cell).strip()
    try:
        return float(text)
    except ValueError:
        lower = text.lower()
        if lower in _MISSING:
            return np.nan
        if lower in _WORDS:
            return float(_WORDS[lower])
        if text.endswith("%"):
            return number(text[:-1])
        if text.count(",") == 1:
            return float(text.replace(",", "."))
        return nanoseconds(cell) * 1e-9


def nanoseconds(cell: Any) -> int:
    """Return the nanoseconds of an ISO 8601 time, since 1970 or since midnight."""
    if isinstance(cell, (datetime, date, time)):
        cell = cell.isoformat()
    match = _ISO.fullmatch(str(cell).strip())
    if match is None or (match[1] and int(match[1][:4]) not in _YEARS):
        raise ValueError(f"{cell!r} is neither number nor time")
    day, hours, minutes, seconds, part, zone = match.groups("")
    days = int(np.datetime64(day or "1970-01-01", "D").astype(np.int64))
    shift = int(f"{zone[0]}1") * (60 * int(zone[1:3]) + int(zone[-2:])) if zone.strip("Z") else 0
    since = (24 * days + int(hours)) * 60 + int(minutes) - shift
    return (60 * since + int(seconds)) * 10**9 + int(part.ljust(9, "0"))


def columns(
    rows: Sequence[Row], use: Sequence[int], names: Sequence[str], where: str, lines: Sequence[int]
) -> tuple[list[NDArray[Any]], list[Finding], set[str]]:
    """Return columns as numbers, findings, and the names of the columns of dates [ns].

    Rows without numbers, such as a repeated header, are left out with a finding;
    ``lines`` are the rows' for messages.
    """
    kept = array("d")
    stray: list[int] = []
    sound_rows: list[Row] = []
    last = 0  # row of numbers
    for k, row in enumerate(rows):
        if all(_is_empty(cell) for cell in row):
            continue
        try:
            kept.extend([number(row[j]) if j < len(row) else np.nan for j in use])
            sound_rows.append(row)
            last = k
        except (ValueError, OverflowError):
            stray.append(k)
            if len(stray) > _MAX_EXAMINED and not kept:
                break
    # Notes below the table do not belong to it.
    inside = [k for k in stray if k < last or 2 * len(rows[k]) > len(rows[last])]
    if len(inside) > MAX_STRAY_ROW_SHARE * (len(sound_rows) + len(inside)):
        k = inside[0]
        raise BagError(f"{where}: line {lines[k]}, {_describe_bad_cell(rows[k], use, names)}")
    findings = []
    if stray:
        text = f"{where}: {len(stray)} rows without numbers were left out, the first in line "
        findings.append(note("stray_rows", f"{text}{lines[stray[0]]}", "warning"))
    values = np.array(kept).reshape(len(sound_rows), len(use))
    exact = [_convert(sound_rows, j, values[:, n]) for n, j in enumerate(use)]
    dates = {name for name, (_, timed) in zip(names, exact) if timed}
    return [column for column, _ in exact], findings, dates


def _convert(rows: Sequence[Row], j: int, column: NDArray[Any]) -> tuple[NDArray[Any], bool]:
    """Return a column, as integers if float64 would round it, and whether it holds times."""
    if not column.size or not np.isfinite(column).all():
        return column, False
    first = rows[0][j]
    timed = not isinstance(first, (int, float)) and _ISO.fullmatch(str(first).strip())
    try:
        if timed or isinstance(first, (datetime, date, time)):
            return np.array([nanoseconds(row[j]) for row in rows], np.int64), True
        if np.abs(column).max() >= 2.0**53:
            whole = [int(row[j]) for row in rows]
            return np.array(whole, np.int64 if max(whole) < 2**63 else np.uint64), False
    except (ValueError, OverflowError, TypeError):
        pass
    return column, False


def _describe_bad_cell(row: Row, use: Sequence[int], names: Sequence[str]) -> str:
    """Return a remark on the cell that is not a number."""
    for name, j in zip(names, use):
        try:
            number(row[j] if j < len(row) else None)
        except (ValueError, OverflowError):
            cell = str(row[j]).strip()
            kind = f"date from {_YEARS[0]} to {_YEARS[-1]}" if _ISO.fullmatch(cell) else "number"
            return f"column {name!r}: {cell[:40]!r} is not a {kind}"
    return "is not a row of numbers"
