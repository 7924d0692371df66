"""What files of named columns have in common."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.bag.readers.format import Tables
from smp_motor_ident.bag.storage import TABLE, Channel, Table
from smp_motor_ident.errors import BagError
from smp_motor_ident.finding import Finding


class ColumnFile(Tables):
    """A file of columns, one table of the topic ``""``; ``dates`` are columns of nanoseconds."""

    def __init__(
        self,
        path: Path,
        name: str,
        columns: Mapping[str, NDArray[Any]],
        units: Mapping[str, str] | None = None,
        dates: Collection[str] = (),
        problems: Sequence[Finding] = (),
    ) -> None:
        super().__init__(path, name)
        self.problems += problems
        if not columns:
            raise BagError(f"{name}: holds no column of numbers")
        self._columns = columns
        self._units = units or {}
        self._dates = dates

    def channels(self) -> list[Channel]:
        """Return the one table."""
        return [Channel(0, "", "", TABLE, fields=tuple(self._columns), units=self._units)]

    def table(self, topic: str, fields: Sequence[str]) -> Table:
        """Return columns; all must have the same length."""
        for name in fields:
            if name not in self._columns:
                have = ", ".join(self._columns)
                raise BagError(f"{self.path}: has no column {name!r}; it has {have}")
        columns = {name: self._columns[name] for name in fields}
        sizes = {name: column.size for name, column in columns.items()}
        if len(set(sizes.values())) > 1:
            lengths = ", ".join(f"{name} {size}" for name, size in sizes.items())
            raise BagError(f"{self.path}: its columns differ in length: {lengths}")
        exact = frozenset(n for n in fields if n in self._dates)
        return Table(None, None, {n: np.asarray(c) for n, c in columns.items()}, exact=exact)
