"""Random motors over two decades around Table 1, from an independent simulator, from cold.

Each motor is one line of a file, so that a long run may be stopped and taken up again:

    python benchmarks/cold_start.py [--motors 200] [--seconds 6] [--rate 1000] [--lines FILE.jsonl]
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from known_motors import TABLE_1, recording, table

from smp_motor_ident.errors import SmpError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation import fit
from smp_motor_ident.estimation.fit import Options
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model.physical import physical
from smp_motor_ident.model.structures import Electromechanical, SecondOrder

CASES = {
    "linear, voltage only": (False, False, 0.0),
    "linear, with current": (True, False, 0.0),
    "friction, with current": (True, True, 0.0),
    "friction and torque noise, with current": (True, True, 0.2),
    "friction, voltage only": (False, True, 0.0),
}
FAR = 5.0  # standard deviations beyond which an answer is wrong: none in 3 million by chance


def motor(rng: np.random.Generator) -> tuple[float, ...]:
    """Return a motor whose parameters lie within a decade of one of Table 1's, each way."""
    base = np.array(list(TABLE_1.values())[rng.integers(4)])
    return tuple(base * 10 ** rng.uniform(-1, 1, 5))


def minimum(record, z, current: bool, friction: bool) -> dict:
    """Return whether the descent from cold ends as low as one from the truth, and its time."""
    rubs = "symmetric" if friction else "none"
    structure = Electromechanical(rubs) if current else SecondOrder(rubs, shape=friction)
    data = prepare([record], current)
    begun = time.perf_counter()
    found = initial_fit(data, structure, Options())
    spent = time.perf_counter() - begun
    if found is None:
        return {"right": False, "seconds": spent}
    near = fit.solve(data, structure, found.at(structure.complete(z), np.zeros((1, 5))))
    # At or below the deviance that a start from the truth reaches; 0.1 % of noise.
    above = found.deviance - near.deviance
    return {"right": bool(above <= max(10.0, 1e-3 * data.size)), "above": above, "seconds": spent}


def answer(record, z) -> dict:
    """Return what the tool says of the record, and the worst error of what it claims."""
    begun = time.perf_counter()
    try:
        e = estimate(record)
    except SmpError as refusal:
        return {"says": "refused", "words": str(refusal), "spent": time.perf_counter() - begun}
    values = {**physical(z), **{n: v for n, (v, _) in SecondOrder().combinations(z).items()}}
    claims = {n: q for n, q in {**e.combinations, **e.parameters}.items()
              if q.status == "estimated" and q.std and n in values}  # fmt: skip
    errors = {n: abs(q.value - values[n]) / q.std for n, q in claims.items()}
    worst = max(errors, key=lambda n: errors[n])
    words = list(e.warnings) if e.unreliable else []
    off = abs(claims[worst].value / values[worst] - 1) if values[worst] else 0.0
    return {"says": "unreliable" if words else "sure", "words": "; ".join(words), "model": e.model,
            "worst": worst, "sigmas": errors[worst], "off": off,
            "spent": time.perf_counter() - begun}  # fmt: skip


def run(args) -> list[dict]:
    """Return all lines, those of the file first, those still to do appended to it."""
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
            record, z = recording(
                p, "all", current=current, static_voltage=volts, torque_noise=torque,
                seconds=args.seconds, rate=args.rate, seed=n,
            )  # fmt: skip
            line = {"case": name, "n": n, "motor": p, "static": volts,
                    **minimum(record, z, current, friction)}  # fmt: skip
            if n < args.answers or not line["right"]:
                line.update(answer(record, z))
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
    parser.add_argument("--answers", type=int, default=40,
                        help="motors of each case whose whole answer is judged")  # fmt: skip
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--lines", help="file of motors, appended to")
    args = parser.parse_args()
    lines = run(args)
    rows = []
    for name in CASES:
        here = [x for x in lines if x["case"] == name]
        right = sum(x["right"] for x in here)
        rest = [x for x in here if not x["right"]]
        warned = sum(x["says"] != "sure" for x in rest)
        fine = sum(x["says"] == "sure" and x["sigmas"] <= FAR for x in rest)
        asked = [x for x in here if "says" in x]
        wrong = [x for x in asked if x["says"] == "sure" and x["sigmas"] > FAR]
        rows.append(
            (name, f"{right} of {len(here)} ({100 * right / len(here):.1f} %)", warned,
             fine, len(rest) - warned - fine,
             f"{sum(x['says'] == 'sure' for x in asked)} of {len(asked)}",
             sum(x["says"] == "unreliable" for x in asked),
             sum(x["says"] == "refused" for x in asked), len(wrong),
             f"{1e3 * np.median([x['seconds'] for x in here]):.0f} ms")
        )  # fmt: skip
    head = ("case", "right minimum", "else warned", "else the tool is right", "else silent",
            "tool: sure", "unreliable",
            "refused", f"sure, yet off by > {FAR:g} std", "median time")  # fmt: skip
    print("\n" + table(head, rows))


if __name__ == "__main__":
    main()
