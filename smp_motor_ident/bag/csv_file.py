"""CSV files as recordings: one table, columns by name."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.bag.table import Table
from smp_motor_ident.errors import BagError

Array = NDArray[np.float64]
_MISSING = ("", "nan", "na", "n/a", "null", "none", "-")


class CsvFile:
    """A file of rows with one row of names.

    Parameters
    ----------
    path : Path
        Comma, semicolon, tab or blank separated; lines that begin with ``#`` are left out.

    Raises
    ------
    BagError
        When it cannot be read or has no row of names.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        text = _text(path)
        lines = text.splitlines()
        self._first = next((k for k, s in enumerate(lines) if s.strip() and s[0] != "#"), -1)
        if self._first < 0:
            raise BagError(f"{path}: is empty")
        self._separator = max(",;\t", key=lines[self._first].count)
        if not lines[self._first].count(self._separator):
            self._separator = " "
        self.names = [name.strip() for name in self._row(lines[self._first])]
        if any(_is_number(name) for name in self.names):
            raise BagError(f"{path}: needs a first row with the names of its columns")
        self._lines = lines

    def _row(self, line: str) -> list[str]:
        options = {"delimiter": self._separator, "skipinitialspace": True}
        return next(csv.reader([line], **options), [])  # type: ignore[arg-type]

    def columns(self, names: list[str]) -> dict[str, Array]:
        """Return columns as numbers.

        Parameters
        ----------
        names : list of str
            As in the first row.

        Returns
        -------
        dict of str to ndarray, shape (n,)
            NaN where a cell is empty.

        Raises
        ------
        BagError
            When a column does not exist, or a cell is no number.
        """
        for name in names:
            if name not in self.names:
                raise BagError(
                    f"{self.path}: has no column {name!r}; it has {', '.join(self.names)}"
                )
        use = [self.names.index(name) for name in names]
        body = self._lines[self._first + 1 :]
        if not any(line.strip() for line in body):
            raise BagError(f"{self.path}: has no rows below the names of its columns")
        try:
            values = np.loadtxt(
                io.StringIO("\n".join(body)),
                delimiter=None if self._separator == " " else self._separator,
                usecols=use,
                ndmin=2,
                quotechar='"',
            )
        except ValueError:
            values = self._slowly(use)
        if not values.size:
            raise BagError(f"{self.path}: has no rows below the names of its columns")
        return {name: values[:, k].copy() for k, name in enumerate(names)}

    def _slowly(self, use: list[int]) -> Array:
        """Read cell by cell: with empty cells, decimal commas, or an error that is named."""
        rows = []
        for number, line in enumerate(self._lines[self._first + 1 :], self._first + 2):
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            cells = self._row(line)
            rows.append([self._cell(cells, column, number) for column in use])
        return np.array(rows, np.float64).reshape(len(rows), len(use))

    def _cell(self, cells: list[str], column: int, line: int) -> float:
        text = cells[column].strip() if column < len(cells) else ""
        if text.lower() in _MISSING:
            return np.nan
        if self._separator != "," and text.count(",") == 1:
            text = text.replace(",", ".")
        try:
            return float(text)
        except ValueError:
            raise BagError(
                f"{self.path}: line {line}, column {self.names[column]!r}: {text!r} is no number"
            ) from None


def _text(path: Path) -> str:
    """Return a file's text in whatever spreadsheets and scopes write."""
    try:
        data = path.read_bytes()
        if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
            return data.decode("utf-16")
        return data.decode("utf-8-sig")
    except OSError as error:
        raise BagError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        if b"\0" in data:
            raise BagError(f"{path}: is no text") from None
        return data.decode("latin-1")  # a degree sign in an old code page


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def read_table(path: Path, names: list[str], time: tuple[str, float] | float) -> Table:
    """Read columns of a CSV file as a table."""
    file = CsvFile(path)
    seconds: Array
    if isinstance(time, tuple):
        columns = file.columns(list(dict.fromkeys([*names, time[0]])))
        seconds = np.asarray(columns[time[0]] * time[1], np.float64)
    else:
        columns = file.columns(names)
        seconds = np.arange(next(iter(columns.values())).size, dtype=np.float64) * time
    timed = np.isfinite(seconds)
    notes = []
    if not timed.all():
        notes.append(f"{path.name}: {int((~timed).sum())} rows without time were left out")
        columns = {name: column[timed] for name, column in columns.items()}
        seconds = seconds[timed]
    if not seconds.size:
        raise BagError(f"{path}: has no rows with a time")
    start = seconds.min()
    log = np.rint((seconds - start) * 1e9).astype(np.int64)
    return Table(log, None, dict(columns), notes=notes)
