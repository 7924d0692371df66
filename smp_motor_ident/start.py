"""A start from cold: state-variable filters, linear least squares, one instrumental step.

Derivation: docs/derivations.md, section 10.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from smp_motor_ident import models
from smp_motor_ident import recursion as rc
from smp_motor_ident.experiments import Experiments
from smp_motor_ident.propagator import WIDTH, first_order, second_order

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Uniform:
    """One segment on an even grid: mean voltage per interval, output and current at its end."""

    step: float
    voltage: Array
    output: Array
    current: Array | None


def resample(data: Experiments, g: int, most: int = 8_000) -> Uniform | None:
    """Put segment ``g`` on an even grid (for the start only).

    Parameters
    ----------
    data : Experiments
        Prepared records.
    g : int
        Segment.
    most : int
        Most samples to use.

    Returns
    -------
    Uniform or None
        None where the segment is too short.
    """
    a, b = int(data.starts[g]), int(min(data.starts[g + 1], data.starts[g] + most))
    t, y = data.time[a:b], data.output[a:b]
    ok = np.isfinite(y)
    if ok.sum() < 12:
        return None
    step = float(np.median(np.diff(t)))
    grid = np.arange(t[0], t[-1] + 0.5 * step, step)
    grid = grid[grid <= t[-1] + 1e-9 * step]
    last = int(data.section_start[g + 1]) if g + 2 < len(data.starts) else len(data.section_end)
    first = int(data.section_start[g])
    ends = data.section_end[first:last]
    last = first + int(np.searchsorted(ends, t[-1])) + 1
    ends, values = data.section_end[first:last], data.section_value[first:last]
    charge = np.concatenate([[0.0], np.cumsum(values[1:] * np.diff(ends))])
    mean = np.diff(np.interp(grid, ends, charge)) / step
    voltage = np.concatenate([[values[0]], mean])
    current = None
    if data.current.size:
        i = data.current[a:b]
        if np.isfinite(i).sum() > 12:
            current = np.interp(grid, t[np.isfinite(i)], i[np.isfinite(i)])
    return Uniform(step, voltage, np.interp(grid, t[ok], y[ok]), current)


def _filters(x: Array, cutoff: float, step: float, order: int) -> list[Array]:
    """Return F^n s^k x for k = 0..n of F = c/(s + c), by one discrete F for all."""
    c = np.tan(min(cutoff * step / 2, 1.2)) * 2 / step
    g = c * step / 2
    b, a = [g / (1 + g), g / (1 + g)], [1.0, (g - 1) / (1 + g)]
    powers = [x]
    for _ in range(order):
        powers.append(lfilter(b, a, powers[-1]))
    # s F = c (1 - F), so F^n s^k = c^k F^(n-k) (1 - F)^k.
    out = []
    for k in range(order + 1):
        total = np.zeros_like(x)
        for j in range(k + 1):
            total += comb(k, j) * (-1) ** j * powers[order - k + j]
        out.append(c**k * total)
    return out


def _held(voltage: Array) -> Array:
    """Return the voltage at the sampling instants, halfway between two held intervals."""
    after = np.concatenate([voltage[1:], voltage[-1:]])
    return np.asarray(0.5 * (voltage + after))


def cutoffs(data: Experiments, count: int = 7) -> Array:
    """Return filter cut-offs [rad/s] spread over what the sampling can show.

    Parameters
    ----------
    data : Experiments
        Prepared records.
    count : int
        How many.

    Returns
    -------
    ndarray, shape (count,)
        Logarithmically spaced.
    """
    high = 1.0 / data.step
    low = max(2.0, high / 300)
    return np.asarray(np.geomspace(low, high, count), dtype=np.float64)


def lagged_candidates(data: Experiments, structure: models.Structure, lag: int) -> list[Array]:
    """Return candidates for a motor that answers ``lag`` samples late.

    Parameters
    ----------
    data : Experiments
        Prepared records.
    structure : Structure
        Order.
    lag : int
        Samples.

    Returns
    -------
    list of ndarray, shape (11,)
        Coordinates z.
    """
    return speed_candidates(data, structure.order, lag)


def speed_candidates(
    data: Experiments, order: int, lag: int = 0, frictions: tuple[bool, ...] = (True, False)
) -> list[Array]:
    """Return candidate coordinates from voltage and the mechanical output.

    Least squares on ``v = a2 w'' + a1 w' + a0 w + Vc sign(w)`` after filtering, for several
    cut-offs, with and without friction, each refined by one instrumental-variable step.

    Parameters
    ----------
    data : Experiments
        Prepared records.
    order : int
        1 or 2.
    lag : int
        Samples by which the input comes late.
    frictions : tuple of bool
        With or without Coulomb friction.

    Returns
    -------
    list of ndarray, shape (11,)
        Coordinates z.
    """
    grids = [u for g in range(min(len(data.starts) - 1, 8)) if (u := resample(data, g))]
    grids = [_late(u, lag) for u in grids]
    out: list[Array] = []
    if not grids:
        return out
    for cutoff in cutoffs(data, 7 if lag == 0 else 4):
        for friction in frictions:
            rows, rhs = [], []
            for u in grids:
                x, y = _regression(u, cutoff, data.kind, order, friction)
                rows.append(x)
                rhs.append(y)
            a, b = np.vstack(rows), np.concatenate(rhs)
            theta = _least_squares(a, b, a)
            for _ in range(2):
                z = _to_z(theta, order, friction)
                if z is None:
                    break
                out.append(z)
                tools = [_instruments(u, z, cutoff, data.kind, order, friction) for u in grids]
                theta = _least_squares(a, b, np.vstack(tools))
    return out


def _late(u: Uniform, lag: int) -> Uniform:
    if lag == 0 or lag >= len(u.voltage):
        return u
    voltage = np.concatenate([np.full(lag, u.voltage[0]), u.voltage[:-lag]])
    return Uniform(u.step, voltage, u.output, u.current)


def _least_squares(a: Array, b: Array, tools: Array) -> Array:
    # Not by `@`: on a busy machine the threads of BLAS wait longer than these sums take.
    scale = np.sqrt(np.einsum("ij,ij->j", a, a)) + 1e-300
    other = np.sqrt(np.einsum("ij,ij->j", tools, tools)) + 1e-300
    m = np.einsum("ni,nj->ij", tools, a) / np.outer(other, scale)
    right = np.einsum("ni,n->i", tools, b) / other
    return np.asarray(np.linalg.lstsq(m, right, rcond=1e-10)[0] / scale)


def _regression(
    u: Uniform, cutoff: float, kind: int, order: int, friction: bool
) -> tuple[Array, Array]:
    extra = 1 if kind == rc.ANGLE else 0
    n = order + extra
    y = u.output - u.output[0]
    y0 = 0.0 if kind == rc.ANGLE else u.output[0]
    f = _filters(y, cutoff, u.step, n)
    v = _filters(_held(u.voltage), cutoff, u.step, n)[0]
    columns = [f[extra + k] + (y0 if k + extra == 0 else 0.0) for k in range(order + 1)]
    if friction:
        slow = _filters(y, min(cutoff, 0.3 / u.step), u.step, n)
        speed = slow[extra] + (y0 if extra == 0 else 0.0)
        level = 0.02 * np.abs(speed).max()
        columns.append(_filters(np.tanh(speed / max(level, 1e-12)), cutoff, u.step, n)[0])
    skip = min(int(4 / (cutoff * u.step)) + 2, len(v) // 3)
    return np.column_stack(columns)[skip:], v[skip:]


def _instruments(
    u: Uniform, z: Array, cutoff: float, kind: int, order: int, friction: bool
) -> Array:
    """Return the regressors of the candidate's own noise-free response."""
    a0, a1 = np.exp(z[0]), np.exp(z[1])
    a2 = np.exp(z[2]) if order == 2 else 0.0
    speed = _linear_response(u, a0, a1, a2, z[models.VC_PLUS])
    if kind == rc.ANGLE:
        y = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * u.step)])
    else:
        y = speed
    return _regression(Uniform(u.step, u.voltage, y, None), cutoff, kind, order, friction)[0]


