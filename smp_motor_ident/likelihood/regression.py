"""Filtered linear regressions of the start, compiled: columns, sums, instruments.

With ``F = c/(s + c)`` and ``s F = c (1 - F)`` every ``F^n s^k x`` is a combination of
``x, F x, F^2 x, F^3 x``, so one discrete filter serves for all derivatives.
Derivation: docs/derivations.md, section 10.
"""

from __future__ import annotations

import math

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident._compile import compiled
from smp_motor_ident.likelihood.propagator import WIDTH, first_order, second_order

LITTLE = 1e-10  # of a scaled pivot, below which a column is left out
KNEE = 0.02  # of the largest speed, below which friction counts in part


@compiled
def filtered(x: Array, cutoff: float, step: float, order: int) -> Array:
    """Return F^n s^k x for k = 0 to n, F being a low pass of first order."""
    c = math.tan(min(cutoff * step / 2, 1.2)) * 2 / step
    g = c * step / 2
    b, a = g / (1 + g), (1 - g) / (1 + g)
    out = np.empty((order + 1, x.shape[0]))
    last0 = last1 = last2 = f1 = f2 = f3 = 0.0
    for i in range(x.shape[0]):
        now = x[i]
        f1 = a * f1 + b * (now + last0)
        f2 = a * f2 + b * (f1 + last1)
        f3 = a * f3 + b * (f2 + last2)
        last0, last1, last2 = now, f1, f2
        if order == 1:
            out[0, i], out[1, i] = f1, c * (now - f1)
        elif order == 2:
            out[0, i], out[1, i], out[2, i] = f2, c * (f1 - f2), c * c * (now - 2 * f1 + f2)
        else:
            out[0, i], out[1, i] = f3, c * (f2 - f3)
            out[2, i] = c * c * (f1 - 2 * f2 + f3)
            out[3, i] = c * c * c * (now - 3 * f1 + 3 * f2 - f3)
    return out


@compiled
def friction_sign(speed: Array) -> Array:
    """Return the sign of a speed, smooth around zero."""
    level = 1e-12
    for i in range(speed.shape[0]):
        level = max(level, KNEE * abs(speed[i]))
    out = np.empty(speed.shape[0])
    for i in range(speed.shape[0]):
        x = speed[i] / level
        out[i] = x / math.sqrt(1.0 + x * x)
    return out


@compiled
def _columns(
    y: Array, cutoff: float, step: float, order: int, angle: bool, friction: bool
) -> Array:
    """Return the regressors: w, w' (, w'') and the sign of w, filtered."""
    extra = 1 if angle else 0
    n = order + extra
    rest = 0.0 if angle else y[0]
    moved = y - y[0]
    out = np.empty((order + 2 if friction else order + 1, y.shape[0]))
    f = filtered(moved, cutoff, step, n)
    for k in range(order + 1):
        out[k] = f[extra + k]
    if not angle:
        out[0] += rest
    if friction:
        speed = filtered(moved, min(cutoff, 0.3 / step), step, n)[extra]
        out[order + 1] = filtered(friction_sign(speed + rest), cutoff, step, n)[0]
    return out


