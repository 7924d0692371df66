"""The compiled recursion: simulate, differentiate, and gather the normal equations.

One pass over the samples carries the state ``(q, w, th)`` of `propagator`, its sensitivity
to every column of the problem, and sums ``psi psi^T``, ``psi r`` and ``r^2`` of the whitened
residuals on the way.  Nothing of the length of the record is allocated.
Derivation: docs/derivations.md, sections 4 to 7.
"""

from __future__ import annotations

import math

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident._compile import compiled, inlined
from smp_motor_ident.likelihood.current_sensor import (
    AVERAGED,
    SMOOTHED,
    STATE,
    after_move,
    before_move,
    begin_current,
    mark,
    mark_first,
    observe_lagging,
    samples_between,
    sensor_rate,
    smooth,
)
from smp_motor_ident.likelihood.events import STUCK, advance, keeps_turning
from smp_motor_ident.likelihood.normal_equations import ROOM, TILE, robust, sum_up
from smp_motor_ident.likelihood.observation import note, observe, observe_current
from smp_motor_ident.likelihood.propagator import DECAYED, TE, TM
from smp_motor_ident.likelihood.sensitivities import (
    ACTIVE,
    BESIDE,
    D0,
    D1,
    FORCED,
    LANES,
    OTHER,
    PUSH,
    PUSHED,
    RATE,
    SENSOR,
    SLOPE,
    SQ,
    SW,
    begin,
    fade,
    prepare_slide,
    push_columns,
    slide_columns,
    slide_state,
    tabulate,
    turn,
)
from smp_motor_ident.model.columns import CURRENT_LAG, DELAY, LOAD, VC_MINUS, VC_PLUS

ON_DELAY = SLOPE + DELAY * LANES


@inlined
def _slide(
    at: int,
    h: float,
    v: float,
    direction: float,
    load: float,
    friction: bool,
    par: Array,
    x: Array,
    m: Array,
    marks: Array,
    columns: bool,
) -> bool:
    """Advance with the propagator of a bank, if the motor turns on."""
    f = load
    if friction:
        f += par[VC_PLUS] if direction > 0.0 else -par[VC_MINUS]
        if not keeps_turning(m, at, par, x, direction, v, f):
            return False
    lags = marks[SENSOR] > 0.0
    if lags:
        before_move(x, m)
    if columns:
        slide_columns(m, at, x[0], x[1], v, f)
        if marks[PUSHED] > 0.0:
            push_columns(m, at)
    slide_state(m, at, x, v, f)
    if lags:
        after_move(h, v, f, False, par, x, m, marks)
    return True


@inlined
def move(
    h: float,
    slack: float,
    v: float,
    direction: float,
    load: float,
    friction: bool,
    par: Array,
    x: Array,
    m: Array,
    cache: Array,
    marks: Array,
    table: Array,
    scratch: Array,
    columns: bool,
) -> float:
    """Advance by h at constant v; return the direction of motion."""
    if direction == STUCK:
        return advance(h, v, direction, load, par, x, m, cache, marks, scratch)
    if abs(marks[ACTIVE] - h) <= slack:
        bank = 0
    elif abs(marks[BESIDE] - h) <= slack:
        bank = 1
    else:
        bank = prepare_slide(h, slack, par, m, cache, marks, table, scratch)
    if bank == 0:
        turns = _slide(FORCED, h, v, direction, load, friction, par, x, m, marks, columns)
    else:
        turns = _slide(OTHER, h, v, direction, load, friction, par, x, m, marks, columns)
    if not turns:
        return advance(h, v, direction, load, par, x, m, cache, marks, scratch)
    return direction


@compiled
def _switch(
    v: float, new: float, load: float, direction: float, friction: bool, par: Array, m: Array
) -> None:
    """Let the columns feel that a later switch of the input comes later."""
    dv = v - new
    if par[TE] > 0.0:
        for j in range(LANES):
            m[SQ + j] += dv / par[TE] * m[ON_DELAY + j]
        return
    if friction and direction == STUCK:  # it starts, if at all, just now
        net = new - load
        dv = -max(0.0, net - par[VC_PLUS]) - min(0.0, net + par[VC_MINUS])
    for j in range(LANES):
        m[SW + j] += dv / par[TM] * m[ON_DELAY + j]


@inlined
def _put(values: Array, m: Array, row: int, first: int, add: bool) -> None:
    """Put values into a row of lanes from the first on, or add them."""
    for j in range(values.shape[0]):
        m[row + first + j] = values[j] + (m[row + first + j] if add else 0.0)


