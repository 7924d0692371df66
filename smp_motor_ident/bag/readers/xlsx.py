"""Excel workbooks by openpyxl, which is asked for only when one is read."""

from __future__ import annotations

import zipfile
from pathlib import Path

from smp_motor_ident.bag.readers import grid
from smp_motor_ident.bag.readers.columns import ColumnFile
from smp_motor_ident.bag.readers.format import Format
from smp_motor_ident.bag.unpack import Budget
from smp_motor_ident.errors import BagError


class _Workbook(ColumnFile):
    """The first sheet of an ``.xlsx`` file that holds numbers."""

    def __init__(self, path: Path, name: str, budget: Budget) -> None:
        try:
            import openpyxl
        except ImportError:
            raise BagError(
                f"{name}: is an Excel workbook, which needs openpyxl (pip install openpyxl); "
                "or save it as CSV"
            ) from None
        reason = ""
        try:
            with zipfile.ZipFile(path) as archive:
                budget.take(sum(entry.file_size for entry in archive.infolist()))
            workbook = openpyxl.load_workbook(path, read_only=True, data_only=True)
            sheets = [
                list(sheet.values) for sheet in workbook.worksheets if hasattr(sheet, "values")
            ]
        except BagError:
            raise
        except Exception as error:  # openpyxl raises whatever a spoilt XML leads it to
            reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
            raise BagError(f"{name}: no readable workbook ({reason})") from None
        for rows in sheets:
            filled = [row for row in rows if any(cell is not None for cell in row)]
            try:
                top = grid.head(filled, name)
            except BagError as error:
                reason = str(error)
                continue
            use = range(len(top.names))
            body = filled[top.first :]
            columns, dates, findings = {}, set(), list(top.findings)
            for j in use:
                try:
                    values, more, timed = grid.columns(
                        body, [j], [top.names[j]], name, range(top.first + 1, len(filled) + 1)
                    )
                except BagError:
                    continue  # a column of words
                if values[0].size == len(body):
                    columns[top.names[j]] = values[0]
                    dates |= timed
                    findings += more
            super().__init__(path, name, columns, top.units, dates)
            self.problems += findings
            return
        raise BagError(reason or f"{name}: holds no sheet")


FORMAT = Format("Excel", (".xlsx",), b"PK\x03\x04", _Workbook)
