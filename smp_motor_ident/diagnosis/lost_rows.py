"""Rows that a log lost: what the command was in between is not its value in the next row."""

from dataclasses import replace

import numpy as np

from smp_motor_ident.diagnosis.limits import ROWS_LOST
from smp_motor_ident.finding import Finding
from smp_motor_ident.record import Record

REGULAR = 0.1  # of an interval by which intervals differ from whole ones


def bridged(record: Record) -> Record:
    """Return a record with the mean of a linearly changing voltage where rows were lost.

    Of ``m`` intervals the last is held at the next row's voltage: their mean is
    ``v1 + (v2 - v1) (m + 1) / (2 m)``.  Readers of bags have done so.
    """
    step = np.diff(record.time)
    if step.size < 2 or any(f.code == "samples_missing" for f in record.findings):
        return record
    share = step / float(np.median(step))
    whole = np.rint(share)
    regular = np.abs(share - whole) < REGULAR
    few = (whole > 1) & (whole <= 1 + ROWS_LOST.value)
    few[np.array(record.starts[1:], dtype=np.int64) - 1] = False
    if not few.any() or not regular.all(where=whole <= 1 + ROWS_LOST.value):
        return record
    k = np.flatnonzero(few)
    voltage, m = record.voltage.copy(), whole[k]
    before = record.voltage[k]
    voltage[k + 1] = before + (record.voltage[k + 1] - before) * (m + 1) / (2 * m)
    lost = int((m - 1).sum())
    words = f"{lost} rows missing in {k.size} places; their voltage was interpolated"
    found = Finding("samples_missing", "note", words, {"samples": float(lost)})
    return replace(record, voltage=voltage, findings=(*record.findings, found))
