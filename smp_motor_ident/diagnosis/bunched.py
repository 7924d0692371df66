"""Stamps that stand in bunches: one sample of each bunch is what they tell."""

from dataclasses import replace
from typing import Any

import numpy as np

from smp_motor_ident.diagnosis.limits import BUNCHED
from smp_motor_ident.finding import Finding
from smp_motor_ident.record import Record


def merge_bunches(record: Record) -> Record:
    """Merge samples with (nearly) equal stamps where most of a record's samples are such.

    A clock too coarse for the rate, or a transport that delivers many messages at once, stamps
    several samples alike.  The last of a bunch was measured next to its stamp; the voltage is
    the mean of the bunch's, for the bunch spans the time since the one before.
    """
    starts = np.array(record.starts)
    step = np.diff(record.time)
    within = np.ones(step.size, dtype=bool)
    within[starts[1:] - 1] = False
    if not within.any():
        return record
    near = BUNCHED.value * float(step[within].mean())
    if float(np.median(step[within])) >= near:
        return record
    last = np.append((step >= near) | ~within, True)
    kept = np.flatnonzero(last)
    first = np.append(0, kept[:-1] + 1)
    if kept.size < 2:
        return record
    share = 1.0 - kept.size / len(record)
    arrays: dict[str, Any] = {
        name: None if (values := getattr(record, name)) is None else values[kept]
        for name in ("time", "current", "velocity", "position", "count")
    }
    finding = Finding(
        "stamps_equal",
        "warning",
        f"{share:.0%} of the samples have the stamp of the sample before; of samples that are "
        "stamped alike the last was used",
        {"share": share, "samples": float(kept.size)},
        "stamp each sample where it is measured, with a clock finer than the sampling interval",
    )
    return replace(
        record,
        voltage=np.add.reduceat(record.voltage, first) / np.diff(np.append(first, len(record))),
        starts=tuple(int(k) for k in np.searchsorted(kept, starts)),
        findings=(*record.findings, finding),
        **arrays,
    )
