"""A speed that is the difference of a coarse counter's counts over one sample: its counts again.

The rounding error of a count comes twice in such a speed, once each way, so that the errors of
neighbouring speeds go against each other (correlation -1/2) and sum up to that of one count.  As
independent errors of a speed they would be far larger than what the data hold, and a loop that
answers to them would bias the fit.  Over several samples the neighbours share no count.

References
----------
L. Ljung, System Identification, 2nd ed. (1999), section 13.4 (noise that a loop feeds back).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.diagnosis.limits import NEIGHBOURS
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import speed_quantum
from smp_motor_ident.record import Record

Array = NDArray[np.float64]

SMOOTH = 9  # samples of which a mean leaves the motion and hardly the rounding
EVEN = 0.5  # of the usual interval: stamps that are off by more may hide a lost sample


def counts_again(record: Record) -> Record:
    """Return a record with the angle that its speed is the difference of, if it is one."""
    velocity = record.velocity
    if velocity is None or record.count is not None or record.position is not None:
        return record
    quantum, step = speed_quantum(velocity), record.sample_time
    if quantum == 0.0 or not np.isfinite(velocity).all():
        return record
    intervals = np.delete(np.diff(record.time), [s - 1 for s in record.starts if s > 0])
    moved = np.rint(velocity / quantum)
    if np.abs(intervals - step).max() > EVEN * step or not _against_each_other(moved):
        return record
    found = Finding(
        "speed_summed",
        "note",
        f"the speed comes in steps of {quantum:.4g} rad/s, a count a sample, whose errors go "
        "against each other: the counts that it was made of are used",
        {"quantum": quantum},
        "record the encoder's counts",
    )
    return replace(
        record,
        position=np.cumsum(moved) * quantum * step,
        velocity_window=step,
        findings=(*record.findings, found),
    )


def rounding(record: Record) -> float:
    """Return the noise [rad/s] of a recorded speed whose counts are used, 0 where it is another."""
    found = next((f for f in record.findings if f.code == "speed_summed"), None)
    return 0.0 if found is None else float(found.evidence["quantum"] or 0.0) / 6**0.5


def _against_each_other(moved: Array) -> bool:
    """Tell by the correlation of neighbours, once what is smooth is gone."""
    smooth = np.convolve(moved, np.full(SMOOTH, 1 / SMOOTH), "same")
    rest = (moved - smooth)[SMOOTH:-SMOOTH]
    size = float(rest @ rest)
    return size > 0.0 and float(rest[1:] @ rest[:-1]) < NEIGHBOURS.value * size
