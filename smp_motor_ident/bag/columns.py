"""Any fields of any topics of a bag as arrays, where no record of a motor is wanted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.bag.decode import collect
from smp_motor_ident.bag.source import recordings
from smp_motor_ident.bag.types import Types
from smp_motor_ident.errors import BagError


@dataclass(frozen=True, eq=False)
class Columns:
    """Fields of one topic."""

    # shape (n,), [s]: header stamps where the messages have them, else when they were recorded;
    # since 1970
    time: NDArray[np.float64]
    fields: Mapping[str, NDArray[Any]]  # shape (n,): by field path


def read_columns(path: Path, wanted: Mapping[str, Sequence[str]]) -> dict[str, Columns]:
    """Read fields of topics of one bag; a topic without a message is an error."""
    asked = {topic: list(fields) for topic, fields in wanted.items()}
    found = {}
    for recording in recordings([path]):
        for topic, table in collect(recording, asked, Types(()), None).items():
            assert table.log is not None
            clock = table.log if table.stamp is None else table.stamp
            if clock.size == 0:
                raise BagError(f"{recording.name}: has no message on {topic}")
            found[topic] = Columns(1e-9 * clock.astype(np.float64), table.columns)
    return found
