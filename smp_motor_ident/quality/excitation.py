# SPDX-License-Identifier: Apache-2.0
"""The parts of recordings that tell of a motor: the excitation, and stretches of a long one."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import EXCERPT, FEWEST, REST
from smp_motor_ident.record import Record

STRETCHES = 8
"""Stretches of a long record: enough to show a motor that changes, each long against its lag."""

LONG = 2_000  # samples of rest that are worth removing
MARGIN = 10  # samples of rest kept on either side
SCATTER = 6.0  # standard deviations of sensor noise that do not count as motion


def _scatter(values: Array) -> float:
    """Return the standard deviation of white noise, by the median fourth difference: 1 4 6 4 1."""
    if values.size < 8:
        return 0.0
    return float(np.median(np.abs(np.diff(values, n=4))) / 0.6745 / np.sqrt(70))


def excitation(record: Record) -> tuple[int, int]:
    """Return the rows from a record's first to its last excitation, as of `Record.slice`."""
    moves = np.abs(record.voltage) > REST * np.abs(record.voltage).max()
    for name in ("velocity", "position", "count"):
        values = getattr(record, name)
        if values is None:
            continue
        y = np.where(np.isfinite(values), values, 0.0)
        y = y if name == "velocity" else np.diff(y, prepend=y[0])
        noise = 0.0 if name == "count" else _scatter(y)
        moves |= np.abs(y) > max(REST * float(np.abs(y).max()), SCATTER * noise)
        break
    busy = np.flatnonzero(moves)
    # A rest shorter than the excitation does not hide it, and shows the sensor's noise.
    if not busy.size or (busy[0] < LONG and len(record) < 2 * (busy[-1] - busy[0])):
        return 0, len(record)
    # An offset of the sensor, seen long enough at rest, would speak against any friction.
    return max(0, int(busy[0]) - MARGIN), min(len(record), int(busy[-1]) + MARGIN + 1)


def excerpts(records: Sequence[Record], most: int = round(EXCERPT)) -> list[Record]:
    """Return evenly spread stretches of records that have more than ``most`` rows in all."""
    rows = sum(map(len, records))
    count = -(-STRETCHES // len(records)) if records else 0
    parts: list[Record] = []
    for record in records:
        length = most * len(record) // (rows * count)
        if rows <= most or length < FEWEST:
            parts.append(record)
        else:
            parts += _stretches(record, count, length)
    return parts


def _stretches(record: Record, count: int, length: int) -> list[Record]:
    """Return stretches of so many rows each, with a finding that tells of them."""
    found = Finding(
        "excerpt",
        "note",
        f"the record has {len(record)} rows; {count} stretches of {length} rows were used, since "
        "more rows take longer and hardly narrow the estimates",
        {"rows": float(len(record)), "used": float(count * length)},
        "cut the recording to have a certain part of it used",
    )
    record = replace(record, findings=(*record.findings, found))
    begins = np.linspace(0, len(record) - length, count).astype(np.int64).tolist()
    return [record.slice(begin, begin + length) for begin in begins]
