"""What something else did to the motor for a while: a hand, an obstacle, a wheel that slipped.

Torque noise that explains it hides the motor in all of the record.  Blocks of the record, each with
an initial state of its own, are fitted by a motor of first order; those that it leaves far worse
explained than the usual one are left out and the rest is fitted again, until these stay the same
(least trimmed squares by concentration steps).  Since the fit of all may be so wrong that no block
stands out, they begin at the stretch of the record that explains most of the others best.

Torque noise leaves a speed an error that the motor forgets within its time constant ``tau``, so
that the mean square over a block of ``T`` is a chi-square of ``T / (2 tau)`` degrees of freedom;
an angle never forgets, and has one.

References
----------
P. Rousseeuw and K. Van Driessen, Data Mining and Knowledge Discovery 12 (2006), 29.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.special import chdtri

from smp_motor_control.arrays import Array, Flags
from smp_motor_ident.diagnosis.limits import DISTURBED, LEFT_OUT
from smp_motor_ident.diagnosis.sample_limits import STILL_EXCITED
from smp_motor_ident.estimation.fit import Fit, Options, Start, solve
from smp_motor_ident.estimation.initialisation import first_fit
from smp_motor_ident.estimation.prediction import simulate
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments, angle_of, prepare
from smp_motor_ident.likelihood.passes import gather
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.model.structures import FirstOrder
from smp_motor_ident.record import Record

BLOCKS = 30  # of all records together, at most
STRETCHES = 6  # of the same, each of which may be the one that nothing disturbed
ROUNDS = 6  # most times that the rest is fitted
FEWEST = 8  # samples of a block
NEAR = 0.1  # of the largest voltage, by which levels may differ that do the same to a driver


@dataclass(frozen=True, eq=False)
class Disturbance:
    """Where a motor was moved by something else, and the records without it."""

    records: list[Record]
    spans: list[tuple[float, float]]  # [s], from the beginning of the records

    def finding(self) -> Finding:
        """Say when it was, and that it was left out."""
        when = ", ".join(f"from {a:.3g} s to {b:.3g} s" for a, b in self.spans)
        return Finding(
            "disturbed",
            "warning",
            f"something else than the voltage moved or held the motor {when}: left out",
            {f"span_{n}": f"{a:.4g} s to {b:.4g} s" for n, (a, b) in enumerate(self.spans, 1)},
            "look for what touched the motor or made its wheel slip then; the numbers are those of "
            "the rest of the record",
        )


def disturbance(group: Sequence[Record], since: Sequence[float]) -> Disturbance | None:
    """Return where something else moved the motor, if that is a small part of the records.

    Parameters
    ----------
    group : sequence of Record
        Of one motor.
    since : sequence of float
        Time of each record at which what is given here begins [s].

    Returns
    -------
    Disturbance or None
        None where there is none, or where it is no small part.
    """
    blocks = [_in_blocks(r, sum(map(len, group))) for r in group]
    kept = _alike(blocks)
    if kept is None or kept.all():
        return None
    beside = kept & np.append(kept[1:], True) & np.append(True, kept[:-1])  # it begins within one
    records, spans, first = [], [], 0
    for record, begin in zip(blocks, since, strict=True):
        edges = [*record.starts, len(record)]
        own = beside[first : first + len(record.starts)]
        rows = np.repeat(own, np.diff(edges))
        first += len(record.starts)
        ends = np.flatnonzero(np.diff(np.concatenate([[True], rows, [True]]).astype(int)))
        for a, b in zip(ends[::2], ends[1::2], strict=True):
            spans.append((begin + float(record.time[a]), begin + float(record.time[b - 1])))
        if rows.any():
            records.append(of_rows(record, rows))
    left = _as_far(records, blocks) and _as_moved(blocks, beside)
    return Disturbance(records, spans) if left else None


def _as_far(records: Sequence[Record], whole: Sequence[Record]) -> bool:
    """Tell whether what is left was driven as far, both ways: what a level does is no accident."""
    left, every = (np.concatenate([r.voltage for r in part]) for part in (records, whole))
    largest = float(np.abs(every).max())
    return bool(
        left.max() >= every.max() - NEAR * largest and left.min() <= every.min() + NEAR * largest
    )


def _as_moved(blocks: Sequence[Record], kept: Flags) -> bool:
    """Tell whether most of the voltage's changes are in what is left: the rest tells no lag.

    A record that begins with a voltage begins with a change.
    """
    rows = np.repeat(kept, np.concatenate([np.diff([*r.starts, len(r)]) for r in blocks]))
    change = np.concatenate([np.abs(np.diff(r.voltage, prepend=0.0)) for r in blocks])
    return bool(change[rows].sum() > STILL_EXCITED.value * change.sum())


def _in_blocks(record: Record, rows: int) -> Record:
    """Return a record with segments of a block's length at most."""
    length = max(rows // BLOCKS, FEWEST)
    edges = [*record.starts, len(record)]
    cuts = [
        a + (b - a) * k // count
        for a, b in pairwise(edges)
        if (count := max(round((b - a) / length), 1))
        for k in range(count)
    ]
    return replace(record, starts=tuple(cuts))


def of_rows(record: Record, rows: Flags) -> Record:
    """Return some rows of a record, in segments where others are missing."""
    at = np.flatnonzero(rows)
    starts = {0, *(np.flatnonzero(np.diff(at) > 1) + 1), *np.searchsorted(at, record.starts)}
    names = ("time", "voltage", "current", "velocity", "position", "count")
    there = {n: v for n in names if (v := getattr(record, n)) is not None}
    return replace(
        record,
        starts=tuple(int(s) for s in sorted(starts) if s < at.size),
        **{n: v[at] for n, v in there.items()},
    )


def _alike(blocks: list[Record]) -> Flags | None:
    """Return which blocks are of one motor; nothing where that is not most of them."""
    every = _with_standstills(blocks, prepare(blocks, use_current=False))
    count = len(every.starts) - 1
    stretch = np.arange(count) * STRETCHES // count
    tried = [_explained(blocks, stretch == n, every) for n in range(STRETCHES)]
    if not all(np.isfinite(cost).all() for cost, _ in tried):
        return None  # a stretch of one level tells no motor, and what a level does is no accident
    cost, lag = min(tried, key=lambda r: float(np.quantile(r[0], 1 - LEFT_OUT.value)))
    kept: Flags = np.zeros(count, dtype=np.bool_)
    for _ in range(ROUNDS):
        if not np.isfinite(cost).all() or not (cost > 0).any():
            return None
        most = float(np.median(cost[cost > 0])) * _rarely(every, lag, count)
        alike: Flags = cost <= max(most, float(np.quantile(cost, 1 - LEFT_OUT.value)))
        if np.array_equal(alike, kept):
            return kept if cost[kept].max() <= most else None
        kept = alike
        cost, lag = _explained(blocks, kept, every)
    return None


def _rarely(data: Experiments, lag: float, count: int) -> float:
    """Return what a mean square is rarely above in any of the blocks, in usual ones."""
    duration = data.step * data.size / count
    freedom = 1.0 if data.kind == ANGLE else max(duration / (2 * lag), 1.0)
    return float(chdtri(freedom, DISTURBED.value / count) / chdtri(freedom, 0.5))


def _with_standstills(records: list[Record], data: Experiments) -> Experiments:
    """Return experiments in which a standing encoder speaks: that it stands may be what is odd."""
    if data.kind != ANGLE:
        return data
    return replace(
        data, output=np.concatenate([there[0] for r in records if (there := angle_of(r))])
    )


def _explained(blocks: list[Record], kept: Flags, every: Experiments) -> tuple[Array, float]:
    """Return what a motor of the blocks that are kept leaves in all of them, and its lag [s]."""
    structure, rows = FirstOrder(), np.repeat(kept, np.diff(every.starts))
    ends = np.cumsum([len(r) for r in blocks])[:-1]
    parts = zip(blocks, np.split(rows, ends), strict=True)
    data = prepare([of_rows(r, own) for r, own in parts if own.any()], use_current=False)
    first = first_fit(data, structure, Options())
    if first is None:
        return np.full(kept.size, np.inf), np.inf
    fit = _settled(data, structure, first.at(first.z, data.initial, 0.0))
    fixed = structure.with_(fixed={n: fit.z.value(n) for n in structure.free})
    there = _settled(every, fixed, fit.at(fit.z, every.initial, 0.0))
    return _mean_squares(every, there), fit.z.time_constant


def _settled(data: Experiments, structure: FirstOrder, start: Start) -> Fit:
    """Return the free run; each block begins moving, at rest, or as it was left, as it fits."""
    options, rest = Options(), start.initial.copy()
    rest[:, :2] = 0.0
    tried = [solve(data, structure, start.at(start.z, x), options, 20)
             for x in (start.initial, rest)]  # fmt: skip
    best = min(tried, key=lambda f: f.deviance)
    tried.append(solve(data, structure, best.at(best.z, _as_left(data, best)), options, 20))
    likeliest = np.argmin([_mean_squares(data, f) for f in tried], axis=0)
    initial = np.array([tried[n].initial[b] for b, n in enumerate(likeliest)])
    best = min(tried, key=lambda f: f.deviance)
    return solve(data, structure, best.at(best.z, initial), options)


def _as_left(data: Experiments, fit: Fit) -> Array:
    """Return initial states of which each is as the motor left the block before.

    Where a block begins next to a reversal, a descent may not find which way it turned.
    """
    initial, begins = fit.initial.copy(), data.starts[1:-1]
    initial[1:, 1] = simulate(data, fit)[begins - 1, 0]
    return initial


def _mean_squares(data: Experiments, fit: Fit) -> Array:
    """Return the mean square of the residuals of each block."""
    sums = gather(data, fit.structure, fit.z, fit.initial, fit.noise_model(), differentiate=False)
    return np.asarray(sums.cost * fit.noise[0, 0] / np.diff(data.starts))
