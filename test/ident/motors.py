# SPDX-License-Identifier: Apache-2.0
"""Recordings of known motors for the tests of estimation."""

import independent
import numpy as np
from scipy.signal import lfilter

from smp_motor_ident.record import Hardware, Record

QUANTUM = 2 * np.pi / 500
COLUMNS = ("resistance", "inductance", "motor_constant", "inertia", "viscous_friction")


def truth(wheel: str, static_voltage: float) -> dict[str, float]:
    """Return parameters and combinations of a motor of Table 1 with Coulomb friction."""
    r, el, k, j, b = independent.TABLE_1[wheel]
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
        voltage = np.concatenate([independent.excitation(t[:n], k, amplitude) for k in kinds])
    t = t[: len(voltage)]
    r, el, k, j, b = independent.TABLE_1[wheel]
    load = torque_noise * k / r * rng.standard_normal(t.size)
    out = independent.simulate(
        t, voltage, r, el, k, j, b, static_voltage * k / r, load, int(max(4, 10_000 / rate))
    )
    count = np.floor(out[:, 2] / QUANTUM + rng.uniform()).astype(np.int64)
    speed = np.zeros(t.size)
    speed[1:] = np.diff(count) * QUANTUM * rate
    amps = out[:, 0] + 0.01 * rng.standard_normal(t.size) if current else None
    hardware = Hardware(65.5, 500.0, 0, 12.0, None)
    return Record(wheel, t, voltage, amps, speed, None, count, hardware=hardware, source="bag")
