"""Several recordings of one motor as one record."""

from dataclasses import replace
from typing import Any

import numpy as np

from smp_motor_ident.bag.storage import found
from smp_motor_ident.errors import BagError
from smp_motor_ident.record import Record

_COLUMNS = ("voltage", "current", "velocity", "position", "count")
BETWEEN = 1.0
"""Time [s] that a joined record leaves between two recordings."""


def join_records(records: list[Record]) -> Record:
    """Join recordings of one motor; each begins a new segment, one second behind the last."""
    if len(records) == 1:
        return records[0]
    first = records[0]
    for other in records[1:]:
        for name in ("gear_ratio", "counts_per_revolution"):
            here, there = getattr(first.hardware, name), getattr(other.hardware, name)
            if here != there:
                raise BagError(
                    f"{first.wheel}: {name} is {here} in {first.source} and {there} in "
                    f"{other.source}; identify them apart"
                )
    offsets = np.cumsum([0.0, *(r.duration + BETWEEN for r in records)])[:-1]
    lengths = np.cumsum([0, *(len(r) for r in records)])[:-1].tolist()
    findings = [replace(f, message=f"{r.source}: {f.message}") for r in records for f in r.findings]
    columns: dict[str, Any] = dict.fromkeys(_COLUMNS)
    for name in _COLUMNS:
        parts = [getattr(r, name) for r in records]
        if all(part is None for part in parts):
            continue
        if any(part is None for part in parts):
            if name == "count":
                text = "count: not in all recordings, left out"
                findings.append(found("count_left_out", text, "warning"))
                continue
            parts = [np.full(len(r), np.nan) if p is None else p for r, p in zip(records, parts)]
        columns[name] = np.concatenate(parts)
    return replace(
        first,
        time=np.concatenate([r.time + offset for r, offset in zip(records, offsets)]),
        starts=tuple(s + n for r, n in zip(records, lengths) for s in r.starts),
        source=", ".join(dict.fromkeys(r.source for r in records)),
        findings=tuple(f for k, f in enumerate(findings) if f not in findings[:k]),
        **columns,
    )
