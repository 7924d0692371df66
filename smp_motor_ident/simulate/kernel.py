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

from smp_motor_control.arrays import Array, Integers
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

STATES = 3  # q, w, th
ENTRIES = 12  # of a transition: E (q<-q, q<-w, w<-q, w<-w), th<-q, th<-w, then q, w, th <- v, F
EVENTS = 60  # of friction within one piece, at most
STUCK = 0.0


@inlined
def _exponential(te: float, tm: float, k: float, be: float, h: float) -> tuple[float, float, float]:
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
def _flow(
    q: float, w: float, h: float, v: float, f: float, te: float, tm: float, k: float, be: float
) -> tuple[float, float, float]:
    """Return q, w and the change of th after ``h`` at constant voltage and force."""
    w_end = (v - f) / (k + be)
    if te == 0.0:
        w1 = w_end + (w - w_end) * math.exp(-h * (k + be) / tm)
        return v - k * w1, w1, ((v - f) * h - tm * (w1 - w)) / (k + be)
    q_end = be * w_end + f
    c, s, rate = _exponential(te, tm, k, be, h)
    dq, dw = q - q_end, w - w_end
    q1 = q_end + c * dq + s * ((-1.0 / te - rate) * dq - k / te * dw)
    w1 = w_end + c * dw + s * (dq / tm + (-be / tm - rate) * dw)
    return q1, w1, ((v - f) * h - te * (q1 - q) - tm * (w1 - w)) / (k + be)


@compiled
def transitions(lengths: Array, lanes: Array) -> Array:
    """Return the transition of every length and lane, shape (lengths, 12, lanes).

    ``lengths`` has shape (lengths, lanes) [s].
    """
    out = np.empty((lengths.shape[0], ENTRIES, lanes.shape[1]))
    for n in range(lengths.shape[0]):
        for b in range(lanes.shape[1]):
            te, tm, k, be = lanes[TE, b], lanes[TM, b], lanes[K, b], lanes[BE, b]
            h = lengths[n, b]
            at = 0
            for q, w, v, f in ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0),
                               (0.0, 0.0, 0.0, 1.0)):  # fmt: skip
                q1, w1, th = _flow(q, w, h, v, f, te, tm, k, be)
                out[n, at, b], out[n, at + 1, b], out[n, at + 2, b] = q1, w1, th
                at += 3
    return out


@compiled
def _crossing(
    q: float, w: float, h: float, v: float, f: float, direction: float,
    te: float, tm: float, k: float, be: float,
) -> float:  # fmt: skip
    """Return when within ``h`` the speed first crosses zero, or -1."""
    q1, w1, _ = _flow(q, w, h, v, f, te, tm, k, be)
    low, high = 0.0, h
    if w1 * direction >= 0.0:
        # It may dip through zero and come back: then its slope changes sign inside.
        before, after = (q if te > 0.0 else v - k * w) - be * w - f, q1 - be * w1 - f
        if (
            not (before * direction < -1e-12 * (abs(v) + abs(f)) and after * direction > 0.0)
            or te == 0.0
        ):
            return -1.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            qm, wm, _ = _flow(q, w, middle, v, f, te, tm, k, be)
            if wm * direction < 0.0:
                high = middle
                break
            if (qm - be * wm - f) * direction < 0.0:
                low = middle
            else:
                high = middle
            if high - low < 1e-9 * h:
                return -1.0
        low = 0.0
    # Safeguarded Newton between a time before and one after the crossing.
    t = 0.5 * (low + high)
    for _ in range(80):
        qm, wm, _ = _flow(q, w, t, v, f, te, tm, k, be)
        if wm * direction < 0.0:
            high = t
        else:
            low = t
        if abs(wm) <= 1e-14 * abs(w) or high - low <= 1e-15 * h:
            break
        slope = (qm - be * wm - f) / tm
        t = t - wm / slope if slope * direction < 0.0 else low
        if not low < t < high:
            t = 0.5 * (low + high)
    return t


@compiled
def _advance(
    b: int, h: float, v: float, load: float, direction: float, hold: float, x: Array, lanes: Array
) -> float:
    """Advance one lane under friction through all events; return its direction of motion.

    ``hold``: friction at standstill over that in motion.
    """
    te, tm, k, be = lanes[TE, b], lanes[TM, b], lanes[K, b], lanes[BE, b]
    plus, minus = lanes[VC_PLUS, b], lanes[VC_MINUS, b]
    q, w, th, left = x[0, b], x[1, b], x[2, b], h
    for _ in range(EVENTS):
        if direction == STUCK:
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
                direction = STUCK
                q = v + (q - v) * math.exp(-left / te)
                break
            if te > 0.0:
                q = v + (q - v) * math.exp(-wait / te)
            left -= wait
        f = load + (plus if direction > 0.0 else -minus)
        t = _crossing(q, w, left, v, f, direction, te, tm, k, be)
        span = left if t < 0.0 else t
        q, w, turned = _flow(q, w, span, v, f, te, tm, k, be)
        th += turned
        if t < 0.0:
            break
        w = 0.0
        net = (q if te > 0.0 else v) - load
        direction = 1.0 if net > plus * hold else -1.0 if net < -minus * hold else STUCK
        left -= t
        if left <= 1e-14 * h:
            break
    x[0, b], x[1, b], x[2, b] = q, w, th
    return direction


