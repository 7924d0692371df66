"""CSV files as loggers, scopes and spreadsheets write them."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.bag.readers import grid
from smp_motor_ident.bag.readers.format import Format, Tables
from smp_motor_ident.bag.storage import TABLE, Channel, Table
from smp_motor_ident.bag.unpack import Budget
from smp_motor_ident.errors import BagError

_COMMENTS = ("#", "%", "//")


class _CsvFile(Tables):
    """A text of rows, separated by comma, semicolon, tab, bar or blanks."""

    def __init__(self, path: Path, name: str, budget: Budget) -> None:
        super().__init__(path, name)
        self._lines = _text(path).splitlines()
        filled = [k for k, s in enumerate(self._lines) if s.strip() and not s.startswith(_COMMENTS)]
        if not filled:
            raise BagError(f"{path}: is empty")
        seen = filled[:60]
        self._separator = _separator([self._lines[k] for k in seen])
        self._grid = grid.head([self._row(self._lines[k]) for k in seen], str(path))
        self._first = seen[self._grid.first]
        self.problems += self._grid.findings

    def channels(self) -> list[Channel]:
        """Return the one table."""
        return [Channel(0, "", "", TABLE, fields=tuple(self._grid.names), units=self._grid.units)]

    def table(self, topic: str, fields: Sequence[str]) -> Table:
        """Return columns; cells that are empty are NaN."""
        names = self._grid.names
        for name in fields:
            if name not in names:
                raise BagError(f"{self.path}: has no column {name!r}; it has {', '.join(names)}")
        use = [names.index(name) for name in fields]
        body = self._lines[self._first :]
        fast = self._fast(body, use)
        if fast is not None:
            return Table(None, None, dict(zip(fields, fast)))
        numbered = [(k, s) for k, s in enumerate(body, self._first + 1) if not s.startswith("#")]
        rows = [self._row(s) for _, s in numbered]
        values, findings, dates = grid.columns(
            rows, use, fields, str(self.path), [k for k, _ in numbered]
        )
        columns = dict(zip(fields, values))
        return Table(None, None, columns, findings=findings, exact=frozenset(dates))

    def _fast(self, body: list[str], use: list[int]) -> list[NDArray[Any]] | None:
        """Return columns of plain numbers; None where cells need a closer look."""
        try:
            values = np.loadtxt(
                io.StringIO("\n".join(body)),
                delimiter=None if self._separator == " " else self._separator,
                usecols=use,
                ndmin=2,
                quotechar='"',
            )
        except ValueError:
            return None
        if not values.size or np.nanmax(np.abs(values), initial=0.0) >= 2.0**53:
            return None
        return [values[:, k].copy() for k in range(len(use))]

    def _row(self, line: str) -> list[str]:
        if self._separator == " ":
            return line.split()
        try:
            return next(csv.reader([line], delimiter=self._separator, skipinitialspace=True), [])
        except csv.Error:
            return line.split(self._separator)


def _separator(lines: list[str]) -> str:
    """Return what most lines are divided by; a comma may be a decimal one."""
    usual = lines[len(lines) // 2 :]
    for candidate in ";\t|,":
        if sum(candidate in line for line in usual) >= 0.9 * len(usual):
            return candidate
    return " " if any(" " in line.strip() for line in usual) else ","


def _text(path: Path) -> str:
    """Return a file's text in whatever spreadsheets and scopes write."""
    try:
        data = path.read_bytes()
        if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
            return data.decode("utf-16", "replace")
        return data.decode("utf-8-sig")
    except OSError as error:
        raise BagError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        if b"\0" in data:
            raise BagError(f"{path}: is no text") from None
        return data.decode("latin-1")  # a degree sign in an old code page


FORMAT = Format("CSV", (".csv", ".tsv", ".txt", ".dat", ".log"), b"", _CsvFile)
