"""A load that came or went while a motor was recorded: when, and the records cut there.

A constant load cannot stand for one that steps, nor can a line in time: what is left hides the
motor's lags and how its speed was filtered, on which all numbers hang.  A step of the load (in
volts, as a standing motor would show it) at each edge of `BLOCKS` parts is held against the model's
error, the model's own coordinates projected out; the one that explains most is when it was.  The
parts on both sides of that edge, in one of which it was, are left out, and what is before and after
has a load of its own.

References
----------
D. Andrews, Tests for parameter instability and structural change with unknown change point,
Econometrica 61 (1993), 821.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.effects import Effect, Motion
from smp_motor_ident.diagnosis.limits import HALF_EXPLAINED
from smp_motor_ident.diagnosis.model_error import (
    BLOCKS,
    measured,
    motions,
    own_responses,
    predicted,
    responses,
    signals,
    stacked,
    together,
    whitened,
)
from smp_motor_ident.estimation.descent import refine
from smp_motor_ident.estimation.disturbance import of_rows
from smp_motor_ident.estimation.fit import Fit, Options
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.record import Record


@dataclass(frozen=True, eq=False)
class LoadStep:
    """Records without the time in which the load changed."""

    records: list[Record]
    begin: float  # [s], from the beginning of the records
    end: float

    def finding(self) -> Finding:
        """Say when it was, and what was made of it."""
        return Finding(
            "load_step",
            "warning",
            f"the load changed between {self.begin:.3g} s and {self.end:.3g} s: that is left out, "
            "and the load before and after is not the same",
            {"begin": self.begin, "end": self.end},
            "record under one load; what the motor drives then is in none of the numbers",
        )


def load_step(
    group: Sequence[Record], since: Sequence[float], data: Experiments, fit: Fit, options: Options
) -> LoadStep | None:
    """Return the step of the load that explains most of the model's error, if one does.

    ``since``: time of each record at which what is given here begins [s].  That is asked of the
    free run: torque noise would stand for the step.
    """
    if fit.noise_ratio > 0:
        fit = refine(data, fit.structure, replace(fit, noise_ratio=0.0), fit.z, options)
    gear = group[0].hardware.gear_ratio
    edge = _edge(data, fit, gear)
    if edge is None or data.size != sum(map(len, group)):
        return None
    first, last = ((edge + n) * data.size // BLOCKS for n in (-1, 1))
    records, rows = [], np.arange(data.size)
    kept = (rows < first) | (rows >= last)
    ends = np.cumsum([0, *map(len, group)])
    for record, (a, b) in zip(group, pairwise(map(int, ends)), strict=True):
        if kept[a:b].any():
            records.append(of_rows(record, kept[a:b]))
    times = np.concatenate([r.time + t for r, t in zip(group, since, strict=True)])
    return LoadStep(records, float(times[first]), float(times[last - 1]))


def _edge(data: Experiments, fit: Fit, gear: float) -> int | None:
    """Return at the beginning of which part the load steps, if that explains most of the error."""
    sections, samples = motions(data, fit, gear)
    made = [signals(_stepped(n), sections, samples)[0] for n in range(1, BLOCKS)]
    own = whitened(data, fit, own_responses(data, fit, together(data)))
    table = np.array([*own, stacked(data, fit, measured(data) - predicted(data, fit)),
                      *whitened(data, fit, responses(data, fit, made))]).T  # fmt: skip
    if not np.isfinite(table).all():
        return None
    length = np.maximum(np.sqrt(np.square(table).sum(axis=0)), 1e-300)
    q, _ = np.linalg.qr(table[:, : len(own)] / length[: len(own)])
    rest = table[:, len(own) :] - q @ (q.T @ table[:, len(own) :])
    error, steps = rest[:, 0], rest[:, 1:]
    gain = _explained(error, steps)
    edge = int(np.argmax(gain))
    return edge + 1 if gain[edge] > HALF_EXPLAINED.value * float(error @ error) else None


def _explained(error: Array, steps: Array) -> Array:
    """Return how much of an error's square each of the columns explains by itself."""
    return np.asarray(np.square(error @ steps) / np.maximum(np.square(steps).sum(axis=0), 1e-300))


def _stepped(part: int) -> Effect:
    """Return a load that begins with a part."""

    def load(m: Motion) -> list[Array]:
        return [np.where(0.5 * (m.share + 1.0) < part / BLOCKS, 0.0, 1.0)]

    return Effect("load_step", "torque", "", "", load)
