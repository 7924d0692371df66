# SPDX-License-Identifier: Apache-2.0
"""Identify recordings of textbook simulators: right, unreliable, refused or silently wrong.

A small midpoint simulator drives random motors by the signals of a textbook.  The logs vary: with
or without noise and current; speed, angle or counts; a voltage that holds before or after its row,
or changes linearly between rows, and is sometimes measured.  ``silent``: a
number is off by more than 5 of its standard deviations and 2 %, and nothing is unreliable.

Usage: python benchmarks/conventions.py [--motors 54] [--seed S] [--list]
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import numpy as np  # noqa: E402
from numba import njit  # noqa: E402

RATES = (20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
MOST = 20_000
KINDS = ("sine", "square", "step", "stairs", "chirp", "prbs", "fourier", "triangle", "reversal")
HOLDS = ("before", "after", "interpolated")


def motor(rng: np.random.Generator) -> tuple[float, float, float, float, float]:
    """Return R, L, K, J and b of a random small motor."""
    r, k, tau, te = (np.exp(rng.uniform(np.log(a), np.log(b))) for a, b in
                     ((0.3, 20.0), (0.005, 0.1), (0.015, 0.3), (2e-4, 3e-3)))  # fmt: skip
    return r, r * te, k, tau * k * k / r, rng.choice([0.0, 0.05, 0.3]) * k * k / r


def truths(m: tuple[float, ...], tc: float) -> dict[str, float]:
    """Return the true values that an identification may state."""
    r, el, k, j, b = m
    below = k * k + r * b
    return {
        "dc_gain": k / below, "time_constant": (r * j + el * b) / below,
        "time_constant_product": el * j / below, "static_voltage": r * tc / k, "resistance": r,
        "inductance": el, "motor_constant": k, "inertia": j, "viscous_friction": b,
        "coulomb_friction": tc,
    }  # fmt: skip


def signal(kind: str, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a textbook's excitation between -1 and 1."""
    end = t[-1]
    if kind == "prbs":
        return np.repeat(rng.choice([-1.0, 1.0], size=t.size // 20 + 1), 20)[: t.size]
    if kind == "fourier":
        tones = (0.3, 0.7, 1.3, 2.9, 5.1)
        return sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in tones) / 3
    return {
        "sine": np.sin(2 * np.pi * t * rng.choice([0.2, 0.5, 1, 2])),
        "square": np.sign(np.sin(2 * np.pi * t * rng.choice([0.25, 0.5, 1]) + 1e-9)),
        "step": (t >= 0.1 * end).astype(float),
        "stairs": np.floor(1 + t / end * 4.999) / 5,
        "chirp": np.sin(2 * np.pi * (0.1 * t + 2.5 / end * t * t)),
        "triangle": 2 * np.abs(2 * ((t * 0.5) % 1) - 1) - 1,
        "reversal": np.where(t < 0.5 * end, 1.0, -1.0) * (t >= 0.05 * end),
    }[kind]


@njit(cache=True)
def _simulate(r, el, k, j, b, tc, t, u, straight, steps):
    i = w = angle = 0.0
    out = np.zeros((t.size, 3))
    h = (t[1] - t[0]) / steps
    for n in range(t.size):
        out[n] = np.array([i, w, angle])
        if n + 1 == t.size:
            break
        for s in range(steps):
            v = u[n] + (u[n + 1] - u[n]) * (s + 0.5) / steps if straight else u[n]
            rub = tc * np.sign(w) if w != 0.0 else min(max(k * i, -tc), tc)
            im = i + 0.5 * h * (v - r * i - k * w) / el
            wm = w + 0.5 * h * (k * i - b * w - rub) / j
            rub = tc * np.sign(wm) if wm != 0.0 else min(max(k * im, -tc), tc)
            on = w + h * (k * im - b * wm - rub) / j
            if w != 0.0 and on * w < 0.0 and tc > 0.0:
                on = 0.0
            i += h * (v - r * im - k * wm) / el
            angle += 0.5 * h * (w + on)
            w = on
    return out


def recording(seed: int):
    """Return a random record, its truth, its supply and its description."""
    from smp_motor_ident.record import Hardware, Record

    rng = np.random.default_rng(seed)
    m, top = motor(rng), float(rng.choice([5, 6, 9, 12, 24]))
    r, el, k, *_ = m
    tc = float(rng.choice([0, 0.02, 0.1])) * top * k / r
    true, kind = truths(m, tc), KINDS[seed % len(KINDS)]
    tau = true["time_constant"]
    rate = float(rng.choice([x for x in RATES if x * tau > 2.5] or [RATES[-1]]))
    lasts = float(rng.choice([5, 10, 20, 30]))
    lasts = max(lasts / 5, 10 * tau) if kind == "step" else lasts
    t = np.arange(int(min(lasts * rate, MOST))) / rate
    u = top * np.asarray(signal(kind, t, rng), dtype=float)
    hold, noise = str(rng.choice(HOLDS)), float(rng.choice([0, 0, 0.002, 0.01]))
    steps = max(8, int(np.ceil(1 / rate / min(2e-5, 0.05 * el / r))))
    out = _simulate(*m, tc, t, u, hold == "interpolated", steps)
    voltage = np.concatenate([[0.0], u[:-1]]) if hold == "before" else u
    what = str(rng.choice(["speed", "speed", "counts", "angle"]))
    turn = float(rng.choice([28, 64, 500, 2000])) if what == "counts" else None
    motion = {
        "speed": {"velocity": out[:, 1]
                  + noise * top * true["dc_gain"] * rng.standard_normal(t.size)},
        "angle": {"position": out[:, 2] + 0.1 * noise * rng.standard_normal(t.size)},
        "counts": {"count": np.floor(out[:, 2] * (turn or 0) / 2 / np.pi + rng.uniform())
                   .astype(np.int64)},
    }[what]  # fmt: skip
    current = out[:, 0] + noise * top / r * rng.standard_normal(t.size)
    current = current if rng.random() < 0.5 else None
    measured = rng.random() < 0.15
    if measured:
        voltage = voltage + 0.005 * top * rng.standard_normal(t.size)
    about = (
        f"seed {seed}: {kind} {rate:g} Hz n {t.size} {what} {turn or ''} noise {noise:g} "
        f"{hold}{' measured' if measured else ''}{' current' if current is not None else ''}"
    )
    hardware = Hardware(1.0, turn, 0, top, None)
    return Record("motor", t, voltage, current, hardware=hardware, **motion), true, top, about


def errors(found, true: dict[str, float], top: float) -> dict[str, float]:
    """Return the error of each wrong number in stated standard deviations."""
    r, k = true["resistance"], true["motor_constant"]
    floors = {"static_voltage": 0.005 * top, "coulomb_friction": 0.005 * top * k / r,
              "viscous_friction": 0.02 * k * k / r}  # fmt: skip
    wrong = {}
    for name, q in {**found.combinations, **found.parameters}.items():
        if name not in true or q.value is None or q.std is None or q.status != "estimated":
            continue
        off = abs(q.value - true[name])
        if name == "time_constant" and not found.value("time_constant_product"):
            off = max(0.0, off - true["inductance"] / r)  # a first-order answer may count L/R
        if off > max(0.02 * abs(true[name]), floors.get(name, 0.0)) and off > 5 * q.std:
            wrong[name] = off / max(q.std, 1e-300)
    return wrong


def judge(seed: int) -> tuple[str, str]:
    """Return the outcome of one record, and words."""
    from smp_motor_ident.errors import SmpError
    from smp_motor_ident.estimate import estimate

    record, true, top, about = recording(seed)
    try:
        found = estimate(record)
    except SmpError as refusal:
        return "refused", f"{about}: {refusal}"
    except Exception as crash:  # a benchmark wants to go on
        return "crash", f"{about}: {crash!r}"
    wrong = errors(found, true, top)
    words = ", ".join(f"{n} {x:.0f} std" for n, x in wrong.items()) or "fine"
    codes = [f.code for f in found.findings if f.severity == "unreliable"]
    outcome = "unreliable" if codes else "silent" if wrong else "right"
    return outcome, f"{about}: {found.model}; {words}; {codes or ''}"


def main() -> None:
    """Run and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--motors", type=int, default=54)
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--list", action="store_true", help="print every record that is not right")
    args = parser.parse_args()
    seed = args.seed if args.seed is not None else int(time.time())
    counts: Counter[str] = Counter()
    with ProcessPoolExecutor(args.processes) as pool:
        for outcome, about in pool.map(judge, range(seed, seed + args.motors)):
            counts[outcome] += 1
            if args.list and outcome != "right":
                print(f"{outcome:11}{about}", flush=True)
    print(f"seed {seed}, {args.motors} motors: " + ", ".join(f"{n} {k}" for k, n in counts.items()))


if __name__ == "__main__":
    main()
