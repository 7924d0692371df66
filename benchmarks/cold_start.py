# SPDX-License-Identifier: Apache-2.0
"""Identify random motors over two decades around Table 1, from an independent simulator.

Each motor is one line of a file, so an interrupted run can be resumed:

    python benchmarks/cold_start.py [--motors 200] [--seconds 6] [--rate 1000] [--lines FILE.jsonl]
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from known_motors import TABLE_1, recording, table, truth_of

from smp_motor_ident.errors import SmpError
from smp_motor_ident.estimate import estimate

CASES = {
    "linear, voltage only": (False, False, 0.0),
    "linear, with current": (True, False, 0.0),
    "friction, with current": (True, True, 0.0),
    "friction and torque noise, with current": (True, True, 0.2),
    "friction, voltage only": (False, True, 0.0),
}
FAR = 5.0  # standard deviations of a wrong answer: one in 2 million by chance
NEAR = 0.05  # relative error of gain and time constant at the right minimum


def motor(rng: np.random.Generator) -> tuple[float, ...]:
    """Return a motor whose parameters lie within a decade of one of Table 1's, each way."""
    base = np.array(list(TABLE_1.values())[rng.integers(4)])
    return tuple(base * 10 ** rng.uniform(-1, 1, 5))


def answer(record, motor) -> dict:
    """Return the result for a record, with the largest error of its numbers."""
    begun = time.process_time()
    try:
        e = estimate(record)
    except SmpError as refusal:
        return {"says": "refused", "words": str(refusal), "right": False,
                "seconds": time.process_time() - begun}  # fmt: skip
    spent = time.process_time() - begun
    truth = truth_of(motor)
    claims = {n: q for n, q in {**e.combinations, **e.parameters}.items()
              if q.status == "estimated" and q.std and n in truth}  # fmt: skip
    sigmas = {n: abs(q.value - truth[n]) / q.total_std for n, q in claims.items()}
    worst = max(sigmas, key=lambda n: sigmas[n])
    right = all(abs(e.value(n) / truth[n] - 1) < NEAR for n in ("dc_gain", "time_constant"))
    return {"says": "unreliable" if e.unreliable else "sure", "words": "; ".join(e.warnings),
            "right": right, "model": e.model, "worst": worst, "sigmas": sigmas[worst],
            "off": abs(claims[worst].value / truth[worst] - 1) if truth[worst] else 0.0,
            "seconds": spent}  # fmt: skip


def run(args) -> list[dict]:
    """Return all lines: those of the file, then new ones, which are appended to it."""
    path = Path(args.lines) if args.lines else None
    lines = [json.loads(x) for x in path.read_text().splitlines()] if path and path.exists() else []
    done = {(x["case"], x["n"]) for x in lines}
    for name, (current, friction, torque) in CASES.items():
        rng = np.random.default_rng(7)
        for n in range(args.motors):
            p = motor(rng)
            volts = rng.uniform(0.1, 2.0) if friction else 0.0
            if (name, n) in done:
                continue
            record, true = recording(
                p, "all", current=current, static_voltage=volts, torque_noise=torque,
                seconds=args.seconds, rate=args.rate, seed=n,
            )  # fmt: skip
            line = {"case": name, "n": n, "motor": p, "static": volts, **answer(record, true)}
            lines.append(line)
            if path:
                with path.open("a") as file:
                    file.write(json.dumps(line) + "\n")
            print(f"\r{name}: {n + 1} of {args.motors}  ", end="", flush=True)
        print()
    return [x for x in lines if x["n"] < args.motors]


def main() -> None:
    """Run all cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--motors", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--lines", help="file of motors, appended to")
    args = parser.parse_args()
    lines = run(args)
    rows = []
    for name in CASES:
        here = [x for x in lines if x["case"] == name]
        right = sum(x["right"] for x in here)
        lost = [x for x in here if not x["right"]]
        wrong = [x for x in here if x["says"] == "sure" and x["sigmas"] > FAR]
        rows.append(
            (name, f"{right} of {len(here)} ({100 * right / len(here):.1f} %)",
             sum(x["says"] != "sure" for x in lost),
             sum(x["says"] == "unreliable" for x in here),
             sum(x["says"] == "refused" for x in here), len(wrong),
             f"{1e3 * np.median([x['seconds'] for x in here]):.0f} ms")
        )  # fmt: skip
    head = ("case", f"gain and lag within {100 * NEAR:.0f} %", "else said so", "unreliable",
            "refused", f"sure, yet off by > {FAR:g} std", "median processor time")  # fmt: skip
    print("\n" + table(head, rows))


if __name__ == "__main__":
    main()
