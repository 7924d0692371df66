# SPDX-License-Identifier: Apache-2.0
"""Read formats in a separate process, since their libraries may hang, crash or fill the memory.

MATLAB files: version 4 to 7.2 by scipy, version 7.3 by h5py where it is installed.  Vectors and the
columns of matrices become columns of one table per length, fields of structures by their path.
Excel workbooks: by openpyxl, cell by cell as Excel shows them.
"""

import io
import json
import subprocess
import sys
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from smp_motor_ident.bag.readers import grid
from smp_motor_ident.bag.readers.format import ColumnFile, Format
from smp_motor_ident.bag.storage import note
from smp_motor_ident.bag.unpack import Budget
from smp_motor_ident.errors import BagError

PROGRAM = Path(__file__).parent / "program.py"
TIMEOUT_S, TIMEOUT_PER_BYTE_S = 15.0, 1e-6
"""Longest time to read a file [s], and addition per byte of it."""


def read(kind: str, path: Path, name: str, budget: Budget) -> tuple[dict[str, Any], io.BytesIO]:
    """Return the program's description of a file, and its data."""
    command = [sys.executable, str(PROGRAM), kind, str(path), str(budget.left)]
    patience = TIMEOUT_S + TIMEOUT_PER_BYTE_S * path.stat().st_size
    try:
        done = subprocess.run(command, capture_output=True, check=False, timeout=patience)
    except subprocess.TimeoutExpired:
        raise BagError(
            f"{name}: is not read after {patience:.0f} s, too long for its size; save "
            "its columns as CSV"
        ) from None
    if done.returncode:
        raise BagError(f"{name}: damaged {kind} file (its reader ends with {done.returncode})")
    answer = io.BytesIO(done.stdout)
    head = json.loads(answer.readline())
    if head["too_large"]:
        budget.take(budget.left + 1)
    budget.take(len(done.stdout))
    if head["error"]:
        raise BagError(f"{name}: {head['error']}")
    return head, answer


_MAX_NAMED_OBJECTS = 4  # objects named in a message


def _open_matlab(path: Path, name: str, budget: Budget) -> ColumnFile:
    """Read a file of any version."""
    head, answer = read("MATLAB", path, name, budget)
    columns = {key: np.load(answer, allow_pickle=False) for key in head.get("columns", ())}
    objects = ", ".join(list(dict.fromkeys(head["objects"]))[:_MAX_NAMED_OBJECTS])
    advice = (
        f"{name}: holds MATLAB objects, such as a timeseries or a Simulink Dataset, which only "
        f"MATLAB can read: {objects}; save its Time and Data as arrays there: "
        "t = x.Time; y = x.Data; save('log.mat', 't', 'y'), where of a Dataset x = data{1}.Values"
    )
    if head["objects"] and not columns:
        raise BagError(advice)
    file = ColumnFile(path, name, columns)
    if head["objects"]:
        file.problems.append(note("matlab_object", advice, "warning"))
    return file


MATLAB_4 = Format("MATLAB 4", (".mat",), b"\0\0\0\0", _open_matlab)
MATLAB_5 = Format("MATLAB", (".mat",), b"MATLAB 5.0 MAT", _open_matlab)
MATLAB_73 = Format("MATLAB 7.3", (".mat",), b"MATLAB 7.3 MAT", _open_matlab)


def _open_excel(path: Path, name: str, budget: Budget) -> ColumnFile:
    """Read the first sheet with the largest number of rows of numbers."""
    reason = f"{name}: holds no sheet"
    tables: list[tuple[grid.Grid, list[list[Any]]]] = []
    head, answer = read("Excel", path, name, budget)
    for size in head.get("sheets", ()):
        filled = [json.loads(line) for line in islice(answer, size)]
        try:
            tables.append((grid.head(filled, name), filled))
        except BagError as error:
            reason = str(error)
    if not tables:
        raise BagError(reason)
    return _read_sheet(path, name, *max(tables, key=lambda one: len(one[1]) - one[0].first))


def _read_sheet(path: Path, name: str, top: grid.Grid, rows: list[list[Any]]) -> ColumnFile:
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


EXCEL = Format("Excel", (".xlsx",), b"PK\x03\x04", _open_excel)
