# SPDX-License-Identifier: Apache-2.0
"""Starting values of a fit: a grid of motors, simulated at once, with the best gain of each.

The grid covers the whole record at a coarse step, and its first rows at their own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.chain.chain import Chain, respond
from smp_motor_ident.chain.component import Component, Scales
from smp_motor_ident.chain.motor import Delay, FirstOrder, Friction
from smp_motor_ident.chain.sensor import Angle, Speed
from smp_motor_ident.fit.data import Data
from smp_motor_ident.simulate.rows import Rows

LAG_COUNT = 28
FRICTIONS = (0.0, 0.04, 0.12, 0.3)  # of the largest command
DELAYS = (0.0, 1.0, 3.0)  # rows
LONG_DELAYS = (10.0, 20.0, 40.0, 80.0, 160.0, 320.0)  # rows
MAX_GOOD_COST = 0.1  # unexplained share of the output; above it long delays are tried
MAX_GRID_ROWS = 2000
MIN_VIEW_ROWS = 4  # of a segment
MIN_LOG_DISTANCE = 0.5  # between two starts


class _LongDelay(Delay):
    """A delay of many rows."""

    def starts(self, scales: Scales) -> Sequence[Mapping[str, float]]:
        """Return delays up to the longest."""
        return [{"delay": rows * scales.step} for rows in LONG_DELAYS]


def guess_motors(data: Data, best: int = 3, component: Component | None = None) -> list[Chain]:
    """Return the first-order motors that explain the speed best, the best first.

    With a ``component`` all of them have it, in each of its starting sizes.  The speed is
    ``f(v; lag, friction)/a0``, where f does not depend on a0: a0 follows by linear regression.
    """
    scored: list[tuple[float, Chain]] = []
    for view in select_views(data):
        scored += _score_grid(view, component, DELAYS if component is None else (0.0,))
        if component is None and min((cost for cost, _ in scored), default=1.0) > MAX_GOOD_COST:
            scored += _score_grid(view, _LongDelay(), (0.0,))
    scored.sort(key=lambda one: one[0])
    found: list[Chain] = []
    for _, chain in scored:
        if len(found) < best and not any(_are_near(chain, other) for other in found):
            found.append(chain)
    return found


def _are_near(one: Chain, other: Chain) -> bool:
    """Tell whether fits from two motors would end at the same minimum.

    Of the lag behind a long delay only their sum shows.
    """
    delay = one.values.get("delay", 0.0)
    if delay != other.values.get("delay", 0.0):
        return False
    gain = abs(one.values["ln_a0"] - other.values["ln_a0"])
    lags = [delay + math.exp(c.values["ln_a1"] - c.values["ln_a0"]) for c in (one, other)]
    return max(gain, abs(math.log(lags[0] / lags[1]))) < MIN_LOG_DISTANCE


def select_views(data: Data) -> Iterator[Data]:
    """Yield the first rows that move, and the whole record thinned."""
    rows = data.rows
    if data.is_angle:  # fill in the readings at rest, which fits leave out
        data = replace(data, motion=hold_last_value(data.motion, rows.segment))
    moves = np.abs(rows.command) > 0.05 * data.volts
    begin = rows.begin[int(np.argmax(moves))] if moves.any() else 0.0
    first = max(int(np.searchsorted(rows.time[: rows.segment[1]], begin)) - 5, 0)
    last = min(first + MAX_GRID_ROWS, int(rows.segment[1]))
    held = rows.mean_command
    if last - first >= MIN_VIEW_ROWS:
        yield _replace_rows(data, rows.time[first:last], held[first:last], data.motion[first:last])
    every = -(-len(data) // MAX_GRID_ROWS)
    if every > 1 or rows.segment.size > 2:
        yield _average_rows(data, held, every)


def hold_last_value(values: Array, segment: Integers) -> Array:
    """Replace missing values by the last known one of the segment."""
    known = np.isfinite(values)
    known[segment[:-1]] = True
    last = np.maximum.accumulate(np.where(known, np.arange(values.size), 0))
    return np.asarray(values[last])


def _replace_rows(
    data: Data, time: Array, command: Array, motion: Array, segment: Integers | None = None
) -> Data:
    bounds = np.array([0, time.size]) if segment is None else segment
    rows = Rows.held(time, command, bounds)
    start = np.zeros((bounds.size - 1, 4))
    still = np.zeros(bounds.size - 1, dtype=np.bool_)
    return replace(
        data, rows=rows, motion=motion, current=None, initial=start, starts_at_rest=still
    )


def _average_rows(data: Data, held: Array, every: int) -> Data:
    """Keep one of every ``every`` rows, each with the mean command since the row before."""
    rows = data.rows
    times, commands, outputs, starts = [], [], [], [0]
    for a, b in pairwise(rows.segment):
        k = np.arange(a, b, every)
        if k.size < MIN_VIEW_ROWS:
            continue
        put = np.concatenate([[0.0], np.cumsum((held * rows.interval)[a + 1 : b])])[k - a]
        mean = np.diff(put, prepend=0.0) / np.diff(rows.time[k], prepend=-np.inf)
        mean[0] = held[a]
        times.append(rows.time[k])
        commands.append(mean)
        outputs.append(data.motion[k])
        starts.append(starts[-1] + k.size)
    if not times:
        return _replace_rows(data, rows.time, held, data.motion, rows.segment)
    time, command, motion = map(np.concatenate, (times, commands, outputs))
    return _replace_rows(data, time, command, motion, np.array(starts))


def _score_grid(
    data: Data, component: Component | None, delays: Sequence[float]
) -> list[tuple[float, Chain]]:
    """Return every motor of the grid with its cost, as a share of the output's own."""
    rows = data.rows
    span = float(rows.interval.sum())
    lags = np.geomspace(0.3 * rows.step, max(span / 3, 3 * rows.step), LAG_COUNT)
    interval = np.where(rows.interval > 0, rows.interval, np.nan)
    speed = np.diff(data.motion, prepend=np.nan) / interval if data.is_angle else data.motion
    ok = np.isfinite(speed)
    energy = float(np.square(speed[ok]).sum()) or 1.0
    sensor = Angle() if data.is_angle else Speed()
    chain = Chain((FirstOrder(), sensor), {"ln_a0": 0.0, "ln_a1": 0.0})
    chain = chain.with_component(Friction(), {"vc": 0.0})
    extra: list[list[Mapping[str, float]]] = [[{}] * LAG_COUNT]
    if component is not None:
        sizes = [component.starts(data.scales(lag)) for lag in lags]
        extra = [list(one) for one in zip(*sizes, strict=True)]
        chain = chain.with_component(component, extra[0][0])
    scored = []
    for delay in delays:
        for share in FRICTIONS:
            for size in extra:
                values = {
                    "ln_a0": np.zeros(LAG_COUNT), "ln_a1": np.log(lags),
                    "vc": np.full(LAG_COUNT, share * data.volts),
                    **{n: np.array([one[n] for one in size]) for n in size[0]},
                }  # fmt: skip
                if "delay" not in values:
                    values["delay"] = np.full(LAG_COUNT, delay * rows.step)
                x = respond(
                    chain, values, rows, data.scales(lags[LAG_COUNT // 2]), data.initial
                ).motion
                if data.is_angle:
                    x = np.diff(x, axis=0, prepend=np.nan) / interval[:, None]
                x = x[ok]
                inner = speed[ok] @ x
                gain = inner / np.maximum(np.square(x).sum(axis=0), 1e-300)
                cost = 1.0 - gain * inner / energy
                for k in np.flatnonzero((gain > 0) & np.isfinite(cost)):
                    found = {n: float(v[k]) for n, v in values.items()}
                    found |= {"ln_a0": -math.log(gain[k]), "ln_a1": math.log(lags[k] / gain[k])}
                    kept = {n: found[n] for n in chain.values}
                    scored.append((float(cost[k]), chain.with_values(kept)))
    return scored