@inlined
def _answer(m: Array, row: int, sums: Array) -> None:
    """Add a row of lanes to sums over samples."""
    for j in range(sums.shape[0]):
        sums[j] += m[row + j]


@inlined
def _correct(
    gain: Array, e0: float, e1: float, ok0: bool, ok1: bool, stuck: bool, x: Array, m: Array
) -> None:
    """Let the innovations move the state and its columns."""
    for n in range(3):
        if n == 1 and stuck:
            continue
        k0 = gain[n, 0] if ok0 else 0.0
        k1 = gain[n, 1] if ok1 else 0.0
        x[n] += k0 * e0 + k1 * e1
        for j in range(LANES):
            m[n * LANES + j] -= k0 * m[D0 + j] + k1 * m[D1 + j]


@compiled
def run(  # noqa: C901 - one pass, kept whole so that nothing is stored between its steps
    time: Array,
    starts: Integers,
    hold_end: Array,
    hold_value: Array,
    hold_start: Integers,
    output: Array,
    current: Array,
    kind: int,
    friction: bool,
    par: Array,
    slope: Array,
    initial: Array,
    local: Integers,
    gain: Array,
    weight: Array,
    huber: float,
    normal: Array,
    gradient: Array,
    cost: Array,
    spread: Array,
    block_length: int,
    blocks: Array,
    block_segment: Integers,
    ring: Array,
    sensor: int,
    trail: Array,
    period: float,
    predicted: Array,
    usual: float,
    beside: Array,
    added: Array,
    answers: Array,
    together: int,
) -> int:
    """Run over all segments; fill the sums in place."""
    n_common = slope.shape[1]
    p = n_common + local.shape[0]
    pushed, answered = beside.shape[0] > 0, answers.shape[0] > 0
    columns = p > 0 or answered
    has_current = current.shape[0] > 0
    has_gain = bool(np.any(gain != 0.0))
    delay = par[DELAY]
    late = bool(np.any(slope[DELAY] != 0.0))
    m, cache, marks, scratch = begin(slope, local, friction)
    smoothed = sensor == SMOOTHED  # which follows no move
    marks[SENSOR], marks[RATE] = 0.0 if smoothed else sensor, sensor_rate(sensor, par)
    marks[PUSHED] = 1.0 if pushed else 0.0
    averaged, width = sensor == AVERAGED, 2 * par[CURRENT_LAG]
    table = tabulate(usual, par, m, cache, marks, scratch)
    x, past, rows = np.zeros(STATE), np.zeros(1 + max(p, answers.shape[-1])), np.zeros(TILE * ROOM)
    tile = np.zeros((ROOM, TILE))
    spread[:] = 0.0
    block = line = -1
    for g in range(starts.shape[0] - 1):
        first, last = starts[g], starts[g + 1]
        normal[g], gradient[g], cost[g] = 0.0, 0.0, 0.0
        m[: 3 * LANES] = 0.0
        for n in range(3):
            x[n] = initial[g, n]
        # A speed of exactly zero under friction is a motor at rest, not a free number: the
        # cost has a kink there.
        at_rest = friction and x[1] == 0.0
        for j in range(local.shape[0]):
            if local[j] < 3 and not (at_rest and local[j] == 1):
                m[local[j] * LANES + n_common + j] = 1.0
        ahead = last  # the next sample whose window of the current begins
        if sensor > 0:
            own = n_common + np.flatnonzero(local == 4)
            begin_current(initial[g, 4], own, x, m, sensor)
            if averaged:
                ahead = mark_first(trail, time, first, last, width, initial[g, 4], own, x, m)
        load = par[LOAD] + initial[g, 3]
        section = hold_start[g]
        limit = hold_start[g + 1] - 1 if g + 2 < starts.shape[0] else hold_end.shape[0] - 1
        now = time[first]
        direction = 1.0
        if friction:
            direction = STUCK if at_rest else (1.0 if x[1] > 0.0 else -1.0)
        turn(m, direction)
        block += 1
        block_segment[block] = g
        blocks[block] = 0.0
        filled = count = 0
        while section < limit and hold_end[section] + delay <= now:
            section += 1
        if pushed:
            _put(beside[:, section], m, PUSH, p, False)
        for k in range(first, last):
            target = time[k]
            due = samples_between(target - now, period) if smoothed and k > first else 0.0
            pause = (target - now) / due if due > 0.0 else 0.0
            while now < target:
                if averaged:
                    ahead = mark(trail, time, ahead, last, now, width, x, m)
                end = target
                change = hold_end[section] + delay
                if section < limit and change < target - 1e-9 * (target - now):
                    end = change
                if averaged and ahead < last:
                    end = min(end, time[ahead] - width)
                take = target - (due - 1.0) * pause  # when a digital filter takes its next sample
                end = min(end, take)
                v = hold_value[section]
                h = end - now
                if h > 0.0:
                    slack = 1e-9 * h + 1e-15 * abs(target)
                    direction = move(
                        h, slack, v, direction, load, friction, par, x, m, cache, marks, table,
                        scratch, columns,
                    )  # fmt: skip
                now = end
                if section < limit and change <= end + 1e-9 * (target - time[k - 1]):
                    section += 1
                    if pushed:
                        _put(beside[:, section], m, PUSH, p, False)
                    if late:
                        _switch(v, hold_value[section], load, direction, friction, par, m)
                if due > 0.0 and now >= take:
                    smooth(par[CURRENT_LAG], period, x, m)
                    due -= 1.0
            # A state that is no number would pass for a lost sample, after all events there may be.
            if not abs(x[0]) + abs(x[1]) + abs(x[2]) < math.inf:
                predicted[k:] = math.nan
                cost[g] = spread[0] = math.inf
                return block + 1
            if (k - first) % TILE == 0:
                fade(m)
                if not friction and abs(x[0]) + abs(x[1]) < DECAYED:
                    x[0] = x[1] = 0.0
            y0 = observe(kind, k, first, target, par, x, m, ring, past, columns)
            y1 = 0.0
            if has_current and sensor > 0:
                y1 = observe_lagging(sensor, k, par, x, m, D1, trail)
            elif has_current:
                y1 = observe_current(par, x, m)
            if added.shape[1] > 0:
                _put(added[0, :, k], m, D0, p, True)
                _put(added[1, :, k], m, D1, p, True)
            if predicted.shape[0] > 0:
                note(predicted[k], x[1], y0, y1)
            # Residuals, whitened.
            e0 = output[k] - y0
            e1 = current[k] - y1 if has_current else 0.0
            ok0, ok1 = e0 == e0, has_current and e1 == e1
            w00 = w10 = w11 = 0.0
            if ok0:
                w00 = weight[0, 0]
                spread[0] += e0 * e0
                spread[3] += 1.0
            else:
                e0 = 0.0
            if ok1:
                w11 = weight[1, 2]
                spread[1] += e1 * e1
                spread[4] += 1.0
                if ok0:
                    w10, w11 = weight[1, 0], weight[1, 1]
                    spread[2] += e0 * e1
                    spread[5] += 1.0
            else:
                e1 = 0.0
            loss0, u0 = robust(w00 * e0, huber)
            loss1, u1 = robust(w10 * e0 + w11 * e1, huber)
            cost[g] += loss0 + loss1
            if filled >= block_length or count > TILE - 2:
                sum_up(rows, count, p, tile, normal[g], gradient[g], blocks[block])
                count = 0
            if filled >= block_length:
                block += 1
                block_segment[block] = g
                blocks[block] = 0.0
                filled = 0
            filled += 1
            if answered:
                line += (k - first) % together == 0
                if ok0:
                    _answer(m, D0, answers[line, 0])
                if ok1:
                    _answer(m, D1, answers[line, 1])
            if ok0 and p > 0:
                for j in range(LANES):
                    rows[count * ROOM + j] = u0 * w00 * m[D0 + j]
                rows[count * ROOM + LANES] = u0 * w00 * e0
                count += 1
            if ok1 and p > 0:
                for j in range(LANES):
                    rows[count * ROOM + j] = u1 * (w10 * m[D0 + j] + w11 * m[D1 + j])
                rows[count * ROOM + LANES] = u1 * (w10 * e0 + w11 * e1)
                count += 1
            if has_gain:
                stuck = direction == STUCK
                _correct(gain, e0, e1, ok0, ok1, stuck, x, m)
                if friction and not stuck and x[1] * direction < 0.0:
                    direction = -direction
                    turn(m, direction)
        sum_up(rows, count, p, tile, normal[g], gradient[g], blocks[block])
        for j in range(p):
            for i in range(j):
                normal[g, i, j] = normal[g, j, i]
    return block + 1
