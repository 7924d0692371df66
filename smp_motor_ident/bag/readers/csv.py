# SPDX-License-Identifier: Apache-2.0
"""CSV files as loggers, scopes and spreadsheets write them."""

import csv
import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.bag.names import separates_motors
from smp_motor_ident.bag.readers import grid
from smp_motor_ident.bag.readers.format import Format, Tables
from smp_motor_ident.bag.storage import TABLE, Channel, Table
from smp_motor_ident.bag.unpack import Budget
from smp_motor_ident.errors import BagError

_COMMENTS = ("#", "%", "//")
_ARROW, _TIME = " -> ", re.compile(r"\d\d?:\d\d:\d\d")
_WORD = r"[A-Za-z_]\w*"
_LABEL = re.compile(
    rf"(?:^|(?<=[\s,;|]))({_WORD}(?: {_WORD})*(?=\s*[:=])|{_WORD})\s*[:=,;\s]\s*(?=[-+.\d])"
)
"""Label before each number in the rows of a serial plotter or debug output."""
_UNIT = re.compile(r"(?<=\d) ?([A-Za-z%°µ][\w%°µ/]*)(?=\s*(?:[,;|]|$))")
"""Unit behind a labelled number: ``Speed: 33 rpm, Duty: 40%``."""
_EXAMINED_ROWS = 60  # rows that tell the layout
_MAX_LABELLED_ROW = 4096  # characters of a row that may have labels