def _linear_response(u: Uniform, a0: float, a1: float, a2: float, vc: float) -> Array:
    """Return the speed of the linear motor, friction taken off the voltage as a dead zone."""
    row = np.zeros(WIDTH)
    drive = u.voltage - np.clip(u.voltage, -vc, vc)
    if a2 > 0:
        second_order(row, u.step, a2 / a1, a1, a0, 0.0)
        b = [row[7], row[2] * row[6] - row[0] * row[7]]
        a = [1.0, -row[0] - row[3], row[0] * row[3] - row[1] * row[2]]
    else:
        first_order(row, u.step, a1, a0, 0.0)
        b, a = [row[7]], [1.0, -row[3]]
    return np.asarray(lfilter(b, a, drive))


def _to_z(theta: Array, order: int, friction: bool) -> Array | None:
    """Return coordinates, or None where the response would not be a motor's."""
    a = theta[: order + 1]
    if not np.all(np.isfinite(theta)) or a[0] <= 0 or a[1] <= 0:
        return None
    z = np.zeros(11)
    z[0], z[1] = np.log(a[0]), np.log(a[1])
    z[models.WINDOW] = 0.0
    if order == 2:
        a2 = a[2] if a[2] > 0 else 0.02 * a[1] ** 2 / a[0]
        z[2] = np.log(min(a2, 5 * a[1] ** 2 / a[0]))
        z[3] = z[2] - z[1]
    if friction:
        z[models.VC_PLUS] = z[models.VC_MINUS] = max(theta[-1], 0.0)
    return z


