# SPDX-License-Identifier: Apache-2.0
"""Identify recordings with the effects of real drives: right, named, refused, silently wrong.

An independent simulator (`world_motor`) records random motors with one of the effects of
`world_effects` in one of three strengths; every estimate is compared with the truth.  ``right``:
no number off by more than 5 of its standard deviations and 2 %, and nothing called unreliable;
``covered``: so because of the assumed systematic errors of instruments.
``cause``: called unreliable, with the effect named; ``other``: with another cause, or none.
``silent``: off by more than that and not called unreliable; ``warned`` where at least a warning
names the effect, or a note names every number that is off.

Usage: python benchmarks/world.py [--motors 3] [--seed S] [--effects NAME,...] [--processes 2]
       [--rich] [--list]
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parent)]

import numpy as np  # noqa: E402
from world_effects import EFFECTS, Case  # noqa: E402
from world_record import case, measure  # noqa: E402

FAR = 5.0  # standard deviations
SHARE = 0.02  # of the truth
OUTCOMES = ("right", "covered", "cause", "other", "refused", "warned", "silent", "crash")


def truth(c: Case) -> dict[str, tuple[float, float]]:
    """Return the lowest and highest right value of each number."""
    out = {}
    for name, value in c.motor.truth().items():
        low, high = c.widen.get(name, (1.0, 1.0))
        out[name] = (low * value, high * value)
    return out


def errors(estimate, c: Case, random: bool = False) -> dict[str, float]:
    """Return the error of each wrong number in ``random`` or total standard deviations."""
    wrong = {}
    true = truth(c)
    if not estimate.value("time_constant_product"):
        # A first-order answer may count L/R to the lag or to the delay.
        low, high = true["time_constant"]
        true["time_constant"] = (low - c.motor.L / c.motor.R, high)
    for name, q in {**estimate.combinations, **estimate.parameters}.items():
        if name not in true or q.value is None or q.std is None or q.status != "estimated":
            continue
        low, high = true[name]
        off = max(low - q.value, q.value - high, 0.0)
        std = q.std if random else q.total_std
        floor = SHARE * max(abs(low), abs(high))
        if name == "static_voltage":
            floor = max(floor, 0.005 * c.amplitude)
        if name == "coulomb_friction":
            floor = max(floor, 0.005 * c.amplitude * c.motor.K / c.motor.R)
        if name == "viscous_friction":
            floor = max(floor, SHARE * c.motor.K**2 / c.motor.R)
        if off > floor and off > FAR * std:
            wrong[name] = off / max(std, 1e-300)
    return wrong


def segments(time: np.ndarray) -> tuple[int, ...]:
    """Return where the record begins anew: after gaps, as a reader of bags says."""
    steps = np.diff(time)
    return (0, *(int(k) + 1 for k in np.flatnonzero(steps > 10 * np.mean(steps))))


def _speaks_of(finding, wrong: dict[str, float]) -> bool:
    """Return whether a finding warns, or names every number that is off."""
    named = str(finding.evidence.get("of_the_scale", "")).split(", ")
    return finding.severity == "warning" or (bool(wrong) and set(wrong) <= set(named))


def judge(job: tuple[int, int, int, bool]) -> tuple[int, str, str]:
    """Simulate and estimate one case; return effect, outcome and words."""
    number, level, seed, rich = job
    from smp_motor_ident.errors import SmpError
    from smp_motor_ident.estimate import estimate

    effect = EFFECTS[number]
    rng = np.random.default_rng(seed)
    c = case(effect, level, rng, rich)
    about = (
        f"{effect.name}[{level}] seed {seed}: {c.kind} {c.rate:g} Hz n {c.samples} {c.signals} "
        f"turn {c.turn:g} {'current ' if c.current else ''}tau {c.tau:.3g}"
    )
    try:
        e = estimate(recorded(c, rng))
    except SmpError as refusal:
        return number, "right" if effect.expect == "refuse" else "refused", f"{about}: {refusal}"
    except Exception:  # a benchmark wants to go on
        return number, "crash", f"{about}: {traceback.format_exc(limit=-3)}"
    wrong = errors(e, c)
    codes = [f.code for f in e.findings if f.severity == "unreliable"]
    words = ", ".join(f"{n} {x:.0f} std" for n, x in wrong.items()) or "fine"
    words = f"{about}: {e.model}; {words}; {codes or ''}"
    return number, outcome_of(e, effect, wrong, c), words


def outcome_of(e, effect, wrong: dict[str, float], c: Case) -> str:
    """Return the outcome of an estimate whose ``wrong`` numbers are known."""
    if e.unreliable:
        codes = {f.code for f in e.findings if f.severity == "unreliable"}
        return "cause" if codes & set(effect.causes) else "other"
    if wrong or effect.expect == "refuse":
        said = [f for f in e.findings if f.code in effect.causes and _speaks_of(f, wrong)]
        if said and not wrong:  # what should be refused was left out, and said
            return "right"
        return "warned" if said else "silent"
    return "covered" if errors(e, c, random=True) else "right"


def recorded(c: Case, rng: np.random.Generator):
    """Simulate a case; return its record."""
    from smp_motor_ident.record import Hardware, Record

    made = measure(c, rng)
    counted = c.signals.startswith("counts")
    return Record(
        "motor", **made, source="world", starts=segments(made["time"]),
        hardware=Hardware(c.motor.gear, c.turn if counted else None, 0, c.motor.supply, None),
    )  # fmt: skip


def table(judge: Callable[..., tuple[int, str, str]], outcomes: Sequence[str], about: str) -> None:
    """Judge the requested cases, and print the number of each outcome."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--motors", type=int, default=3, help="motors an effect")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--effects", default="")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--rich", action="store_true", help="only excitation that tells much")
    parser.add_argument("--list", action="store_true", help="print every case as it comes")
    args = parser.parse_args()
    seed = args.seed if args.seed is not None else int(time.time())
    words = [w.strip().lower() for w in args.effects.split(",") if w.strip()]
    chosen = [
        k for k, e in enumerate(EFFECTS) if not words or any(w in e.name.lower() for w in words)
    ]
    jobs = [
        (k, n % 3, seed * 1000 + 97 * k + n, args.rich) for k in chosen for n in range(args.motors)
    ]
    begin = time.time()
    counts: dict[int, Counter[str]] = {k: Counter() for k in chosen}
    with ProcessPoolExecutor(args.processes) as pool:
        for number, outcome, said in pool.map(judge, jobs, chunksize=1):
            counts[number][outcome] += 1
            if args.list:
                print(f"{outcome:9} {said}", flush=True)
    print(f"\nseed {seed}, {args.motors} motors an effect, {time.time() - begin:.0f} s\n")
    print("| effect | " + " | ".join(outcomes) + " |\n|" + " --- |" * (1 + len(outcomes)))
    total: Counter[str] = Counter()
    for k in chosen:
        total += counts[k]
        print(f"| {EFFECTS[k].name} | " + " | ".join(str(counts[k][o]) for o in outcomes) + " |")
    print("| all | " + " | ".join(str(total[o]) for o in outcomes) + " |")


if __name__ == "__main__":
    table(judge, OUTCOMES, __doc__)
