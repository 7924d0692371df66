# SPDX-License-Identifier: Apache-2.0
"""Select the excited part of a recording, and evenly spread stretches of a long one."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import MAX_EXCERPT_ROWS, MAX_REST_VOLTAGE, MIN_SAMPLES
from smp_motor_ident.record import Record

STRETCH_COUNT = 8
"""Number of stretches of a long record: enough to show changes, each longer than the lag."""

MIN_REST_ROWS = 2_000
REST_MARGIN = 10  # rows of rest kept on either side
MAX_NOISE_STDS = 6.0  # standard deviations of sensor noise that do not count as motion


def _estimate_white_std(values: Array) -> float:
    """Return the standard deviation of white noise, by the median fourth difference: 1 4 6 4 1."""
    if values.size < 8:
        return 0.0
    return float(np.median(np.abs(np.diff(values, n=4))) / 0.6745 / np.sqrt(70))


def find_excitation(record: Record) -> tuple[int, int]:
    """Return first and end of the excited rows of a record, for `Record.slice`."""
    moves = np.abs(record.voltage) > MAX_REST_VOLTAGE * np.abs(record.voltage).max()
    for name in ("velocity", "position", "count"):
        values = getattr(record, name)
        if values is None:
            continue
        y = np.where(np.isfinite(values), values, 0.0)
        y = y if name == "velocity" else np.diff(y, prepend=y[0])
        noise = 0.0 if name == "count" else _estimate_white_std(y)
        moves |= np.abs(y) > max(MAX_REST_VOLTAGE * float(np.abs(y).max()), MAX_NOISE_STDS * noise)
        break
    busy = np.flatnonzero(moves)
    # A rest shorter than the excitation does not hide it, and shows the sensor's noise.
    if not busy.size or (busy[0] < MIN_REST_ROWS and len(record) < 2 * (busy[-1] - busy[0])):
        return 0, len(record)
    # A sensor offset during a long rest would contradict any friction.
    return max(0, int(busy[0]) - REST_MARGIN), min(len(record), int(busy[-1]) + REST_MARGIN + 1)


def select_excerpts(
    records: Sequence[Record], max_rows: int = round(MAX_EXCERPT_ROWS)
) -> list[Record]:
    """Return evenly spread stretches of records that have more than ``max_rows`` rows in all."""
    rows = sum(map(len, records))
    count = -(-STRETCH_COUNT // len(records)) if records else 0
    parts: list[Record] = []
    for record in records:
        length = max_rows * len(record) // (rows * count)
        if rows <= max_rows or length < MIN_SAMPLES:
            parts.append(record)
        else:
            parts += _cut_stretches(record, count, length)
    return parts


def _cut_stretches(record: Record, count: int, length: int) -> list[Record]:
    """Return stretches of equal length, with a finding."""
    found = Finding(
        "excerpt",
        "note",
        f"the record has {len(record)} rows; {count} stretches of {length} rows were used, because "
        "more rows cost time and hardly narrow the estimates",
        {"rows": float(len(record)), "used": float(count * length)},
        "to use a certain part, cut the recording",
    )
    record = replace(record, findings=(*record.findings, found))
    begins = np.linspace(0, len(record) - length, count).astype(np.int64).tolist()
    return [record.slice(begin, begin + length) for begin in begins]
