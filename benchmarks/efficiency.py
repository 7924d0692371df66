"""Mean squared error over the Cramer-Rao bound, and coverage of the 95 % intervals.

Every realisation is one line of a file, so that a long run may be stopped and taken up again:

    python benchmarks/efficiency.py [--realisations 100] [--torque 0.3] [--lines FILE.jsonl]
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from known_motors import CURRENT_NOISE, QUANTUM, TABLE_1, recording, table

from smp_motor_control.motor.parameters import PHYSICAL
from smp_motor_ident.errors import SmpError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.likelihood.noise import NoiseModel, kalman_gain
from smp_motor_ident.likelihood.passes import evaluate
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.model.physical import physical_gradients
from smp_motor_ident.model.structures import Electromechanical, SecondOrder

COMBINATIONS = ("dc_gain", "time_constant", "time_constant_product")
KINDS = ("sine", "square", "fourier", "plain square")
TELLS = 0.3  # a quantity is identifiable where the bound's std is below this part of it


def bound(record, z, current: bool, torque: float) -> dict[str, tuple[float, float]]:
    """Return the truth and the Cramer-Rao variance of every quantity, at the truth."""
    structure = Electromechanical() if current else SecondOrder(shape=True)
    data = prepare([record], current)
    step = data.step
    noise = np.diag([QUANTUM**2 / 12, CURRENT_NOISE**2])
    gain = np.zeros((3, 2))
    if torque > 0:
        # White torque of `torque` volts held for a sample, as intensity on the acceleration.
        par, _ = structure.internal(z)
        ratio = (torque / par[1]) ** 2 * step / noise[0, 0]
        relative = noise[1, 1] / noise[0, 0] if current else 0.0
        gain, scale = kalman_gain(structure, z, ANGLE, step, ratio, relative)
        noise = scale * noise[0, 0] if current else np.diag([scale[0, 0] * noise[0, 0], 1.0])
    z = structure.complete(z)
    start = np.zeros((1, 5))
    here = evaluate(data, structure, z, start, start, NoiseModel(noise, gain))
    cov = np.linalg.inv(here.normal)
    m = structure.matrix
    known = structure.combinations(z)
    names = list(COMBINATIONS)
    if current:
        known |= physical_gradients(z)
        names += PHYSICAL[:5]
    rows = {n: (known[n][0], known[n][1] @ m) for n in names}
    return {n: (value, float(row @ cov @ row)) for n, (value, row) in rows.items()}


def realisation(wheel: str, kind: str, current: bool, seed: int, args) -> dict:
    """Return one estimate beside truth and bound, as a line of the file."""
    record, z = recording(
        TABLE_1[wheel], kind, current=current, seed=seed, seconds=args.seconds,
        torque_noise=args.torque, static_voltage=0.3,
    )  # fmt: skip
    limits = bound(record, z, current, args.torque)
    line = {"case": [wheel, kind, current], "seed": seed, "torque": args.torque,
            "model": args.model}  # fmt: skip
    model = "auto"
    if args.model == "known":
        model = "electromechanical" if current else "second_order"
    begun = time.perf_counter()
    try:
        e = estimate(record, model)
    except SmpError as refusal:
        return {**line, "refused": str(refusal)}
    found = {}
    for name, (true, variance) in limits.items():
        q = e.parameters.get(name) or e.combinations.get(name)
        if variance > (TELLS * true) ** 2:
            continue
        got = [q.value, q.std, *q.ci95] if q is not None and q.value is not None else None
        found[name] = [true, variance, got]
    spent = time.perf_counter() - begun
    unreliable = e.unreliable
    return {**line, "found": found, "unreliable": unreliable, "chosen": e.model, "seconds": spent}


def cases(args) -> Iterator[tuple[str, str, bool]]:
    """Yield every case asked for."""
    for wheel in [args.wheel] if args.wheel else TABLE_1:
        for kind in [args.voltage] if args.voltage else KINDS:
            for current in (True, False):
                yield wheel, kind, current


def run(args) -> list[dict]:
    """Return all lines, those of the file first, those still to do appended to it."""
    path = Path(args.lines) if args.lines else None
    lines = []
    if path and path.exists():
        lines = [json.loads(x) for x in path.read_text().splitlines() if x]
    mine = [x for x in lines if x["torque"] == args.torque and x["model"] == args.model]
    done = {(*x["case"], x["seed"]) for x in mine}
    wanted = set(cases(args))
    mine = [x for x in mine if x["seed"] < args.realisations and tuple(x["case"]) in wanted]
    for seed in range(args.realisations):
        for case in cases(args):
            if (*case, seed) in done:
                continue
            line = realisation(*case, seed, args)
            mine.append(line)
            if path:
                with path.open("a") as file:
                    file.write(json.dumps(line) + "\n")
        print(f"\r{seed + 1} of {args.realisations}", end="", flush=True)
    print()
    return mine


def judge(lines: list[dict]) -> tuple[dict[str, float], int, int, int]:
    """Return mean squared error over the bound by quantity; hits, intervals and silences."""
    ratios: dict[str, list[float]] = {}
    hits = intervals = silent = 0
    for line in lines:
        for name, (true, variance, got) in line.get("found", {}).items():
            if got is None:
                silent += 1
                continue
            value, _, low, high = got
            ratios.setdefault(name, []).append((value - true) ** 2 / variance)
            hits += low <= true <= high
            intervals += 1
    return {n: float(np.mean(x)) for n, x in ratios.items()}, hits, intervals, silent


def main() -> None:
    """Run all cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--realisations", type=int, default=100)
    parser.add_argument("--torque", type=float, default=0.0, help="torque noise [V]")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of a record")
    parser.add_argument("--wheel", choices=tuple(TABLE_1), help="only this one")
    parser.add_argument("--voltage", choices=KINDS, help="only this one")
    parser.add_argument("--model", choices=("known", "auto"), default="known")
    parser.add_argument("--lines", help="file of realisations, appended to")
    args = parser.parse_args()
    begun = time.perf_counter()
    lines = run(args)
    rows, inside, asked, above, total = [], 0, 0, 0, 0
    for case in cases(args):
        here = [x for x in lines if tuple(x["case"]) == case]
        mean, hits, tries, silent = judge(here)
        worst = max(mean, key=lambda n: mean[n])
        inside, asked = inside + hits, asked + tries
        limit = 1.5 if args.torque else 1.25
        above += sum(x > limit for x in mean.values())
        total += len(mean)
        rows.append(
            (case[0], case[1], "yes" if case[2] else "no", f"{np.mean(list(mean.values())):.2f}",
             f"{mean[worst]:.2f} ({worst})", f"{100 * hits / max(tries, 1):.1f} %",
             sum(x.get("unreliable", False) for x in here), silent,
             sum("refused" in x for x in here))
        )  # fmt: skip
    head = ("motor", "voltage", "current", "mean MSE/CRB", "worst quantity", "coverage",
            "unreliable", "no value", "refused")  # fmt: skip
    print(table(head, rows))
    spent = [x["seconds"] for x in lines if "seconds" in x]
    print(
        f"\n{args.realisations} realisations a case, torque noise {args.torque} V; {above} of "
        f"{total} quantities above {limit}; pooled coverage of the 95 % intervals "
        f"{100 * inside / max(asked, 1):.1f} % of {asked}; {1e3 * np.median(spent):.0f} ms an "
        f"estimate, {time.perf_counter() - begun:.0f} s in all"
    )


if __name__ == "__main__":
    main()
