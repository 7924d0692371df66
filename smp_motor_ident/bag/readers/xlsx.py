# SPDX-License-Identifier: Apache-2.0
"""Excel workbooks by openpyxl, cell by cell as Excel shows them."""

import json
from itertools import islice
from pathlib import Path
from typing import Any

from smp_motor_ident.bag.readers import apart, grid
from smp_motor_ident.bag.readers.format import ColumnFile, Format
from smp_motor_ident.bag.unpack import Budget
from smp_motor_ident.errors import BagError


def _open(path: Path, name: str, budget: Budget) -> ColumnFile:
    """Read the first sheet with the largest number of rows of numbers."""
    reason = f"{name}: holds no sheet"
    tables: list[tuple[grid.Grid, list[list[Any]]]] = []
    head, answer = apart.read("Excel", path, name, budget)
    for size in head.get("sheets", ()):
        filled = [json.loads(line) for line in islice(answer, size)]
        try:
            tables.append((grid.head(filled, name), filled))
        except BagError as error:
            reason = str(error)
    if not tables:
        raise BagError(reason)
    return _table(path, name, *max(tables, key=lambda one: len(one[1]) - one[0].first))


def _table(path: Path, name: str, top: grid.Grid, rows: list[list[Any]]) -> ColumnFile:
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


FORMAT = Format("Excel", (".xlsx",), b"PK\x03\x04", _open)
