# SPDX-License-Identifier: Apache-2.0
"""Known motors, and their recordings by a simulator that shares no code with the estimator."""

import numba
import numpy as np
from paper_motors import TABLE_1
from scipy.signal import lfilter

from smp_motor_ident.record import Hardware, Record

QUANTUM = 2 * np.pi / 500
COLUMNS = ("resistance", "inductance", "motor_constant", "inertia", "viscous_friction")


@numba.njit(cache=True)
def _rates(i, w, v, direction, r, l, k, j, b, tc, load):
    return (v - r * i - k * w) / l, (k * i - b * w - tc * direction - load) / j


@numba.njit(cache=True)
def _rk4(i, w, h, v, direction, r, l, k, j, b, tc, load):
    a1, b1 = _rates(i, w, v, direction, r, l, k, j, b, tc, load)
    a2, b2 = _rates(i + h / 2 * a1, w + h / 2 * b1, v, direction, r, l, k, j, b, tc, load)
    a3, b3 = _rates(i + h / 2 * a2, w + h / 2 * b2, v, direction, r, l, k, j, b, tc, load)
    a4, b4 = _rates(i + h * a3, w + h * b3, v, direction, r, l, k, j, b, tc, load)
    return i + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4), w + h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)


@numba.njit(cache=True)
def simulate(t, v, r, l, k, j, b, tc, load, substeps):
    """Return current, speed and angle at t under the held voltage v (load per sample)."""
    n = t.size
    out = np.zeros((n, 3))
    i = w = angle = 0.0
    for m in range(1, n):
        h = (t[m] - t[m - 1]) / substeps
        u, tl = v[m], load[m]
        for _ in range(substeps):
            net = k * i - tl
            if w == 0.0 and abs(net) <= tc:
                i = u / r + (i - u / r) * np.exp(-h * r / l)
                continue
            direction = np.sign(w) if w != 0.0 else np.sign(net)
            i1, w1 = _rk4(i, w, h, u, direction, r, l, k, j, b, tc, tl)
            if w1 * direction < 0.0 and tc > 0.0:
                lo, hi = 0.0, h
                for _ in range(40):
                    mid = 0.5 * (lo + hi)
                    _, wm = _rk4(i, w, mid, u, direction, r, l, k, j, b, tc, tl)
                    if wm * direction < 0.0:
                        hi = mid
                    else:
                        lo = mid
                ic, _ = _rk4(i, w, lo, u, direction, r, l, k, j, b, tc, tl)
                _, wm = _rk4(i, w, lo / 2, u, direction, r, l, k, j, b, tc, tl)
                angle += lo / 6 * (w + 4 * wm)
                rest = h - lo
                net = k * ic - tl
                if abs(net) <= tc:
                    i1 = u / r + (ic - u / r) * np.exp(-rest * r / l)
                    w1 = 0.0
                else:
                    s = np.sign(net)
                    i1, w1 = _rk4(ic, 0.0, rest, u, s, r, l, k, j, b, tc, tl)
                    _, wm = _rk4(ic, 0.0, rest / 2, u, s, r, l, k, j, b, tc, tl)
                    angle += rest / 6 * (4 * wm + w1)
            else:
                _, wm = _rk4(i, w, h / 2, u, direction, r, l, k, j, b, tc, tl)
                angle += h / 6 * (w + 4 * wm + w1)
            i, w = i1, w1
        out[m] = i, w, angle
    return out


def excitation(t, kind, amplitude=12.0, seed=0):
    """Return the voltage held over the interval that ends at each instant."""
    rng = np.random.default_rng(seed)
    s = np.concatenate([[t[0]], t[:-1]])
    if kind == "sine":
        return amplitude * np.sin(2 * np.pi * 1.0371 * s + 0.3)
    if kind == "square":
        return amplitude * np.sign(np.sin(2 * np.pi * 0.9173 * s + 0.2))
    f = np.geomspace(0.1, 20, 24) * (1 + 0.01 * rng.standard_normal(24))
    x = np.cos(2 * np.pi * np.outer(s, f) + rng.uniform(0, 2 * np.pi, 24)).sum(axis=1)
    return amplitude * x / np.abs(x).max()


def truth(wheel: str, static_voltage: float) -> dict[str, float]:
    """Return parameters and combinations of a motor of Table 1 with Coulomb friction."""
    r, el, k, j, b = TABLE_1[wheel]
    a0 = k * k + r * b
    return {
        "resistance": r,
        "inductance": el,
        "motor_constant": k,
        "inertia": j,
        "viscous_friction": b,
        "coulomb_friction": static_voltage * k / r,
        "dc_gain": k / a0,
        "time_constant": (r * j + el * b) / a0,
        "time_constant_product": el * j / a0,
        "static_voltage": static_voltage,
    }


def check(found, truth, names=None, *, sigmas=4.0, floor=0.0, most=None, total=False):
    """Assert that quantities are within so many standard deviations of the truth.

    ``floor`` is an additional error and ``most`` the largest deviation, relative to the truth;
    with ``total`` the deviations include systematic uncertainty.
    """
    for name in names or truth:
        q, true = found.parameters.get(name) or found.combinations[name], truth[name]
        std = q.total_std if total else q.std
        assert abs(q.value - true) < sigmas * std + floor * abs(true), (name, q, true)
        assert most is None or std < most * abs(true), (name, q, true)


def first_order(voltage, gain, tau, step):
    """Return the exact speed, from rest, under voltages held over the interval before each row."""
    keep = np.exp(-step / tau)
    return np.r_[0.0, lfilter([1 - keep], [1.0, -keep], gain * voltage[1:])]


def counted(t, voltage, angle, per_turn=500.0, current=None) -> Record:
    """Return the record of a motor whose angle is counted."""
    count = np.floor(angle * per_turn / (2 * np.pi)).astype(np.int64)
    return Record("motor", t, voltage, current, count=count, hardware=Hardware(1.0, per_turn))


def record(
    wheel="rear_left",
    *,
    current=True,
    static_voltage=0.3,
    kinds=("sine", "square", "fourier"),
    seconds=5.0,
    rate=200.0,
    amplitude=10.0,
    torque_noise=0.0,
    seed=0,
    voltage=None,
):
    """Return counts, differenced speed and noisy current of a motor of Table 1."""
    rng = np.random.default_rng(seed)
    n = int(seconds * rate)
    t = np.arange(n * len(kinds)) / rate
    if voltage is None:
        voltage = np.concatenate([excitation(t[:n], k, amplitude) for k in kinds])
    t = t[: len(voltage)]
    r, el, k, j, b = TABLE_1[wheel]
    load = torque_noise * k / r * rng.standard_normal(t.size)
    out = simulate(
        t, voltage, r, el, k, j, b, static_voltage * k / r, load, int(max(4, 10_000 / rate))
    )
    count = np.floor(out[:, 2] / QUANTUM + rng.uniform()).astype(np.int64)
    speed = np.zeros(t.size)
    speed[1:] = np.diff(count) * QUANTUM * rate
    amps = out[:, 0] + 0.01 * rng.standard_normal(t.size) if current else None
    hardware = Hardware(65.5, 500.0, 0, 12.0, None)
    return Record(wheel, t, voltage, amps, speed, None, count, hardware=hardware, source="bag")
