"""Exact propagation of the motor over one interval of constant input, with derivatives.

States ``q = R i`` [V] and ``w`` [rad/s], and the angle ``th`` [rad]:

    te q' = v - q - K w,      tm w' = q - be w - F,      th' = w

with ``te = L/R``, ``tm = R J/K``, ``be = R b/K`` and the friction and load ``F`` in volts.
A propagator over ``h`` seconds is a row of 12 numbers,

    0:4   E = exp(A h)            (q<-q, q<-w, w<-q, w<-w)
    4:6   th<-q, th<-w            (row of w in H, the integral of E)
    6:9   Gv: q, w, th <- v
    9:12  Gf: q, w, th <- F       (to be subtracted)

followed by its derivatives with respect to ``ln te, ln tm, K, be``, 12 numbers each.
Derivation: docs/derivations.md, sections 2 and 3.

Jittered stamps: over a narrow range of h a polynomial through eight Chebyshev points gives the
entries to rounding.
"""

from __future__ import annotations

import math

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident._compile import compiled

# Internal parameters of the recursion; those after the first four are the coordinates' own.
TE, TM, K, BE = range(4)
ROW = 12
WIDTH = 5 * ROW
DECAYED = 1e-100  # of a state or a sensitivity: its square is still a normal number


@compiled
def _exponential(mu: float, d: float, h: float) -> tuple[float, float, float]:
    """Return e^{mu h} cosh(D h), e^{mu h} sinh(D h)/D and its derivative by d = D^2."""
    x = d * h * h
    if x > 1e-5:
        root = math.sqrt(d)
        e1 = math.exp((mu + root) * h)
        e2 = math.exp((mu - root) * h)
        c = 0.5 * (e1 + e2)
        s = 0.5 * (e1 - e2) / root
        return c, s, (h * c - s) / (2 * d)
    e = math.exp(mu * h)
    if x < -1e-5:
        root = math.sqrt(-d)
        c = e * math.cos(root * h)
        s = e * math.sin(root * h) / root
        return c, s, (h * c - s) / (2 * d)
    c = e * (1 + x / 2 + x * x / 24)
    s = e * h * (1 + x / 6 + x * x / 120)
    return c, s, e * h * h * h * (1 / 6 + x / 60 + x * x / 1680)


@compiled
def second_order(row: Array, h: float, te: float, tm: float, k: float, be: float) -> None:
    """Fill a propagator row of the second-order motor."""
    a11 = -1 / te
    a12 = -k / te
    a21 = 1 / tm
    a22 = -be / tm
    mu = 0.5 * (a11 + a22)
    half = 0.5 * (a11 - a22)
    d = half * half + a12 * a21
    c, s, ds = _exponential(mu, d, h)
    e00 = c + s * half
    e01 = s * a12
    e10 = s * a21
    e11 = c - s * half
    det = (k + be) / (te * tm)
    i00 = a22 / det
    i01 = -a12 / det
    i10 = -a21 / det
    i11 = a11 / det
    h00 = i00 * (e00 - 1) + i01 * e10
    h01 = i00 * e01 + i01 * (e11 - 1)
    h10 = i10 * (e00 - 1) + i11 * e10
    h11 = i10 * e01 + i11 * (e11 - 1)
    p00 = i00 * (h00 - h) + i01 * h10
    p01 = i00 * h01 + i01 * (h11 - h)
    p10 = i10 * (h00 - h) + i11 * h10
    p11 = i10 * h01 + i11 * (h11 - h)
    row[0] = e00
    row[1] = e01
    row[2] = e10
    row[3] = e11
    row[4] = h10
    row[5] = h11
    row[6] = h00 / te
    row[7] = h10 / te
    row[8] = p10 / te
    row[9] = h01 / tm
    row[10] = h11 / tm
    row[11] = p11 / tm
    for m in range(4):
        b11 = b12 = b21 = b22 = 0.0
        on_te = on_tm = 0.0
        if m == 0:
            b11 = 1 / te
            b12 = k / te
            on_te = 1.0
        elif m == 1:
            b21 = -1 / tm
            b22 = be / tm
            on_tm = 1.0
        elif m == 2:
            b12 = -1 / te
        else:
            b22 = -1 / tm
        dmu = 0.5 * (b11 + b22)
        dhalf = 0.5 * (b11 - b22)
        dd = 2 * half * dhalf + b12 * a21 + a12 * b21
        dc = h * dmu * c + 0.5 * h * s * dd
        dsm = h * dmu * s + ds * dd
        f00 = dc + dsm * half + s * dhalf
        f01 = dsm * a12 + s * b12
        f10 = dsm * a21 + s * b21
        f11 = dc - dsm * half - s * dhalf
        # A H = E - I and A P = H - h I, differentiated.
        r00 = f00 - b11 * h00 - b12 * h10
        r01 = f01 - b11 * h01 - b12 * h11
        r10 = f10 - b21 * h00 - b22 * h10
        r11 = f11 - b21 * h01 - b22 * h11
        g00 = i00 * r00 + i01 * r10
        g01 = i00 * r01 + i01 * r11
        g10 = i10 * r00 + i11 * r10
        g11 = i10 * r01 + i11 * r11
        s00 = g00 - b11 * p00 - b12 * p10
        s01 = g01 - b11 * p01 - b12 * p11
        s10 = g10 - b21 * p00 - b22 * p10
        s11 = g11 - b21 * p01 - b22 * p11
        o = ROW * (m + 1)
        row[o] = f00
        row[o + 1] = f01
        row[o + 2] = f10
        row[o + 3] = f11
        row[o + 4] = g10
        row[o + 5] = g11
        row[o + 6] = (g00 - on_te * h00) / te
        row[o + 7] = (g10 - on_te * h10) / te
        row[o + 8] = (i10 * s00 + i11 * s10 - on_te * p10) / te
        row[o + 9] = (g01 - on_tm * h01) / tm
        row[o + 10] = (g11 - on_tm * h11) / tm
        row[o + 11] = (i10 * s01 + i11 * s11 - on_tm * p11) / tm


