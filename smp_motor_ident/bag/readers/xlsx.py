"""Excel workbooks by openpyxl, which is asked for only when one is read."""

import zipfile
from pathlib import Path
from typing import Any

from smp_motor_ident.bag.readers import grid
from smp_motor_ident.bag.readers.format import ColumnFile, Format
from smp_motor_ident.bag.storage import first_line
from smp_motor_ident.bag.unpack import Budget
from smp_motor_ident.errors import BagError


def _open(path: Path, name: str, budget: Budget) -> ColumnFile:
    """Read the sheet of a workbook that has most rows of numbers, the first of several."""
    reason = f"{name}: holds no sheet"
    tables: list[tuple[grid.Grid, list[tuple[Any, ...]]]] = []
    for rows in _sheets(path, name, budget):
        filled = [row for row in rows if any(cell is not None for cell in row)]
        try:
            tables.append((grid.head(filled, name), filled))
        except BagError as error:
            reason = str(error)
    if not tables:
        raise BagError(reason)
    return _table(path, name, *max(tables, key=lambda one: len(one[1]) - one[0].first))


def _table(path: Path, name: str, top: grid.Grid, rows: list[tuple[Any, ...]]) -> ColumnFile:
    body = rows[top.first :]
    columns, dates, findings = {}, set(), list(top.findings)
    for j, title in enumerate(top.names):
        try:
            values, more, timed = grid.columns(
                body, [j], [title], name, range(top.first + 1, len(rows) + 1)
            )
        except BagError:
            continue  # a column of words
        if values[0].size == len(body):
            columns[title] = values[0]
            dates |= timed
            findings += more
    return ColumnFile(path, name, columns, top.units, dates, findings)


def _sheets(path: Path, name: str, budget: Budget) -> list[list[tuple[Any, ...]]]:
    """Return the rows of every sheet with cells."""
    try:
        import openpyxl
    except ImportError:
        raise BagError(
            f"{name}: is an Excel workbook, which needs openpyxl (pip install openpyxl); "
            "or save it as CSV"
        ) from None
    try:
        with zipfile.ZipFile(path) as archive:
            budget.take(sum(entry.file_size for entry in archive.infolist()))
        workbook = openpyxl.load_workbook(path, read_only=True, data_only=True)
        return [list(sheet.values) for sheet in workbook.worksheets if hasattr(sheet, "values")]
    except BagError:
        raise
    except Exception as error:  # openpyxl raises whatever a spoilt XML leads it to
        raise BagError(f"{name}: no readable workbook ({first_line(error)[:200]})") from None


FORMAT = Format("Excel", (".xlsx",), b"PK\x03\x04", _open)
