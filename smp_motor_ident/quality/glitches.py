# SPDX-License-Identifier: Apache-2.0
"""Remove readings of speed and angle that jump away and back within one sample.

In white noise two of three readings exceed both neighbours; ten times the upper quartile of this
excess (the smaller of the two differences) is some nine standard deviations of the noise, or ten
quanta of a quantised signal, which chance does not reach.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from smp_motor_control.arrays import Array, Flags
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import MAX_GLITCH_SHARE, MIN_GLITCH_RATIO
from smp_motor_ident.record import Record

MIN_GLITCH_SHARE = 0.05  # share of the signal's range, and of the voltage's for a pulse
MIN_CHANGE_RATIO = 4.0  # ratio of a glitch to the usual change; counters dither by one or two
MAX_SAMPLED_READINGS = 4_000  # readings that determine the usual change
MAX_PASSES = 4  # a pass finds one of several adjacent glitches


def remove_glitches(record: Record) -> Record:
    """Remove readings of speed and angle that jump away and back from a record."""
    if record.count is not None and record.hardware.counts_per_revolution:
        return record
    pulsed = _mark_pulses(record.voltage)
    for name in ("velocity", "position"):
        values = getattr(record, name)
        if values is None:
            continue
        wrong = _find_glitches(values, pulsed)
        if not wrong.any() or wrong.mean() > MAX_GLITCH_SHARE:
            continue
        first = int(np.argmax(wrong))
        found = Finding(
            "glitches",
            "warning",
            f"{name} jumps away and back within one sample in {int(wrong.sum())} places (first at "
            f"{record.time[first]:.4g} s, {values[first]:.4g}): these readings were left out",
            {"signal": name, "samples": float(wrong.sum())},
            "look for a loose cable, or for overwritten messages",
        )
        left: Any = {name: np.where(wrong, np.nan, values)}
        record = replace(record, findings=(*record.findings, found), **left)
    return record


def count_glitches(record: Record, name: str) -> int:
    """Return the number of readings of a signal that were left out."""
    evidence = [f.evidence for f in record.findings if f.code == "glitches"]
    return sum(int(e["samples"] or 0) for e in evidence if e["signal"] == name)


def _find_glitches(values: Array, pulsed: Flags) -> Flags:
    wrong = np.zeros(values.size, dtype=np.bool_)
    for _ in range(MAX_PASSES):
        at = np.flatnonzero(np.isfinite(values) & ~wrong)
        beyond = _compute_excess(values[at])
        if beyond.size < 8 or not beyond.any():
            break
        some = slice(None, None, 1 + at.size // MAX_SAMPLED_READINGS)
        low, high = np.percentile(values[at][some], (1, 99))
        moves = np.abs(np.diff(values[at]))[some]
        least = max(
            MIN_GLITCH_RATIO * float(np.percentile(beyond[some], 75)),
            MIN_CHANGE_RATIO * float(np.median(moves[moves > 0])) if moves.any() else 0.0,
            MIN_GLITCH_SHARE * float(high - low),
        )
        found = at[1:-1][beyond > least]
        found = found[~pulsed[found]]
        if not found.size:
            break
        wrong[found] = True
    return wrong


def _compute_excess(values: Array) -> Array:
    """Return the excess of readings over both of their neighbours, shape (n - 2,)."""
    before, after = values[1:-1] - values[:-2], values[1:-1] - values[2:]
    same = np.sign(before) == np.sign(after)
    return np.where(same, np.minimum(np.abs(before), np.abs(after)), 0.0)


def _mark_pulses(voltage: Array) -> Flags:
    """Mark the rows next to a one-sample voltage pulse, which a fast motor follows."""
    pulse = np.zeros(voltage.size, dtype=np.bool_)
    pulse[1:-1] = _compute_excess(voltage) > MIN_GLITCH_SHARE * float(np.ptp(voltage))
    near: Flags = np.convolve(pulse, np.ones(5), "same") > 0
    return near
