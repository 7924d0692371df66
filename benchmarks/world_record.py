# SPDX-License-Identifier: Apache-2.0
"""Record a simulated drive by effect, strength and seed."""

from __future__ import annotations

import numpy as np
import world_motor
from world_effects import Case, Effect
from world_signals import RICH, WAVES, motor, wave

RATES = (50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0, 5000.0)
MOST = 20_000


def case(effect: Effect, level: int, rng: np.random.Generator, rich: bool = False) -> Case:
    """Draw motor, excitation, rate and signals for an effect."""
    m = motor(rng)
    tau = m.truth()["time_constant"]
    fit = [r for r in RATES if 3 < r * tau < 400] or [RATES[-1]]
    rate = float(rng.choice(fit))
    kind = str(rng.choice(RICH if rich else WAVES))
    seconds = tau * rng.uniform(2, 6) * 5 if kind == "step" else rng.uniform(60, 250) * tau
    seconds = float(np.clip(seconds, 60 / rate + 2 * tau, min(60.0, MOST / rate)))
    if kind != "step":
        seconds = min(max(seconds, 3.0), MOST / rate)
    signals = str(rng.choice(effect.signals or ("counts", "counts_speed", "speed", "angle")))
    c = Case(
        m, kind, rate, int(seconds * rate), m.supply * float(rng.uniform(0.5, 1.0)), signals,
        float(rng.choice([28, 64, 500, 2000])),
        bool(rng.random() < 0.35) if effect.current is None else effect.current,
    )  # fmt: skip
    effect.change(c, level)
    return c