@compiled
def run(  # noqa: C901 - one pass, kept whole so that nothing is stored between its steps
    first_piece: Integers,
    length: Array,
    edges: Integers,
    group: Integers,
    section: Integers,
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
    length, edges, group, section : ndarray, shape (pieces,)
        Of every piece: its length [s]; by how many shifts a lane's own is longer; its transition in
        ``tables`` or -1; its column of ``command``.
    command : ndarray, shape (sections, lanes or 1)
        Voltage [V] of every section.
    tables, halves : ndarray, shape (groups, 12, lanes)
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
    out, volts : ndarray, shape (n, 3, lanes) and (n or 0, lanes)
        Filled: q, w, th at every row; mean terminal voltage over the row.
    """
    count = lanes.shape[1]
    x, before = np.zeros((STATES, count)), np.zeros((STATES, count))
    direction, force, v = np.zeros(count), np.zeros(count), np.zeros(count)
    load, hold = np.zeros(count), np.ones(count)
    shared = command.shape[1] == 1
    for g in range(segment.shape[0] - 1):
        for b in range(count):
            for n in range(STATES):
                x[n, b] = initial[g, n] + own[n, b]
            load[b] = lanes[LOAD, b] + initial[g, 3] + own[3, b]
            direction[b] = 1.0
            if friction:
                direction[b] = STUCK if x[1, b] == 0.0 else (1.0 if x[1, b] > 0.0 else -1.0)
        for k in range(segment[g], segment[g + 1]):
            gathered = 0.0
            if volts.shape[0] > 0:
                volts[k, :] = 0.0
            for j in range(first_piece[k], first_piece[k + 1]):
                h, at = length[j], section[j]
                if h <= 0.0 and edges[j] == 0:
                    continue
                gathered += h
                for b in range(count):
                    v[b] = command[at, 0 if shared else b]
                    before[0, b], before[1, b], before[2, b] = x[0, b], x[1, b], x[2, b]
                    force[b] = load[b]
                if feedback:
                    now = age[j] if age.shape[0] > 0 else 0.0
                    half = halves[max(group[j], 0)]
                    for b in range(count):
                        _respond(
                            b, h, now, full_duty, direction, x, lanes, v, force, half, group[j] >= 0
                        )
                        hold[b] = (1.0 + lanes[STRIBECK, b]) * (
                            1.0 + lanes[FRICTION_DRIFT, b] * now
                        )
                alone = group[j] < 0
                if not alone:
                    e = tables[group[j]]
                    for b in range(count):
                        f = force[b]
                        if friction:
                            f += lanes[VC_PLUS, b] * max(direction[b], 0.0)
                            f += lanes[VC_MINUS, b] * min(direction[b], 0.0)
                        q, w = before[0, b], before[1, b]
                        x[0, b] = e[0, b] * q + e[3, b] * w + e[6, b] * v[b] + e[9, b] * f
                        x[1, b] = e[1, b] * q + e[4, b] * w + e[7, b] * v[b] + e[10, b] * f
                        x[2, b] += e[2, b] * q + e[5, b] * w + e[8, b] * v[b] + e[11, b] * f
                if alone or friction:
                    for b in range(count):
                        own_h = h + edges[j] * shift[b]
                        if own_h < 0.0:
                            own_h = 0.0
                        d = direction[b]
                        if not friction:
                            x[0, b], x[1, b], turned = _flow(
                                before[0, b], before[1, b], own_h, v[b], force[b],
                                lanes[TE, b], lanes[TM, b], lanes[K, b], lanes[BE, b],
                            )  # fmt: skip
                            x[2, b] = before[2, b] + turned
                            continue
                        if not alone and d != STUCK and x[1, b] * d > 0.0:
                            # A dip through zero needs a speed that the first slope uses up.
                            tm, te = lanes[TM, b], lanes[TE, b]
                            q0 = before[0, b] if te > 0.0 else v[b] - lanes[K, b] * before[1, b]
                            f = force[b] + (lanes[VC_PLUS, b] if d > 0.0 else -lanes[VC_MINUS, b])
                            slope = (q0 - lanes[BE, b] * before[1, b] - f) / tm
                            if before[1, b] * d + slope * d * own_h > 0.0:
                                continue
                        for n in range(STATES):
                            x[n, b] = before[n, b]
                        direction[b] = _advance(b, own_h, v[b], force[b], d, hold[b], x, lanes)
                if volts.shape[0] > 0:
                    for b in range(count):
                        volts[k, b] += max(h + edges[j] * shift[b], 0.0) * v[b]
            for b in range(count):
                out[k, 0, b], out[k, 1, b], out[k, 2, b] = x[0, b], x[1, b], x[2, b]
                if lanes[TE, b] == 0.0:
                    out[k, 0, b] = v[b] - lanes[K, b] * x[1, b]
                if volts.shape[0] > 0 and gathered > 0.0:
                    volts[k, b] /= gathered


@inlined
def _respond(
    b: int, h: float, age: float, full_duty: float, direction: Array, x: Array, lanes: Array,
    v: Array, force: Array, half: Array, tabulated: bool,
) -> None:  # fmt: skip
    """Put the voltage at the terminals and the forces that follow the motion, at mid-piece."""
    q, w, d = x[0, b], x[1, b], direction[b]
    k = lanes[K, b]
    base, command = force[b], v[b]
    v[b] = terminal_voltage(b, command, k * w, age, full_duty, lanes)
    force[b] = base + extra_force(b, w, d, age, lanes)
    if d == STUCK:
        return
    f = force[b] + (lanes[VC_PLUS, b] if d > 0.0 else -lanes[VC_MINUS, b])
    if tabulated:
        middle = half[1, b] * q + half[4, b] * w + half[7, b] * v[b] + half[10, b] * f
    else:
        te, tm, be = lanes[TE, b], lanes[TM, b], lanes[BE, b]
        _, middle, _ = _flow(q, w, 0.5 * h, v[b], f, te, tm, k, be)
    if middle * d < 0.0:
        middle = 0.0
    v[b] = terminal_voltage(b, command, k * middle, age, full_duty, lanes)
    force[b] = base + extra_force(b, middle, d, age, lanes)
