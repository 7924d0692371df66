# SPDX-License-Identifier: Apache-2.0
"""The compiled recursion: one motor for many sets of parameters at once, exact between events.

    te q' = v - q - K w,      tm w' = q - be w - F - Vc sign(w),      th' = w

with ``q = R i`` [V], ``te = L/R``, ``tm = R J/K``, ``be = R b/K`` and loads ``F`` in volts.  Every
set of parameters is a lane: lanes share the sampling instants and advance together; a lane whose
friction switches inside a piece is advanced alone through its events.  Derivatives by parameters
are differences between lanes.
Derivation: docs/derivations.md, sections 2 to 4.
"""

from __future__ import annotations

import math

import numpy as np

from smp_motor_control.arrays import Array, Integers, Places
from smp_motor_ident._compile import compiled, inlined
from smp_motor_ident.simulate.driver import terminal_voltage
from smp_motor_ident.simulate.force import extra_force
from smp_motor_ident.simulate.lanes import (
    BE,
    FRICTION_DRIFT,
    LOAD,
    STRIBECK,
    TE,
    TM,
    VC_MINUS,
    VC_PLUS,
    K,
)

TRANSITION_ENTRIES = 12  # of a transition: of q, w and th at its end by q, w, voltage and force
BASIS = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
MAX_EVENTS_PER_PIECE = 60  # of friction
STUCK_DIRECTION = 0.0


@inlined
def _exponentiate(
    te: float, tm: float, k: float, be: float, h: float
) -> tuple[float, float, float]:
    """Return c, s and the mean rate of ``exp(A h) = c I + s (A - rate I)``."""
    a00, a11 = -1.0 / te, -be / tm
    rate = 0.5 * (a00 + a11)
    d = 0.25 * (a00 - a11) * (a00 - a11) - k / (te * tm)
    x = d * h * h
    if x > 1e-8:
        root = math.sqrt(d)
        e1, e2 = math.exp((rate + root) * h), math.exp((rate - root) * h)
        return 0.5 * (e1 + e2), 0.5 * (e1 - e2) / root, rate
    e = math.exp(rate * h)
    if x < -1e-8:
        root = math.sqrt(-d)
        return e * math.cos(root * h), e * math.sin(root * h) / root, rate
    return e * (1.0 + 0.5 * x), e * h * (1.0 + x / 6.0), rate


@inlined
def _propagate(
    q: float, w: float, h: float, v: float, f: float, te: float, tm: float, k: float, be: float
) -> tuple[float, float, float]:
    """Return q, w and the change of th after ``h`` at constant voltage and force."""
    w_end = (v - f) / (k + be)
    if te == 0.0:
        w1 = w_end + (w - w_end) * math.exp(-h * (k + be) / tm)
        return v - k * w1, w1, ((v - f) * h - tm * (w1 - w)) / (k + be)
    q_end = be * w_end + f
    c, s, rate = _exponentiate(te, tm, k, be, h)
    dq, dw = q - q_end, w - w_end
    q1 = q_end + c * dq + s * ((-1.0 / te - rate) * dq - k / te * dw)
    w1 = w_end + c * dw + s * (dq / tm + (-be / tm - rate) * dw)
    return q1, w1, ((v - f) * h - te * (q1 - q) - tm * (w1 - w)) / (k + be)


@compiled
def transitions(lengths: Array, lanes: Array) -> Array:
    """Return the transition of every lane and length, shape (lanes, lengths, 12).

    ``lengths`` has shape (lengths, lanes) [s].
    """
    out = np.empty((lanes.shape[1], lengths.shape[0], TRANSITION_ENTRIES))
    for b in range(lanes.shape[1]):
        te, tm, k, be = lanes[TE, b], lanes[TM, b], lanes[K, b], lanes[BE, b]
        for n in range(lengths.shape[0]):
            h = lengths[n, b]
            for at, (q, w, v, f) in enumerate(BASIS):
                q1, w1, th = _propagate(q, w, h, v, f, te, tm, k, be)
                out[b, n, at], out[b, n, at + 4], out[b, n, at + 8] = q1, w1, th
    return out