def measure(c: Case, rng: np.random.Generator) -> dict[str, object]:
    """Simulate a case; return ``time``, ``voltage`` and what else was recorded."""
    m = c.motor
    n = c.samples
    t = np.arange(n) / c.rate
    rest = min(int(c.stamps.get("rest", 0) * c.rate), MOST)
    u = c.amplitude * wave(c.kind, t, c.tau, rng)
    if c.stamps.get("first_row"):
        u = u[np.argmax(np.abs(u) > 0.3 * c.amplitude) :]
    u = np.concatenate([np.zeros(rest), u])
    n = u.size
    every, values = fine_steps(c), plant(c)
    fine = c.step / every
    target = np.zeros(n)
    if c.kind == "closed_loop":
        values["kp"] = 0.6 * c.tau / max(c.tau * 0.4, 4 * c.step) / m.truth()["dc_gain"]
        values["ki"] = values["kp"] / c.tau
        slow = np.repeat(rng.uniform(-0.7, 0.7, n // int(max(3, 3 * c.tau * c.rate)) + 1),
                         int(max(3, 3 * c.tau * c.rate)))[:n]  # fmt: skip
        target = slow * c.fastest
    p = world_motor.drive(**{**values, **c.drive})
    change = at_bridge(c, n, rng)
    if c.stamps.get("topics"):
        change = change + 0.3 * c.step
    noise = floor_torque(c, n * every, fine, rng)
    out = world_motor.simulate(every, fine, change, u, target, noise, p)
    made = _sensed(c, out, every, fine, rng)
    # The tools record the command that acted up to the instant of each row.
    voltage = np.concatenate([[0.0], u])[: n + 1]
    if c.stamps.get("first_row"):
        voltage[0] = u[0]
    return _stamped(c, {"time": np.arange(n + 1) * c.step, "voltage": voltage, **made}, u, rng)


def fine_steps(c: Case) -> int:
    """Return how many steps of the simulation make a sample."""
    m = c.motor
    every = int(np.clip(np.ceil(60 * c.step / min(c.tau, 1.0)), 4, 24))
    if c.sensor.get("i_lowpass") or c.sensor.get("i_window"):  # it follows the winding
        every = int(np.clip(np.ceil(8 * c.step * m.R / m.L), every, 96))
    return every


def plant(c: Case) -> dict[str, float]:
    """Return the parameters of the motor itself."""
    m = c.motor
    return dict(R=m.R, L=m.L, K=m.K, J=m.J, b=m.b, tc=m.tc, supply=m.supply, gear=m.gear)


def at_bridge(c: Case, n: int, rng: np.random.Generator, late: float = 0.0) -> np.ndarray:
    """Return when the command of each sample reaches the bridge."""
    change = np.arange(n) * c.step + c.stamps.get("delay", 0.0) + late
    period = c.stamps.get("driver", 0.0)
    if period:
        change = np.ceil((change + rng.uniform(0, period)) / period) * period
    return change


def floor_torque(c: Case, n: int, fine: float, rng: np.random.Generator) -> np.ndarray:
    """Return the torque of a floor at every fine step."""
    if not c.sensor.get("floor"):
        return np.zeros(n)
    steps = rng.standard_normal(n)
    a = np.exp(-fine / (3 * c.tau))
    return c.sensor["floor"] * filtered(np.sqrt(1 - a * a) * steps, 1 - a) / (1 - a)


def filtered(x: np.ndarray, a: float) -> np.ndarray:
    from scipy.signal import lfilter

    return lfilter([a], [1, a - 1], x)


def low_passed(x: np.ndarray, step: float, lag: float) -> np.ndarray:
    """Return the first-order low-pass of a linearly interpolated signal, from rest."""
    from scipy.signal import lfilter

    kept = np.exp(-step / lag)
    mean = lag / step * (1 - kept)
    return lfilter([1 - mean, mean - kept], [1, -kept], x)


def _window(integral: np.ndarray, fine: float, span: float, at: np.ndarray) -> np.ndarray:
    """Return means over the ``span`` before each instant from a running integral."""
    grid = np.arange(integral.size) * fine
    return (np.interp(at, grid, integral) - np.interp(at - span, grid, integral)) / span


def _sensed(
    c: Case, out: np.ndarray, every: int, fine: float, rng: np.random.Generator
) -> dict[str, object]:
    """Return the sensors' readings of the motion."""
    at = np.arange(0, len(out), every) * fine
    sign = c.sensor.get("sign", 1.0)
    if c.signals == "speed":
        made = {"velocity": _speed(c, sign * out[:, 3], sign * out[:, 4], at, fine, rng)}
    else:
        made = _angle(c, sign * out[::every, 4], rng)
    if c.current:
        made["current"] = _current(c, out, every, at, fine, rng)
    return made


def _speed(
    c: Case, w: np.ndarray, angle: np.ndarray, at: np.ndarray, fine: float, rng: np.random.Generator
) -> np.ndarray:
    s = c.sensor
    if s.get("count_ema"):  # as firmware has it that counts: differences, exponentially smoothed
        quantum = 2 * np.pi / c.turn
        exact = np.interp(at, np.arange(len(angle)) * fine, angle) / quantum + rng.uniform()
        return filtered(np.diff(np.floor(exact), prepend=0.0) * quantum / c.step, s["count_ema"])
    if s.get("lowpass"):
        w = low_passed(w, fine, s["lowpass"])
    if s.get("window"):
        y = _window(angle, fine, s["window"], at)
    else:
        y = np.interp(at - s.get("late", 0.0), np.arange(len(w)) * fine, w)
    y = y + 0.003 * c.fastest * rng.standard_normal(at.size)
    if s.get("coarse"):
        y = s["coarse"] * np.round(y / s["coarse"])
    if s.get("outliers"):
        bad = rng.random(at.size) < s["outliers"]
        y = np.where(bad, y + c.fastest * rng.uniform(-1, 1, at.size), y)
    return y


def _angle(c: Case, a: np.ndarray, rng: np.random.Generator) -> dict[str, object]:
    s = c.sensor
    if s.get("eccentric"):
        a = a + s["eccentric"] * np.sin(a + 1.0)
    quantum = 2 * np.pi / c.turn
    if c.signals == "angle":
        return {"position": a + 0.3 * quantum * rng.standard_normal(a.size)}
    exact = a / quantum + rng.uniform()
    if s.get("missed"):
        moved = np.diff(exact, prepend=exact[0])
        fast = np.abs(moved) > 0.5 * np.abs(moved).max()
        exact = exact - np.cumsum(np.where(fast, s["missed"] * moved, 0.0))
    count = np.floor(exact).astype(np.int64)
    if c.signals == "counts":
        return {"count": count}
    return {"count": count, "velocity": np.diff(count, prepend=count[0]) * quantum * c.rate}


def _current(
    c: Case, out: np.ndarray, every: int, at: np.ndarray, fine: float, rng: np.random.Generator
) -> np.ndarray:
    s = c.sensor
    i = out[:, 0]
    if s.get("i_lowpass"):
        i = low_passed(i, fine, s["i_lowpass"])
    y = i[::every]
    span = s.get("i_window", c.step if c.drive.get("pwm") or s.get("i_supply") else 0.0)
    if span:
        y = _window(np.cumsum(out[:, 6 if s.get("i_supply") else 5]) * fine, fine, span, at)
    if s.get("i_smooth"):  # a digital filter at the rate of the log, by so many samples late
        y = filtered(y, 1 / (1 + s["i_smooth"]))
    if s.get("i_abs"):
        y = np.abs(y)
    y = y * (1 + s.get("i_scale", 0.0)) + s.get("i_offset", 0.0)
    y = y + 0.004 * c.stall * rng.standard_normal(y.size)
    if s.get("i_coarse"):
        y = s["i_coarse"] * np.round(y / s["i_coarse"])
    return y


def _stamped(
    c: Case, made: dict[str, object], u: np.ndarray, rng: np.random.Generator
) -> dict[str, object]:
    """Give the rows the stamps and losses that their transport has."""
    t = made["time"].copy()
    s = c.stamps
    n = t.size
    if s.get("topics"):
        sent = np.arange(u.size) * c.step + rng.exponential(s["topics"], u.size)
        arrived = np.maximum.accumulate(t + rng.exponential(s["topics"], n))
        order = np.argsort(sent, kind="stable")
        last = np.searchsorted(sent[order], arrived, side="right") - 1
        made["voltage"] = np.where(last >= 0, u[order[np.maximum(last, 0)]], 0.0)
        t = arrived
    if s.get("jitter"):
        t = t + rng.uniform(-0.5, 0.5, n) * s["jitter"]
    if s.get("latency"):
        t = np.maximum.accumulate(t + rng.exponential(s["latency"], n))
    if s.get("bursts"):
        size = int(s["bursts"])
        block = np.arange(n) // size
        t = t[np.minimum((block + 1) * size, n - 1)] + 0.02 * c.step * (np.arange(n) % size)
    if s.get("coarse"):
        t = np.round(t / s["coarse"]) * s["coarse"]
    keep = np.ones(n, bool)
    if s.get("lost"):
        keep = rng.random(n) > s["lost"]
    for _ in range(int(s.get("gaps", 0))):
        begin = rng.integers(0, n)
        keep[begin : begin + max(3, n // 60)] = False
    t = t[keep]
    for k in range(1, t.size):
        t[k] = max(t[k], t[k - 1] + 1e-6 * c.step)
    arrays = {k: v[keep] for k, v in made.items() if k != "time"}
    return {"time": t - t[0], **arrays}
