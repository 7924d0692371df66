# SPDX-License-Identifier: Apache-2.0
"""Identify sound and damaged records of random motors: faults named and faults missed.

Motor, rate, wave, amplitude, encoder, noise and available signals are drawn at random.

    python benchmarks/bad_data.py [--records 20] [--sound 200] [--lines FILE.jsonl]
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from known_motors import EXACT, TABLE_1, independent, motor_of, substeps, table, truth_of

from smp_motor_ident.errors import SmpError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Hardware, Record

WAVES = ("sine", "square", "fourier", "prbs", "steps", "chirp", "ramps")
FAR = 5.0  # standard deviations beyond which an answer is wrong
Fault = Callable[[Record, np.random.Generator], Record]


def wave(t: np.ndarray, kind: str, tau: float, rng: np.random.Generator) -> np.ndarray:
    """Return a command between -1 and 1 that suits a motor's time constant."""
    f = np.clip(0.1 / tau, 0.3, 3.0)
    n, step = t.size, t[1] - t[0]
    if kind == "sine":
        return np.sin(2 * np.pi * f * t + rng.uniform(0, 6))
    if kind == "square":
        return np.sign(np.sin(2 * np.pi * f * t + rng.uniform(0, 6)))
    if kind == "fourier":
        tones = np.geomspace(0.2, min(10 * f, 0.3 / step), 16) * rng.uniform(0.95, 1.05, 16)
        x = np.cos(2 * np.pi * np.outer(t, tones) + rng.uniform(0, 6, 16)).sum(axis=1)
        return x / np.abs(x).max()
    if kind in ("prbs", "steps"):
        hold = max(1, int((0.5 if kind == "prbs" else 3.0) * max(tau, 0.03) / step))
        levels = rng.uniform(-1, 1, n // hold + 1)
        return np.repeat(np.sign(levels) if kind == "prbs" else levels, hold)[:n]
    if kind == "chirp":
        return np.sin(2 * np.pi * (0.2 * t + 0.5 * (4 * f - 0.2) * t**2 / t[-1]))
    return 2 / np.pi * np.arcsin(np.sin(2 * np.pi * 0.5 * f * t + rng.uniform(0, 6)))


def sound(
    seed: int, command: Callable[[np.ndarray], np.ndarray] | None = None
) -> tuple[Record, dict]:
    """Return a healthy record of a random motor, and its truth."""
    rng = np.random.default_rng(seed)
    base = np.array(list(TABLE_1.values())[rng.integers(4)])
    r, el, k, j, b = base * 3.0 ** rng.uniform(-1, 1, 5)
    tau = r * j / (k * k + r * b)
    fast = rng.choice([50, 100, 200, 500, 1000, 2000, 10_000])
    rate = float(max(fast, 50 * np.ceil(2 / tau / 50)))  # the motor must show in the samples
    seconds = float(np.clip(rng.uniform(6, 12), 0, 40_000 / rate))
    t = np.arange(int(seconds * rate)) / rate
    if rng.random() < 0.2:  # jittered stamps
        t = t + np.concatenate([[0.0], rng.uniform(-0.2, 0.2, t.size - 1) / rate])
    supply = rng.choice([6.0, 12.0, 24.0])
    kind = rng.choice(WAVES)
    v = supply * rng.uniform(0.5, 1.0) * wave(t, kind, tau, rng)
    if command is not None:
        v = command(v)
    static = supply * rng.choice([0.0, 0.01, 0.03, 0.06])
    noise = rng.choice([0.0, 0.0, 0.05]) * supply
    load = noise * k / r * rng.standard_normal(t.size)
    motor = motor_of((r, el, k, j, b), static)
    steps = substeps(motor, 1 / rate)
    out = independent.simulate(t, v, r, el, k, j, b, motor.coulomb_friction, load, steps)
    turn = float(rng.choice([12, 48, 500, 2048, 4096]))
    quantum = 2 * np.pi / turn
    count = np.floor(out[:, 2] / quantum + rng.uniform()).astype(np.int64)
    signals = rng.choice(["counts", "counts and speed", "speed", "angle"])
    current = None
    if rng.random() < 0.5:
        current = out[:, 0] + 0.003 * supply / r * rng.standard_normal(t.size)
    velocity = position = None
    if signals == "counts and speed":
        velocity = np.concatenate([[0.0], np.diff(count) * quantum / np.diff(t)])
    elif signals == "speed":
        velocity = out[:, 1] + 0.003 * np.abs(out[:, 1]).max() * rng.standard_normal(t.size)
    elif signals == "angle":
        position = out[:, 2] + quantum * rng.standard_normal(t.size)
    counted = signals.startswith("counts")
    made = Record(
        "motor", t - t[0], v, current, velocity, position, count if counted else None,
        hardware=Hardware(30.0, turn if counted else None, 0, supply, None, *EXACT),
        source=f"record {seed}",
    )  # fmt: skip
    about = {"seed": seed, "rate": rate, "wave": str(kind), "signals": str(signals), "tau": tau,
             "current": current is not None, "static": static, "torque": noise, "turn": turn,
             "samples": t.size}  # fmt: skip
    return made, {**about, "truth": truth_of(motor)}


def _scaled(record: Record, name: str, factor: float) -> Record:
    values = getattr(record, name)
    if values is None:
        return record
    return replace(record, **{name: (values * factor).astype(values.dtype)})


def _clip(record: Record, name: str, rng: np.random.Generator) -> Record | None:
    values = getattr(record, name)
    if values is None:
        return None
    top = float(rng.uniform(0.4, 0.7) * np.abs(values).max())
    return replace(record, **{name: np.clip(values, -top, top)})


def saturated_speed(record: Record, rng: np.random.Generator) -> Record | None:
    """Clip the speed where it is the output."""
    return _clip(record, "velocity", rng) if record.count is None else None


def saturated_current(record: Record, rng: np.random.Generator) -> Record | None:
    """Clip the current."""
    return _clip(record, "current", rng)


def dead_encoder(record: Record, rng: np.random.Generator) -> Record | None:
    """Freeze all sensors of the motion, from the start or later."""
    n = int(rng.choice([0, 0, len(record) // 4, len(record) // 2]))
    held = {}
    for name in ("count", "position", "velocity"):
        values = getattr(record, name)
        if values is not None:
            last = values[n] if name != "velocity" else 0 * values[n]
            held[name] = np.concatenate([values[:n], np.full(len(record) - n, last)])
    return replace(record, **held)


def swapped_leads(record: Record, rng: np.random.Generator) -> Record | None:
    """Reverse the motion."""
    for name in ("count", "position", "velocity"):
        record = _scaled(record, name, -1)
    return record


def swapped_channels(record: Record, rng: np.random.Generator) -> Record | None:
    """Reverse only the counts."""
    return (
        _scaled(record, "count", -1)
        if record.count is not None and record.velocity is not None
        else None
    )


def swapped_current(record: Record, rng: np.random.Generator) -> Record | None:
    """Reverse the current."""
    return _scaled(record, "current", -1) if record.current is not None else None


def wrong_ratio(record: Record, rng: np.random.Generator) -> Record | None:
    """Scale the speed relative to the counts."""
    if record.count is None or record.velocity is None:
        return None
    return _scaled(record, "velocity", float(rng.choice([0.25, 0.5, 0.8, 1.25, 2, 4, 30])))


def offset_current(record: Record, rng: np.random.Generator) -> Record | None:
    """Add a quarter to all of the largest current."""
    if record.current is None:
        return None
    add = rng.choice([-1, 1]) * rng.uniform(0.25, 1.0) * np.abs(record.current).max()
    return replace(record, current=record.current + add)


def nan_gaps(record: Record, rng: np.random.Generator) -> Record | None:
    """Lose most of the speed or angle in stretches."""
    name = "velocity" if record.velocity is not None else "position"
    if record.count is not None or getattr(record, name) is None:
        return None
    period = int(rng.integers(50, 400))
    lost = np.arange(len(record)) % period < rng.uniform(0.4, 0.8) * period
    return replace(record, **{name: np.where(lost, np.nan, getattr(record, name))})


def too_short(record: Record, rng: np.random.Generator) -> Record | None:
    """Keep a few samples."""
    return record.slice(10, 10 + int(rng.integers(5, 39)))


def foreign_voltage(record: Record, rng: np.random.Generator) -> Record | None:
    """Take the voltage of another motor's record."""
    other = sound(int(rng.integers(10**6, 10**7)))[0].voltage
    return replace(record, voltage=np.resize(other, len(record)), current=None)


FAULTS: dict[str, tuple[Fault, str]] = {
    "too short": (too_short, "too short"),
    "saturated speed": (saturated_speed, "saturated sensor, velocity"),
    "saturated current": (saturated_current, "saturated sensor, current"),
    "dead encoder": (dead_encoder, "dead encoder"),
    "swapped leads": (swapped_leads, "swapped sign, speed"),
    "swapped channels": (swapped_channels, "swapped sign"),
    "swapped current": (swapped_current, "swapped sign, current"),
    "wrong gear ratio": (wrong_ratio, "wrong gear ratio"),
    "current with an offset": (offset_current, "offset"),
    "NaN gaps": (nan_gaps, "NaN in"),
    "another motor's voltage": (
        foreign_voltage,
        "does not explain|data do not tell|no motor model",
    ),
}


def _drive(level: float) -> Callable:
    """Return commands that stay at a level of the largest, with or without a meter's noise."""
    return lambda rng: (
        lambda v: level * np.abs(v).max() + rng.choice([0, 0.003]) * rng.standard_normal(v.size)
    )


DRIVES = {
    "no excitation": (_drive(0.0), "no excitation"),
    "constant input": (_drive(1.0), "constant at"),
}


def judge(record: Record, truth: dict, words: str = "") -> dict:
    """Return the tool's result for a record."""
    begun = time.perf_counter()
    try:
        e = estimate(record)
    except SmpError as refusal:
        named = any(w in str(refusal) for w in words.split("|")) if words else False
        says = "named" if named else "refused"
        return {"says": says, "words": str(refusal), "code": getattr(refusal, "exit_code", None),
                "spent": time.perf_counter() - begun}  # fmt: skip
    claims = {n: q for n, q in {**e.combinations, **e.parameters}.items()
              if q.status == "estimated" and q.std and n in truth}  # fmt: skip
    errors = {n: abs(q.value - truth[n]) / q.std for n, q in claims.items()}
    doubt = e.unreliable
    if not errors:
        return {"says": "unreliable" if doubt else "right", "words": "; ".join(e.warnings),
                "model": e.model, "spent": time.perf_counter() - begun}  # fmt: skip
    worst = max(errors, key=lambda n: errors[n])
    says = "unreliable" if doubt else ("wrong" if errors[worst] > FAR else "right")
    if says == "right" and words and any(w in "; ".join(e.warnings) for w in words.split("|")):
        says = "named"  # and the result without the bad part is right
    off = abs(claims[worst].value / truth[worst] - 1) if truth[worst] else claims[worst].value
    return {"says": says, "words": "; ".join(e.warnings), "worst": worst, "sigmas": errors[worst],
            "off": off, "model": e.model, "fit": e.fit_percent.estimation,
            "spent": time.perf_counter() - begun}  # fmt: skip


def run(args):
    """Yield a line for every record."""
    for seed in range(args.sound):
        record, about = sound(seed)
        yield {"fault": "none", **about, **judge(record, about["truth"])}
    for name, (make, words) in DRIVES.items():
        for seed in range(args.records):
            rng = np.random.default_rng(seed)
            record, about = sound(10_000 + seed, make(rng))
            yield {"fault": name, **about, **judge(record, about["truth"], words)}
    for name, (spoil, words) in FAULTS.items():
        done, seed = 0, 20_000
        while done < args.records:
            seed += 1
            record, about = sound(seed)
            bad = spoil(record, np.random.default_rng(seed))
            if bad is None:
                continue
            done += 1
            yield {"fault": name, **about, **judge(bad, about["truth"], words)}


def main() -> None:
    """Run all records and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=20, help="of every fault")
    parser.add_argument("--sound", type=int, default=200, help="records without fault")
    parser.add_argument("--lines", help="file that every record's outcome is written to")
    args = parser.parse_args()
    lines = []
    with Path(args.lines or os.devnull).open("w") as file:
        for line in run(args):
            lines.append(line)
            file.write(json.dumps(line, default=float) + "\n")
            file.flush()
            print(f"\r{line['fault']} {len(lines)}   ", end="", flush=True)
    print()
    says = ("named", "refused", "unreliable", "right", "wrong")
    rows = []
    for fault in dict.fromkeys(x["fault"] for x in lines):
        here = [x for x in lines if x["fault"] == fault]
        rows.append((fault, len(here), *(sum(x["says"] == s for x in here) for s in says)))
    head = ("fault", "records", "named", "refused for another reason", "answer called unreliable",
            "answer within 5 std", "wrong answer")  # fmt: skip
    print(table(head, rows))


if __name__ == "__main__":
    main()
