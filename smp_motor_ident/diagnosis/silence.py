"""A sensor that falls silent: dead, or of a motion too small for it to show."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from smp_motor_ident.diagnosis.limits import FEWEST, FLICKER, SILENT_SWING
from smp_motor_ident.errors import SignalError
from smp_motor_ident.record import Record

Array = NDArray[np.float64]

LAGS = 20  # between a sampling interval and a quarter of the record: each 1.5 times the last


def silent(record: Record, where: str) -> None:
    """Refuse a sensor that stops half-way while the voltage goes on and would move the motor."""
    for name in ("count", "position", "velocity"):
        values = getattr(record, name)
        if values is None or len(record) < 200:
            continue
        # A speed may well be constant; only at zero does it say that nothing turns.
        moves = values != 0 if name == "velocity" else np.diff(values, prepend=np.nan) != 0
        edges = np.concatenate([[0], np.flatnonzero(moves), [len(record) - 1]])
        longest = int(np.argmax(np.diff(edges)))
        a, b = int(edges[longest]), int(edges[longest + 1])
        if b - a < max(100, 0.1 * len(record)):
            continue
        still, rest = record.voltage[a + 1 : b], np.delete(record.voltage, np.arange(a, b))
        if np.abs(still).mean() <= 0.5 * np.abs(rest).mean():
            continue
        if _swing(record, name, a, b) > SILENT_SWING.value:
            raise SignalError(
                f"{where}: dead encoder, the {name} stays at {values[a + 1]:.6g} from "
                f"t = {record.time[a]:.4g} s to {record.time[b]:.4g} s while the voltage reaches "
                f"{np.abs(still).max():.3g} V; check the encoder's cable, or that nothing "
                "blocks the motor"
            )


def _swing(record: Record, name: str, a: int, b: int) -> float:
    """Return by how many of its smallest steps the voltage lets a sensor move in a silence.

    The rest of the record says how: ``speed = g x - f sign(x)``, where ``x`` is the voltage through
    a first-order lag.  An angle swings by what the speed covers between two changes of its sign.
    """
    values, step = getattr(record, name), np.diff(record.time, prepend=record.time[0])
    levels = np.diff(np.unique(values[np.isfinite(values)]))
    levels = levels[levels > 1e-9 * levels.sum()]  # not what the rounding of a float leaves
    with np.errstate(divide="ignore", invalid="ignore"):
        speed = values if name == "velocity" else np.diff(values, prepend=np.nan) / step
    known = np.isfinite(speed)
    known[a : b + 1] = False
    known[list(record.starts)] = False
    if known.sum() < FEWEST.value or not levels.size:
        return float("inf")  # nothing says how the motor answers
    expected, least = _answer(record, speed, known), float(levels.min())
    if name == "velocity":
        # Differences of counts flicker, and show on average what is below their step; a rounded
        # speed does not: it changes where the motion crosses from one of its levels to the next.
        changes = np.count_nonzero(np.diff(speed[known]))
        if changes < FLICKER.value * np.abs(np.diff(expected[known])).sum() / least:
            return float(np.abs(expected[a:b]).max() / least)
        least *= float(np.median(step))
    turns = np.flatnonzero(np.diff(np.sign(expected[a:b]), prepend=np.nan) != 0)
    return float(np.abs(np.add.reduceat(expected[a:b] * step[a:b], turns)).max() / least)


def _answer(record: Record, speed: Array, known: NDArray[np.bool_]) -> Array:
    """Return the speed that the voltage lets expect, by what is known of it."""
    step = float(np.median(np.diff(record.time)))
    best: Array = np.zeros(len(record))
    least = np.inf
    for lag in np.geomspace(step, record.duration / 4, LAGS):
        keeps = float(np.exp(-step / lag))
        x = lfilter([1 - keeps], [1, -keeps], record.voltage)
        columns = np.column_stack([x, np.sign(x)])
        answer, *_ = np.linalg.lstsq(columns[known], speed[known], rcond=1e-8)
        left = float(np.square(speed[known] - columns[known] @ answer).sum())
        if left < least:
            moved = columns @ answer  # friction does not drive
            best, least = np.where(moved * answer[0] * x > 0, moved, 0.0), left
    return best
