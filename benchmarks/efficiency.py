# SPDX-License-Identifier: Apache-2.0
"""Mean squared error over the Cramer-Rao bound, and coverage of the 95 % intervals.

Every realisation is one line of a file, so an interrupted run can be resumed:

    python benchmarks/efficiency.py [--realisations 100] [--torque 0.3] [--lines FILE.jsonl]
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from known_motors import (
    CURRENT_NOISE,
    QUANTUM,
    TABLE_1,
    independent,
    recording,
    substeps,
    table,
)
from scipy.linalg import solve_triangular, toeplitz

from smp_motor_control.motor.parameters import PHYSICAL, MotorParameters
from smp_motor_ident.errors import SmpError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Record

COMBINATIONS = ("dc_gain", "time_constant", "time_constant_product")
KINDS = ("sine", "square", "fourier", "plain square")
TELLS = 0.3  # a quantity is identifiable where the bound's std is below this part of it
VARIED = 1e-4  # relative, for a derivative


def covariance(
    record: Record, motor: MotorParameters, names: tuple[str, ...], torque: float = 0.0
) -> np.ndarray:
    """Return the Cramer-Rao bound of the logarithms of parameters, the others being known.

    Derivatives are differences between runs of the independent simulator.  Quantisation is taken
    for white noise; the angle at which the encoder begins is free.  ``torque``: standard deviation
    of a load that is held for a sample, as a voltage [V].

    Raises
    ------
    LinAlgError
        Where the parameters are not identifiable.
    """
    noise = QUANTUM / np.sqrt(12)

    def shown(changed: MotorParameters) -> np.ndarray:
        out = simulated(changed, record.time, record.voltage)
        angle, current = out[:, 2] / noise, out[:, 0] / CURRENT_NOISE
        return angle if record.current is None else np.concatenate([angle, current])

    def varied(name: str, factor: float) -> MotorParameters:
        return replace(motor, **{name: factor * getattr(motor, name)})

    each = [(shown(varied(n, 1 + VARIED)) - shown(varied(n, 1 - VARIED))) / (2 * VARIED)
            for n in names]  # fmt: skip
    begin = np.zeros_like(each[0])
    begin[: len(record)] = 1.0
    columns = np.column_stack([*each, begin])
    if torque > 0:
        columns = whitened(columns, record, motor, torque)
    scale = np.linalg.norm(columns, axis=0)
    triangle = np.linalg.qr(columns / scale, mode="r")
    inverse = np.linalg.inv(triangle) / scale[:, None]
    return (inverse @ inverse.T)[:-1, :-1]


def whitened(
    columns: np.ndarray, record: Record, motor: MotorParameters, torque: float
) -> np.ndarray:
    """Return columns divided by the root of the covariance of noise and load."""
    n = len(record)
    push = np.zeros(n)
    push[1] = torque * motor.motor_constant / motor.resistance
    free = replace(motor, coulomb_friction=0.0)  # it slides nearly always
    answer = simulated(free, record.time, np.zeros(n), push)
    outputs = [answer[:, 2] / (QUANTUM / np.sqrt(12)), answer[:, 0] / CURRENT_NOISE]
    outputs = outputs[: len(columns) // n]
    moved = np.concatenate([toeplitz(np.append(x[1:], 0.0), np.zeros(n)) for x in outputs])
    root = np.linalg.cholesky(np.eye(len(columns)) + moved @ moved.T)
    return solve_triangular(root, columns, lower=True)


def simulated(
    motor: MotorParameters, time: np.ndarray, voltage: np.ndarray, load: np.ndarray | None = None
) -> np.ndarray:
    """Return current, speed and angle by the simulator that recorded."""
    values = [getattr(motor, n) for n in PHYSICAL]
    nothing = np.zeros(time.size) if load is None else load
    return independent.simulate(time, voltage, *values, nothing, substeps(motor, time[1] - time[0]))


def bound(record: Record, motor: MotorParameters, torque: float) -> dict[str, tuple[float, float]]:
    """Return the truth and the Cramer-Rao variance of every quantity, at the truth."""
    # Voltage and speed leave one direction open, which R is taken for.
    names = PHYSICAL if record.current is not None else PHYSICAL[1:]
    cov = covariance(record, motor, names, torque)
    out = {}
    for quantity in (*COMBINATIONS, *(PHYSICAL[:5] if record.current is not None else ())):
        true = getattr(motor, quantity)
        gradient = np.array([
            (getattr(replace(motor, **{n: (1 + VARIED) * getattr(motor, n)}), quantity) - true)
            / VARIED
            for n in names
        ])  # fmt: skip
        out[quantity] = true, float(gradient @ cov @ gradient)
    return out


def realisation(wheel: str, kind: str, current: bool, seed: int, args) -> dict:
    """Return one estimate with truth and bound, as a line of the file."""
    record, motor = recording(
        TABLE_1[wheel], kind, current=current, seed=seed, seconds=args.seconds,
        torque_noise=args.torque, static_voltage=0.3,
    )  # fmt: skip
    limits = bound(record, motor, args.torque)
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
    """Return all lines: those of the file, then new ones, which are appended to it."""
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