class _CsvFile(Tables):
    """A text of rows, separated by comma, semicolon, tab, bar or blanks."""

    def __init__(self, path: Path, name: str, budget: Budget) -> None:
        super().__init__(path, name)
        self._lines = _decode_text(path).splitlines()
        filled = (k for k, s in enumerate(self._lines) if s.strip() and not s.startswith(_COMMENTS))
        seen = list(islice(filled, _EXAMINED_ROWS))
        if not seen:
            raise BagError(f"{path}: is empty")
        if sum(map(_is_quoted_row, (self._lines[k] for k in seen))) > len(seen) / 2:
            self._lines = [s.strip()[1:-1] if _is_quoted_row(s) else s for s in self._lines]
        if all(self._lines[k].rstrip().endswith(";") for k in seen):
            self._lines = [s.rstrip().removesuffix(";") for s in self._lines]
        if any(self._lines[k].lstrip().startswith("[") for k in seen):
            self._lines = [_strip_brackets(s) for s in self._lines]
        usual = self._lines[seen[len(seen) // 2]]
        if _ARROW in usual:  # behind a serial monitor's time of arrival
            mark = next((c for c in ";\t," if c in usual), " ")
            self._lines = [s.replace(_ARROW, mark) for s in self._lines]
        labels, seen = self._split_labels(seen)
        self._separator = _find_separator([self._lines[k] for k in seen])
        rows = [_split_row(self._lines[k], self._separator) for k in seen]
        if self._separator == " ":
            rows = [
                self._split_names(self._lines[k], row, len(rows[len(rows) // 2]))
                for k, row in zip(seen, rows)
            ]
        self._grid = grid.head(rows, str(path))
        self._first = seen[self._grid.first]
        above = [labels] if labels else self._read_comment_header(len(rows[self._grid.first]))
        if above and not self._grid.named:
            self._grid = grid.head([*above, *rows[self._grid.first :]], str(path))
        self.problems += self._grid.findings
        self._words = self._number_motor_names()
        known = grid.numeric(self._grid.names, rows[self._grid.first :])
        self._numeric = tuple(n for n in self._grid.names if n in known or n in self._words)

    def channels(self) -> list[Channel]:
        """Return the one table, without columns of words except those that name motors."""
        units, words = self._grid.units, self._words
        return [Channel(0, "", "", TABLE, fields=self._numeric, units=units, words=words)]

    def _number_motor_names(self) -> dict[str, tuple[str, ...]]:
        """Replace the words of columns that name motors by numbers; return the words."""
        found = {}
        # Single letters may be words of any column
        for j in [j for j, name in enumerate(self._grid.names) if separates_motors(name, "A")]:
            rows = {k: _split_row(s, self._separator) for k, s in enumerate(self._lines)}
            body = {k: row for k, row in rows.items() if k >= self._first and j < len(row)}
            words = grid.words([row[j].strip() for row in body.values()])
            if words and separates_motors(self._grid.names[j], words):
                found[self._grid.names[j]] = words
                for k, row in body.items():
                    if row[j].strip() in words:
                        row[j] = str(words.index(row[j].strip()))
                        quoted = (f'"{c}"' if self._separator in c else c for c in row)
                        self._lines[k] = self._separator.join(quoted)
        return found

    def table(self, topic: str, fields: Sequence[str]) -> Table:
        """Return columns; cells that are empty are NaN."""
        names = self._grid.names
        self._check(fields, names)
        use = [names.index(name) for name in fields]
        fast = self._read_plain_numbers(use)
        if fast is not None:
            return Table(None, None, dict(zip(fields, fast)))
        body = self._lines[self._first :]
        lines = [k for k, s in enumerate(body, self._first + 1) if not s.startswith("#")]
        rows = [_split_row(s, self._separator) for s in body if not s.startswith("#")]
        values, findings, dates = grid.columns(rows, use, fields, str(self.path), lines)
        columns = dict(zip(fields, values))
        return Table(None, None, columns, findings=findings, exact=frozenset(dates))

    def _read_plain_numbers(self, use: list[int]) -> list[NDArray[Any]] | None:
        """Return columns of plain numbers; None where cells need a closer look."""
        try:
            values = np.loadtxt(
                (f"{line}\n" for line in islice(self._lines, self._first, None)),
                delimiter=None if self._separator == " " else self._separator,
                usecols=use,
                ndmin=2,
                quotechar='"',
            )
        except ValueError:
            return None
        if not values.size or np.max(np.abs(values), where=~np.isnan(values), initial=0) >= 2.0**53:
            return None
        return [values[:, k].copy() for k in range(len(use))]

    def _split_labels(self, seen: list[int]) -> tuple[list[str], list[int]]:
        """Take the labels off rows that have one before every number; return them and such rows."""
        usual = self._lines[seen[len(seen) // 2]]
        if len(usual) > _MAX_LABELLED_ROW:
            return [], seen
        labels: list[str] = _LABEL.findall(usual)
        alike = [k for k in seen if labels and _LABEL.findall(self._lines[k]) == labels]
        bare = [_strip_labels(self._lines[k]) for k in alike]
        units = [_UNIT.search(cell) for cell in re.split("[,;|]", _LABEL.sub("", usual))]
        if len(units) == len(labels):
            labels = [f"{one} [{unit[1]}]" if unit else one for one, unit in zip(labels, units)]
        widths = {len(re.split(r"[\s,;|]+", text.strip())) for text in bare}
        names = (["time"] if bare and _TIME.match(bare[0].strip()) else []) + labels
        if len(alike) <= len(seen) / 2 or widths != {len(names)}:
            return [], seen
        self._lines = [_strip_labels(line) for line in self._lines]
        return names, alike

    @staticmethod
    def _split_names(line: str, row: list[str], width: int) -> list[str]:
        """Split a row of names at wider gaps than between words; return none if that fails."""
        if len(row) <= width or grid.is_data(row):
            return row
        apart = re.split(r"\s{2,}", line.strip())
        return apart if len(apart) == width else []

    def _read_comment_header(self, width: int) -> list[list[str]]:
        """Return the comments right above the numbers that name columns, and their units."""
        above: list[list[str]] = []
        for line in reversed(self._lines[: self._first]):
            text = line.strip()
            if not text.startswith(_COMMENTS):
                break
            cells = self._split_comment(text.lstrip("#%/ \t"), width)
            if not cells or grid.is_data(cells):
                break
            above.insert(0, cells)
        return above[-2:]

    def _split_comment(self, text: str, width: int) -> list[str]:
        """Return the cells of a comment where it has as many as the rows, none of them empty."""
        marks = [*self._separator.strip(), *";\t|,", *[None][: self._separator == " "]]
        several = [[cell.strip(' \t"') for cell in text.split(mark)] for mark in marks]
        return next((c for c in several if len(c) == width and all(c)), [])


def _strip_brackets(line: str) -> str:
    """Return a row of a matrix or of lists without its brackets."""
    text = line.strip().removesuffix(";").removesuffix("]")
    return text[1:] if text[:1] == "[" and text[1:2].strip("0123456789.+-") == "" else text


def _strip_labels(line: str) -> str:
    """Return a row without its labels and units."""
    return _UNIT.sub("", _LABEL.sub("", line))


def _split_row(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    try:
        return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:
        return line.split(separator)


def _is_quoted_row(line: str) -> bool:
    """Return whether a whole row is in quotes, and would be read as one cell."""
    text = line.strip()
    if text.count('"') != 2 or not (text[0] == text[-1] == '"'):
        return False
    return not grid.is_data([text[1:-1]]) and any(mark in text for mark in ";\t|, ")


def _find_separator(lines: list[str]) -> str:
    """Return the separator that splits most lines into numbers; a comma may be decimal."""
    usual = lines[len(lines) // 2 :]
    likely = [c for c in ";\t|," if sum(c in line for line in usual) > 2 / 3 * len(usual)]
    likely += [" "] if any(" " in line.strip() for line in usual) else []
    sound = {c: sum(grid.share_of_numbers(_split_row(line, c)) for line in usual) for c in likely}
    return max(sound, key=lambda c: sound[c], default=",")


def _decode_text(path: Path) -> str:
    """Return a file's text in any encoding that spreadsheets and scopes write."""
    data = path.read_bytes()
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", "replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        if b"\0" in data:
            raise BagError(f"{path}: is not text") from None
        return data.decode("latin-1")  # such as a degree sign in an old code page


FORMAT = Format("CSV", (".csv", ".tsv", ".txt", ".dat", ".log"), b"", _CsvFile)
