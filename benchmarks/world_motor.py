# SPDX-License-Identifier: Apache-2.0
"""A drive with the effects of real drives, simulated piecewise in closed form.

Between two events (a command, a PWM edge, a reversal, the end of a conduction) winding and rotor
are linear and solved exactly; reversals and the end of a conduction are located by bisection.
Smooth functions of speed and angle are evaluated at the middle of each fine step.  The module does
not import the tested package.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

NAMES = (
    "R", "L", "K", "J", "b", "tc", "supply",
    "dead_zone", "offset", "clip", "levels", "weak", "slew", "source", "decline", "rc", "rc_time",
    "pwm", "coast_zero", "brush",
    "stribeck", "stribeck_speed", "k_asym", "f_asym", "turn_load", "gear", "cog", "drag", "load",
    "load_step", "load_time", "r_drift", "f_drift", "k_sag", "stall_time", "fk", "sway",
    "two_mass", "share", "spring", "damping", "gap",
    "kp", "ki",
)  # fmt: skip
"""Parameters of a drive; zero (or infinite) where an effect is absent."""
I = {name: k for k, name in enumerate(NAMES)}
(R, L, K, J, B, TC, SUPPLY, DEAD, OFFSET, CLIP, LEVELS, WEAK, SLEW, SOURCE, DECLINE, RC, RC_TIME,
 PWM, COAST_ZERO, BRUSH, STRIBECK, STRIBECK_SPEED, K_ASYM, F_ASYM, TURN, GEAR, COG, DRAG, LOAD,
 LOAD_STEP, LOAD_TIME, R_DRIFT, F_DRIFT, K_SAG, STALL_TIME, FK, SWAY, TWO, SHARE, SPRING, DAMPING,
 GAP, KP, KI) = range(len(NAMES))  # fmt: skip
COLUMNS = ("i", "w", "angle", "w_encoder", "angle_encoder", "i_mean", "i_supply")


def drive(**values: float) -> np.ndarray:
    """Return the parameters of a drive as an array."""
    p = np.zeros(len(NAMES))
    p[CLIP] = p[LOAD_TIME] = p[STALL_TIME] = np.inf
    p[GEAR], p[SHARE] = 1.0, 0.5
    for name, value in values.items():
        p[I[name]] = value
    return p


@njit(cache=True)
def _driver(u, p):
    """Return the voltage that the bridge makes of a command."""
    if p[LEVELS] > 0:
        u = round(u / p[SUPPLY] * p[LEVELS]) / p[LEVELS] * p[SUPPLY]
    if abs(u) <= p[DEAD]:
        u = 0.0
    else:
        u -= math.copysign(p[DEAD], u)
    if u < 0:
        u *= 1 - p[WEAK]
    u += p[OFFSET]
    return min(max(u, -p[CLIP]), p[CLIP])


@njit(cache=True)
def _linear(i, w, h, v, torque, r, l, k, j, b):
    """Solve winding and rotor under constant voltage and torque."""
    a11, a12, a21, a22 = -r / l, -k / l, k / j, -b / j
    below = r * b + k * k
    i_end, w_end = (b * v + k * torque) / below, (k * v - r * torque) / below
    s = 0.5 * (a11 + a22)
    d = s * s - below / (l * j)
    if d > 0:
        q = math.sqrt(d)
        e1, e2 = math.exp((s + q) * h), math.exp((s - q) * h)
        c, f = 0.5 * (e1 + e2), (0.5 * (e1 - e2) / q if q > 0 else h * e1)
    else:
        q = math.sqrt(-d)
        e = math.exp(s * h)
        c, f = e * math.cos(q * h), (e * math.sin(q * h) / q if q > 0 else h * e)
    di, dw = i - i_end, w - w_end
    return (
        i_end + c * di + f * ((a11 - s) * di + a12 * dw),
        w_end + c * dw + f * (a21 * di + (a22 - s) * dw),
    )


@njit(cache=True)
def _friction(w, angle, t, end, direction, p):
    tc = p[TC] * (1 + p[F_DRIFT] * t / end) * (1 + p[F_ASYM] * direction)
    if p[STRIBECK] > 0:
        tc *= 1 + p[STRIBECK] * math.exp(-((w / p[STRIBECK_SPEED]) ** 2))
    if t > p[STALL_TIME]:
        tc *= 1e4
    return tc


@njit(cache=True)
def _load(w, angle, t, noise, p):
    out = p[LOAD] + noise + p[DRAG] * w * abs(w)
    if t > p[LOAD_TIME]:
        out += p[LOAD_STEP]
    if p[TURN] != 0:
        out += p[TURN] * math.sin(angle / p[GEAR])
    if p[COG] != 0:
        out += p[COG] * math.sin(7 * angle)
    return out


@njit(cache=True)
def _move(i, w, h, v, torque, r, k, p, is_open):
    """Return current and speed after h; with an open winding the rotor is alone."""
    if is_open:
        if p[B] > 0:
            e = math.exp(-p[B] / p[J] * h)
            return 0.0, -torque / p[B] + (w + torque / p[B]) * e
        return 0.0, w - torque / p[J] * h
    return _linear(i, w, h, v, torque, r, p[L], k, p[J], p[B])


@njit(cache=True)
def _piece(i, w, angle, h, v, coast, t, end, noise, p):  # noqa: C901 - every event in one loop
    """Advance over h with events; ``coast``: the bridge is off, diodes carry the current."""
    left = h
    for _ in range(50):
        if left <= 1e-15:
            break
        r = p[R] * (1 + p[R_DRIFT] * t / end)
        duty = abs(v) / p[SUPPLY]
        if not coast:
            r += p[SOURCE] * duty * duty
        if p[BRUSH] > 0:
            r += p[BRUSH] / (abs(i) + 0.02 * p[SUPPLY] / p[R])
        k = p[K] * (1 + (p[K_ASYM] if w > 0 else -p[K_ASYM]))
        if p[K_SAG] > 0:
            k *= 1 - p[K_SAG] * min(1.0, abs(i) * p[R] / p[SUPPLY])
        is_open = coast and i == 0.0
        applied = v if not coast else -math.copysign(p[SUPPLY], i)
        extra = _load(w, angle, t, noise, p)
        if w == 0.0:
            hold = _friction(0.0, angle, t, end, 1.0 if k * i > extra else -1.0, p)
            if abs(k * i - extra) <= hold:
                i1 = 0.0
                step = left
                if not is_open:
                    rest = applied / r
                    i1 = rest + (i - rest) * math.exp(-step * r / p[L])
                    if coast and i1 * i <= 0.0:
                        step = p[L] / r * math.log((i - rest) / (-rest))
                        i1 = 0.0
                    elif abs(k * i1 - extra) > hold:
                        lo, hi = 0.0, step
                        for _ in range(40):
                            mid = 0.5 * (lo + hi)
                            im = rest + (i - rest) * math.exp(-mid * r / p[L])
                            if abs(k * im - extra) > hold:
                                hi = mid
                            else:
                                lo = mid
                        step = hi
                        i1 = rest + (i - rest) * math.exp(-step * r / p[L])
                i = i1
                left -= step
                if left <= 1e-15:
                    break
                if abs(k * i - extra) <= hold:
                    continue
            direction = 1.0 if k * i > extra else -1.0
        else:
            direction = 1.0 if w > 0 else -1.0
        torque = extra + direction * _friction(w, angle, t, end, direction, p)
        _, half = _move(i, w, left / 2, applied, torque, r, k, p, is_open)
        torque = _load(half, angle, t, noise, p) + direction * _friction(
            half, angle, t, end, direction, p
        )
        i1, w1 = _move(i, w, left, applied, torque, r, k, p, is_open)
        reverses = w1 * direction < 0.0
        ends = coast and not is_open and i1 * i <= 0.0
        step = left
        if reverses or ends:
            lo, hi = 0.0, left
            for _ in range(45):
                mid = 0.5 * (lo + hi)
                im, wm = _move(i, w, mid, applied, torque, r, k, p, is_open)
                if wm * direction < 0.0 or (coast and not is_open and im * i <= 0.0):
                    hi = mid
                else:
                    lo = mid
            step = hi
            im, wm = _move(i, w, step, applied, torque, r, k, p, is_open)
            i1, w1 = (0.0, wm) if (coast and not is_open and im * i <= 0.0) else (im, wm)
            if wm * direction < 0.0:
                w1 = 0.0
        _, half = _move(i, w, step / 2, applied, torque, r, k, p, is_open)
        angle += step / 6 * (w + 4 * half + w1)
        i, w = i1, w1
        left -= step
    return i, w, angle


@njit(cache=True)
def _two_mass(i, w, angle, w2, angle2, h, v, t, end, noise, p):
    """Advance motor and load coupled by a spring with a gap, in small steps."""
    n = max(1, int(math.ceil(h * math.sqrt(p[SPRING] / (p[J] * p[SHARE] * (1 - p[SHARE]))) * 12)))
    d = h / n
    slow = 1e-3 * p[SUPPLY] / p[K]
    for _ in range(n):
        i_end = (v - p[K] * w) / p[R]
        i = i_end + (i - i_end) * math.exp(-d * p[R] / p[L])
        twist = angle - angle2
        bent = 0.0
        if twist > p[GAP] / 2:
            bent = twist - p[GAP] / 2
        elif twist < -p[GAP] / 2:
            bent = twist + p[GAP] / 2
        link = p[SPRING] * bent + (p[DAMPING] * (w - w2) if bent != 0 or p[GAP] == 0 else 0.0)
        j1, j2 = p[J] * p[SHARE], p[J] * (1 - p[SHARE])
        w += d / j1 * (p[K] * i - p[B] * w - link - 0.3 * p[TC] * math.tanh(w / slow))
        w2 += d / j2 * (link - noise - p[LOAD] - 0.7 * p[TC] * math.tanh(w2 / slow))
        angle += d * w
        angle2 += d * w2
    return i, w, angle, w2, angle2


STATE = ("i", "w", "angle", "w_load", "angle_load", "v", "battery", "at", "u")
I_NOW, W_NOW, ANGLE, W_LOAD, ANGLE_LOAD, VOLTS, BATTERY, AT, ASKED = range(len(STATE))


def rest():
    """Return the state of a drive that has had no command."""
    state = np.zeros(len(STATE))
    state[AT] = -1
    return state


@njit(cache=True)
def advance(first, last, step, change, command, noise, p, end, state, out):
    """Advance from fine step ``first`` to ``last``; fill the rows of ``out`` that follow them.

    ``change`` are the instants at which ``command`` (one a sample) reaches the bridge; ``end`` is
    when what drifts has drifted.
    """
    i, w, angle, w2, angle2, v, battery, place, u = state
    at = int(place)
    samples = command.size
    for m in range(first, last):
        t = m * step
        done = 0.0
        charge = drawn = 0.0
        while done < step * (1 - 1e-9):
            while at + 1 < samples and change[at + 1] <= t + done + 1e-12:
                at += 1
                u = command[at]
            h = step - done
            if at + 1 < samples and change[at + 1] < t + step:
                h = min(h, max(change[at + 1] - t - done, 1e-9))
            want = _driver(u, p) if at >= 0 else p[OFFSET]
            want *= 1 - p[DECLINE] * t / end - battery / p[SUPPLY]
            if p[SLEW] > 0:
                v += min(max(want - v, -p[SLEW] * h), p[SLEW] * h)
            else:
                v = want
            coast = p[COAST_ZERO] > 0 and want == 0.0
            size = v
            if p[PWM] > 0 and not coast:
                phase = (t + done) * p[PWM] % 1.0
                on = abs(v) / p[SUPPLY]
                if phase < on - 1e-9:
                    h = min(h, (on - phase) / p[PWM])
                    size = math.copysign(p[SUPPLY], v)
                else:
                    h = min(h, max((1 - phase) / p[PWM], 1e-9))
                    coast = True
            before = i
            if p[TWO] > 0:
                i, w, angle, w2, angle2 = _two_mass(
                    i, w, angle, w2, angle2, h, size, t + done, end, noise[m], p
                )
            else:
                i, w, angle = _piece(i, w, angle, h, size, coast, t + done, end, noise[m], p)
            charge += 0.5 * (before + i) * h
            drawn += 0.5 * (before + i) * h * (0.0 if coast else size / p[SUPPLY])
            if p[RC] > 0:
                battery += h / p[RC_TIME] * (p[RC] * abs(i) * abs(v) / p[SUPPLY] - battery)
            done += h
        out[m + 1, 0], out[m + 1, 1], out[m + 1, 2] = i, w, angle
        out[m + 1, 3], out[m + 1, 4] = (w2, angle2) if p[TWO] > 0 else (w, angle)
        out[m + 1, 5], out[m + 1, 6] = charge / step, drawn / step
    state[:] = np.array([i, w, angle, w2, angle2, v, battery, float(at), u])


@njit(cache=True)
def simulate(every, step, change, command, target, noise, p):
    """Return `COLUMNS` on a fine grid, and the command that ran.

    ``every`` fine steps of length ``step`` make a sample.  With kp > 0 the command follows
    ``target`` in closed loop.
    """
    samples = command.size
    n = samples * every
    out = np.zeros((n + 1, 7))
    state = np.zeros(len(STATE))
    state[AT] = -1
    integral = 0.0
    for s in range(samples):
        if p[KP] > 0:
            error = target[s] - out[s * every, 3]
            raw = p[KP] * error + integral
            command[s] = min(max(raw, -p[SUPPLY]), p[SUPPLY])
            if raw == command[s]:
                integral += p[KI] * error * every * step
        first = s * every
        advance(first, first + every, step, change, command, noise, p, n * step, state, out)
    return out