@compiled
def _find_zero_crossing(
    q: float, w: float, h: float, v: float, f: float, direction: float,
    te: float, tm: float, k: float, be: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Return when within ``h`` the speed first crosses zero, or ``h``, and q, w and th then."""
    q1, w1, th1 = _propagate(q, w, h, v, f, te, tm, k, be)
    low, high, w_high = 0.0, h, w1
    if w1 * direction >= 0.0:
        # It may dip through zero and come back: then its slope changes sign inside.
        before, after = (q if te > 0.0 else v - k * w) - be * w - f, q1 - be * w1 - f
        if (
            not (before * direction < -1e-12 * (abs(v) + abs(f)) and after * direction > 0.0)
            or te == 0.0
        ):
            return h, q1, w1, th1
        for _ in range(60):
            middle = 0.5 * (low + high)
            qm, wm, _ = _propagate(q, w, middle, v, f, te, tm, k, be)
            if wm * direction < 0.0:
                high, w_high = middle, wm
                break
            if (qm - be * wm - f) * direction < 0.0:
                low = middle
            else:
                high = middle
            if high - low < 1e-9 * h:
                return h, q1, w1, th1
        low = 0.0
    # Safeguarded Newton between a time before and one after the crossing.
    t = high * w / (w - w_high) if w * direction > 0.0 else 0.5 * high
    for _ in range(80):
        q1, w1, th1 = _propagate(q, w, t, v, f, te, tm, k, be)
        if w1 * direction < 0.0:
            high = t
        else:
            low = t
        if abs(w1) <= 1e-14 * abs(w) or high - low <= 1e-15 * h:
            break
        slope = (q1 - be * w1 - f) / tm
        t = t - w1 / slope if slope * direction < 0.0 else low
        if not low < t < high:
            t = 0.5 * (low + high)
    return t, q1, 0.0, th1


@compiled
def _advance(
    q: float, w: float, th: float, direction: float, h: float, v: float, load: float,
    plus: float, minus: float, hold: float, te: float, tm: float, k: float, be: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Advance under friction through all events; return q, w, th and the direction of motion.

    ``hold``: friction at standstill over that in motion.
    """
    left = h
    for _ in range(MAX_EVENTS_PER_PIECE):
        if direction == STUCK_DIRECTION:
            drive, end = (q if te > 0.0 else v) - load, v - load
            if -minus * hold <= end <= plus * hold:  # friction holds it whatever the time
                q = v + (q - v) * math.exp(-left / te) if te > 0.0 else v
                break
            direction = 1.0 if end > 0.0 else -1.0
            limit = plus * hold if direction > 0.0 else -minus * hold
            wait = 0.0
            if te > 0.0 and direction * (limit - drive) > 0.0:
                wait = -te * math.log((limit - end) / (drive - end))
            if wait >= left:
                direction = STUCK_DIRECTION
                q = v + (q - v) * math.exp(-left / te)
                break
            if te > 0.0:
                q = v + (q - v) * math.exp(-wait / te)
            left -= wait
        f = load + (plus if direction > 0.0 else -minus)
        t, q, w, turned = _find_zero_crossing(q, w, left, v, f, direction, te, tm, k, be)
        th += turned
        if t == left:
            break
        net = (q if te > 0.0 else v) - load
        direction = 1.0 if net > plus * hold else -1.0 if net < -minus * hold else STUCK_DIRECTION
        left -= t
        if left <= 1e-14 * h:
            break
    return q, w, th, direction


@compiled
def simulate_rows(  # noqa: C901 - one pass, kept whole so that nothing is stored between its steps
    first_piece: Integers,
    row: Places,
    length: Array,
    edges: Integers,
    group: Places,
    section: Places,
    command: Array,
    tables: Array,
    halves: Array,
    lanes: Array,
    shift: Array,
    segment: Integers,
    initial: Array,
    own: Array,
    friction: bool,
    feedback: bool,
    full_duty: float,
    age: Array,
    out: Array,
    volts: Array,
) -> None:
    """Simulate all rows of all lanes.

    Parameters
    ----------
    first_piece : ndarray of int, shape (n + 1,)
        First piece of every row; the last entry is the number of pieces.
    row, length, edges, group, section : ndarray, shape (pieces,)
        Of every piece: its row; its length [s]; by how many shifts a lane's own is longer; its
        transition in ``tables``, beyond them for none; its column of ``command``.
    command : ndarray, shape (lanes or 1, sections)
        Voltage [V] of every section.
    tables, halves : ndarray, shape (lanes, groups, 12)
        From `transitions`, over whole and half pieces; the latter only where there is feedback.
    lanes : ndarray, shape (parameters, lanes)
        Parameters, in the order of `simulate.lanes`.
    shift : ndarray, shape (lanes,)
        Additional delay [s] of a lane's command relative to the pieces.
    segment : ndarray of int, shape (segments + 1,)
        First row of every segment.
    initial, own : ndarray, shape (segments, 4) and (4, lanes)
        State q, w, th and load at the beginning of a segment; a lane's offset from it.
    friction, feedback : bool
        Whether Coulomb friction acts; whether the driver's voltage or a force follows the motion.
    full_duty : float
        Command [V] at which the driver is always on.
    age : ndarray, shape (pieces or 0,)
        Share of the record that has passed at every piece, for parameters that drift.
    out, volts : ndarray, shape (3, lanes, n) and (lanes, n or 0)
        Filled: q, w, th at every row.  Added to: integral of the terminal voltage [V s].
    """
    for b in range(lanes.shape[1]):
        lane = lanes[:, b].copy()
        te, tm, k, be = lane[TE], lane[TM], lane[K], lane[BE]
        plus, minus, hold, passed = lane[VC_PLUS], lane[VC_MINUS], 1.0 + lane[STRIBECK], 0.0
        voltage = command[min(b, command.shape[0] - 1)]
        for g in range(segment.shape[0] - 1):
            q, w = initial[g, 0] + own[0, b], initial[g, 1] + own[1, b]
            th, load = initial[g, 2] + own[2, b], lane[LOAD] + initial[g, 3] + own[3, b]
            direction = _sign(w)
            j, end = first_piece[segment[g]], first_piece[segment[g + 1]]
            while j < end:
                moving = not friction or direction != STUCK_DIRECTION
                dry = plus if direction > 0.0 else -minus if direction < 0.0 else 0.0
                if moving and not feedback:
                    j, q, w, th = _advance_in_motion(
                        j, end, q, w, th, load + dry, direction if friction else STUCK_DIRECTION,
                        te, tm, k, be, group, section, row, length, edges, shift[b], voltage,
                        tables[b], out[:, b], volts[b],
                    )  # fmt: skip
                    if j == end:
                        break
                h = length[j] + edges[j] * shift[b]
                u, force, kind = voltage[section[j]], load, group[j]
                v = u
                if h > 0.0:
                    if age.shape[0] > 0:
                        passed = age[j]
                        scale = 1.0 + lane[FRICTION_DRIFT] * passed
                        plus, minus = lane[VC_PLUS] * scale, lane[VC_MINUS] * scale
                        dry = plus if direction > 0.0 else -minus if direction < 0.0 else 0.0
                    if feedback:
                        v = terminal_voltage(u, k * w, passed, full_duty, lane)
                        force = load + extra_force(w, dry, passed, lane)
                        if moving:
                            _, middle, _ = _advance_piece(
                                halves[b], kind, q, w, 0.5 * h, v, force + dry, te, tm, k, be
                            )
                            if friction and middle * direction < 0.0:
                                middle = 0.0
                            v = terminal_voltage(u, k * middle, passed, full_duty, lane)
                            force = load + extra_force(middle, dry, passed, lane)
                    if moving:
                        f = force + dry
                        q1, w1, turned = _advance_piece(
                            tables[b], kind, q, w, h, v, f, te, tm, k, be
                        )
                        # A dip through zero needs a speed that the first slope uses up.
                        moving = not friction or not (
                            w1 * direction <= 0.0
                            or (te > 0.0 and (tm * w + h * (q - be * w - f)) * direction <= 0.0)
                        )
                    if moving:
                        q, w, th = q1, w1, th + turned
                    else:
                        q, w, th, direction = _advance(
                            q, w, th, direction, h, v, force, plus, minus, hold, te, tm, k, be
                        )
                    if volts.shape[1] > 0:
                        volts[b, row[j]] += h * v
                out[0, b, row[j]] = q if te > 0.0 else v - k * w
                out[1, b, row[j]], out[2, b, row[j]] = w, th
                j += 1


@compiled
def _advance_in_motion(
    j: int, end: int, q: float, w: float, th: float, f: float, direction: float, te: float,
    tm: float, k: float, be: float, group: Places, section: Places, row: Places,
    length: Array, edges: Integers, shift: float, voltage: Array, table: Array, out: Array,
    volts: Array,
) -> tuple[int, float, float, float]:  # fmt: skip
    """Advance through pieces up to an event of friction; return the next piece, q, w and th."""
    drives, speeds, angles = out[0], out[1], out[2]
    group, section, row = group[j:end], section[j:end], row[j:end]
    length, edges = length[j:end], edges[j:end]
    for i in range(row.size):
        h = length[i] + edges[i] * shift
        if h > 0.0:
            v = voltage[section[i]]
            q1, w1, turned = _advance_piece(table, group[i], q, w, h, v, f, te, tm, k, be)
            if direction != STUCK_DIRECTION and (
                w1 * direction <= 0.0
                or (te > 0.0 and (tm * w + h * (q - be * w - f)) * direction <= 0.0)
            ):
                return j + i, q, w, th
            q, w, th = q1, w1, th + turned
            if volts.shape[0] > 0:
                volts[row[i]] += h * v
        at = row[i]
        drives[at], speeds[at], angles[at] = q, w, th
    return end, q, w, th


@inlined
def _sign(w: float) -> float:
    return 1.0 if w > 0.0 else -1.0 if w < 0.0 else STUCK_DIRECTION


@inlined
def _advance_piece(
    table: Array, kind: int, q: float, w: float, h: float, v: float, f: float,
    te: float, tm: float, k: float, be: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return q, w and the change of th after a piece, by its transition where it is tabulated."""
    if kind >= table.shape[0]:
        return _propagate(q, w, h, v, f, te, tm, k, be)
    return _apply_transition(table, kind, q, w, v, f)


@inlined
def _apply_transition(
    table: Array, kind: int, q: float, w: float, v: float, f: float
) -> tuple[float, float, float]:
    """Return q, w and the change of th by a tabulated transition."""
    t = table[kind]
    q1: float = t[0] * q + t[1] * w + t[2] * v + t[3] * f
    w1: float = t[4] * q + t[5] * w + t[6] * v + t[7] * f
    turned: float = t[8] * q + t[9] * w + t[10] * v + t[11] * f
    return q1, w1, turned