@compiled
def small_solve(a: Array, b: Array) -> None:
    """Solve ``a x = b`` by elimination; what is not identifiable is zero."""
    n = b.shape[0]
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(a[i, k]) > abs(a[best, k]):
                best = i
        for j in range(n):
            a[k, j], a[best, j] = a[best, j], a[k, j]
        b[k], b[best] = b[best], b[k]
        if abs(a[k, k]) < LITTLE:
            a[k, k] = math.inf
            continue
        for i in range(k + 1, n):
            factor = a[i, k] / a[k, k]
            for j in range(k, n):
                a[i, j] -= factor * a[k, j]
            b[i] -= factor * b[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            b[k] -= a[k, j] * b[j]
        b[k] = b[k] / a[k, k] if a[k, k] != math.inf else 0.0


@compiled
def instrumental(
    columns: Array, tools: Array, right: Array, begin: int, end: int, sums: Array
) -> None:
    """Add ``tools columns'`` and ``tools right`` to the sums of an instrumental regression."""
    m = columns.shape[0]
    for a in range(m):
        tool, own = tools[a, begin:end], columns[a, begin:end]
        for b in range(m):
            other = columns[b, begin:end]
            total = 0.0
            for i in range(end - begin):
                total += tool[i] * other[i]
            sums[a, b] += total
        total = square = length = 0.0
        for i in range(end - begin):
            total += tool[i] * right[begin + i]
            square += own[i] * own[i]
            length += tool[i] * tool[i]
        sums[a, m] += total
        sums[a, m + 1] += square
        sums[a, m + 2] += length


@compiled
def solved(sums: Array) -> Array:
    """Return the solution of an instrumental regression."""
    m = sums.shape[0]
    a, b = np.empty((m, m)), np.empty(m)
    for i in range(m):
        tool = math.sqrt(sums[i, m + 2]) + 1e-300
        for j in range(m):
            a[i, j] = sums[i, j] / (tool * (math.sqrt(sums[j, m + 1]) + 1e-300))
        b[i] = sums[i, m] / tool
    small_solve(a, b)
    for i in range(m):
        b[i] /= math.sqrt(sums[i, m + 1]) + 1e-300
    return b


@compiled
def _response(voltage: Array, step: float, theta: Array, order: int, angle: bool) -> Array:
    """Return what the linear motor answers; friction is taken off the voltage as a dead zone."""
    a0, a1, a2 = theta[0], theta[1], theta[2] if order == 2 else 0.0
    vc = theta[order + 1] if theta.shape[0] > order + 1 else 0.0
    row = np.zeros(WIDTH)
    if order == 2:
        second_order(row, step, a2 / a1, a1, a0, 0.0)
    else:
        first_order(row, step, a1, a0, 0.0)
    out = np.empty(voltage.shape[0])
    q = w = th = 0.0
    out[0] = 0.0
    for i in range(1, voltage.shape[0]):
        v = voltage[i]
        v -= min(max(v, -vc), vc)
        th += row[4] * q + row[5] * w + row[8] * v
        old = q
        q = row[0] * q + row[1] * w + row[6] * v
        w = row[2] * old + row[3] * w + row[7] * v
        out[i] = th if angle else w
    return out


@compiled
def motor_like(theta: Array, order: int) -> bool:
    """Put coefficients into what a motor's can be; tell whether that is near."""
    for value in theta:
        if not math.isfinite(value):
            return False
    if theta[0] <= 0.0 or (theta[1] <= 0.0 and not (order == 2 and theta[2] > 0.0)):
        return False
    if order == 2 and theta[2] > 0.0:  # a motor of little resistance rings: damping 0.02
        theta[1] = max(theta[1], 0.04 * math.sqrt(theta[0] * theta[2]))
    elif order == 2:
        theta[2] = 0.02 * theta[1] * theta[1] / theta[0]
    if theta.shape[0] > order + 1:
        theta[order + 1] = max(theta[order + 1], 0.0)
    return True


@compiled
def search(
    voltage: Array,
    output: Array,
    bounds: Integers,
    steps: Array,
    cutoffs: Array,
    order: int,
    angle: bool,
    friction: bool,
) -> Array:
    """Return coefficients by least squares and then by instruments, for several cut-offs."""
    m = order + (2 if friction else 1)
    n = order + (1 if angle else 0)
    found = np.zeros((2 * cutoffs.shape[0], order + 2))
    columns = np.empty((m, output.shape[0]))
    answers = np.empty((m, output.shape[0]))
    right = np.empty(output.shape[0])
    count = 0
    for cutoff in cutoffs:
        theta: Array = np.zeros(m)
        for trial in range(2):
            sums = np.zeros((m, m + 3))
            for g in range(steps.shape[0]):
                a, b, step = bounds[g], bounds[g + 1], steps[g]
                if trial == 0:
                    held = voltage[a:b].copy()  # at an instant: half-way between two intervals
                    held[:-1] = 0.5 * (held[:-1] + held[1:])
                    columns[:, a:b] = _columns(output[a:b], cutoff, step, order, angle, friction)
                    right[a:b] = filtered(held, cutoff, step, n)[0]
                else:
                    answer = _response(voltage[a:b], step, theta, order, angle)
                    answers[:, a:b] = _columns(answer, cutoff, step, order, angle, friction)
                skip = min(int(4 / (cutoff * step)) + 2, (b - a) // 3)
                tools = columns if trial == 0 else answers
                instrumental(columns, tools, right, a + skip, b, sums)
            theta = solved(sums)
            if not motor_like(theta, order):
                break
            found[count, :m] = theta
            count += 1
    return found[:count]