def current_candidates(data: Experiments) -> list[Array]:
    """Return candidate coordinates from voltage, current and the mechanical output.

    The electric equation ``v = L i' + R i + K w`` and the mechanical
    ``K i = J w' + b w + Tc sign(w)`` are two linear regressions, filtered.

    Parameters
    ----------
    data : Experiments
        With current.

    Returns
    -------
    list of ndarray, shape (11,)
        Coordinates z.
    """
    grids = [u for g in range(min(len(data.starts) - 1, 8)) if (u := resample(data, g))]
    grids = [u for u in grids if u.current is not None]
    out: list[Array] = []
    if not grids:
        return out
    for cutoff in cutoffs(data):
        parts = [_both_equations(u, cutoff, data.kind) for u in grids]
        electric = np.vstack([e for e, _, _, _ in parts])
        volts = np.concatenate([v for _, v, _, _ in parts])
        mechanic = np.vstack([m for _, _, m, _ in parts])
        amps = np.concatenate([i for _, _, _, i in parts])
        el = _least_squares(electric, volts, electric)
        me = _least_squares(mechanic, amps, mechanic)
        inductance, r, k = el[:3]
        if not (r > 0 and k > 0):
            continue
        inductance = inductance if inductance > 0 else 1e-3 * r * data.step
        j, b, tc = k * me[0], max(k * me[1], 0.0), max(k * me[2], 0.0)
        if not j > 0:
            continue
        z = models.from_physical(r, inductance, k, j, b, tc)
        z[models.OFFSET] = 0.0
        out.append(z)
    return out


def _both_equations(u: Uniform, cutoff: float, kind: int) -> tuple[Array, Array, Array, Array]:
    assert u.current is not None
    extra = 1 if kind == rc.ANGLE else 0
    n = 1 + extra
    f = _filters(u.output - u.output[0], cutoff, u.step, n)
    speed = f[extra] + (u.output[0] if extra == 0 else 0.0)
    slope = f[extra + 1]
    i, di = _filters(u.current, cutoff, u.step, n)[:2]
    v = _filters(_held(u.voltage), cutoff, u.step, n)[0]
    slow = _filters(u.output - u.output[0], min(cutoff, 0.3 / u.step), u.step, n)[extra]
    slow = slow + (u.output[0] if extra == 0 else 0.0)
    level = 0.02 * np.abs(slow).max()
    sign = _filters(np.tanh(slow / max(level, 1e-12)), cutoff, u.step, n)[0]
    one = np.ones_like(i)
    skip = min(int(4 / (cutoff * u.step)) + 2, len(v) // 3)
    electric = np.column_stack([di, i, speed, one])
    mechanic = np.column_stack([slope, speed, sign, one])
    return electric[skip:], v[skip:], mechanic[skip:], i[skip:]