@compiled
def first_order(row: Array, h: float, tm: float, k: float, be: float) -> None:
    """Fill a propagator row of the first-order motor (``te = 0``; the state q is unused)."""
    for n in range(WIDTH):
        row[n] = 0.0
    r = (k + be) / tm
    e = math.exp(-r * h)
    h1 = -math.expm1(-r * h) / r
    p1 = (h - h1) / r if r * h > 1e-4 else h * h * (0.5 - r * h / 6 + r * r * h * h / 24)
    row[3] = e
    row[5] = h1
    row[7] = row[10] = h1 / tm
    row[8] = row[11] = p1 / tm
    for m in range(1, 4):
        dr = -r if m == 1 else 1 / tm
        on_tm = 1.0 if m == 1 else 0.0
        de = -h * e * dr
        dh = (-de - h1 * dr) / r
        if r * h > 1e-4:
            dp = (-dh - p1 * dr) / r
        else:
            dp = h * h * h * dr * (-1 / 6 + r * h / 12)
        o = ROW * (m + 1)
        row[o + 3] = de
        row[o + 5] = dh
        row[o + 7] = row[o + 10] = (dh - on_tm * h1) / tm
        row[o + 8] = row[o + 11] = (dp - on_tm * p1) / tm


@compiled
def speed_at(
    h: float, te: float, tm: float, k: float, be: float, q: float, w: float, v: float, f: float
) -> tuple[float, float]:
    """Return speed and acceleration after ``h`` seconds of constant input, without derivatives."""
    a0 = k + be
    w_end = (v - f) / a0
    if te == 0.0:
        x = (w - w_end) * math.exp(-a0 / tm * h)
        return w_end + x, -a0 / tm * x
    q_end = v - k * w_end
    a11 = -1 / te
    a22 = -be / tm
    mu = 0.5 * (a11 + a22)
    half = 0.5 * (a11 - a22)
    d = half * half - k / (te * tm)
    c, s, _ = _exponential(mu, d, h)
    dq = q - q_end
    dw = w - w_end
    y = s / tm * dq + (c - s * half) * dw
    x = (c + s * half) * dq - s * k / te * dw
    return w_end + y, (x - be * y) / tm


NODES = 8
POINTS = np.cos(np.pi * (2 * np.arange(NODES) + 1) / (2 * NODES))
INVERSE = np.ascontiguousarray(np.linalg.inv(np.vander(POINTS, increasing=True)))
WIDEST = 0.2  # of the usual interval: half the range of lengths
NARROWEST = 0.02
SMALL = 0.1  # rate times half the range: (SMALL/2)^8 2/8! = 2e-15 is the error of the polynomial


@compiled
def half_range(step: float, te: float, tm: float, k: float, be: float) -> float:
    """Return half the range of lengths that a table may span, 0 where none is worth it."""
    # The norm of the dynamics in its symmetric scaling bounds both rates.
    rate = (k + be) / tm
    if te > 0.0:
        rate = 1 / te + be / tm + np.sqrt(k / (te * tm))
    half = min(WIDEST * step, SMALL / rate)
    return half if half >= NARROWEST * step else 0.0


@compiled
def expand(values: Array, table: Array) -> None:
    """Turn values at the points into coefficients of powers."""
    width = table.shape[0] // NODES
    table[:] = 0.0
    for k in range(NODES):
        for j in range(NODES):
            factor = INVERSE[k, j]
            for n in range(width):
                table[k * width + n] += factor * values[j * width + n]


@compiled
def evaluate(table: Array, u: float, out: Array, at: int) -> None:
    """Evaluate the polynomials."""
    width = table.shape[0] // NODES
    c1, c2, c3, c4 = table[width:], table[2 * width :], table[3 * width :], table[4 * width :]
    c5, c6, c7 = table[5 * width :], table[6 * width :], table[7 * width :]
    for n in range(width):
        high = c4[n] + u * (c5[n] + u * (c6[n] + u * c7[n]))
        out[at + n] = table[n] + u * (c1[n] + u * (c2[n] + u * (c3[n] + u * high)))
