# SPDX-License-Identifier: Apache-2.0
"""Outcomes of a fixed set of records, kept in ``frozen.json``, against those of today's code.

The set is `world` (every effect in every strength) and clean records of `world` (``baseline``), all
with fixed seeds.  Each record keeps its outcome, its numbers with their deviations, its processor
time and how many messages it has.

Usage: python benchmarks/frozen.py [--update] [--processes 2] [--effects NAME,...] [--clean 60]
       [--world 2] [--seed 0] [--output FILE] [--list]

``--update`` writes ``frozen.json``; otherwise what changed is printed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import world
from world_effects import EFFECTS
from world_record import case

Job = tuple[int, int, int]
KEPT = Path(__file__).with_name("frozen.json")
GOOD = ("right", "covered")
WRONG = ("silent", "warned", "crash")
MOVED = 0.2  # deviations by which a number that changed has moved
SHARP = 0.05  # relative random standard deviation of a sharp number, times 2


def jobs(words: Sequence[str] = (), each: int = 2, clean: int = 60, seed: int = 0) -> list[Job]:
    """Return effect, strength and seed of every record of the set."""
    base = 1_000_003 * seed
    out = [
        (k, level, base + 1000 * k + 10 * n + level)
        for n in range(each)
        for k, e in enumerate(EFFECTS)
        for level in range(3)
        if k and (not words or any(w in e.name.lower() for w in words))
    ]
    if not words or "baseline" in words:
        out += [(0, n % 3, base + 500_000 + n) for n in range(clean)]
    return out


def identify(
    job: Job, progress: Callable[[str], None] | None = None
) -> tuple[str, dict[str, object]]:
    """Estimate one record of the set; return its key and the stored values."""
    from smp_motor_ident.errors import SmpError
    from smp_motor_ident.estimate import estimate

    number, level, seed = job
    effect = EFFECTS[number]
    rng = np.random.default_rng(seed)
    c = case(effect, level, rng)
    record = world.recorded(c, rng)
    key = f"{effect.name}/{level}/{seed}"
    about = f"{c.kind} {c.rate:g}Hz n{c.samples} {c.signals}{' current' if c.current else ''}"
    begin = time.process_time()
    try:
        e = estimate(record, progress=progress)
    except SmpError as refusal:
        outcome = "right" if effect.expect == "refuse" else "refused"
        return key, _row(outcome, about, begin, message=str(refusal)[:200])
    except Exception as error:  # a benchmark goes on
        return key, _row("crash", about, begin, message=f"{type(error).__name__}: {error}"[:200])
    wrong = world.errors(e, c)
    outcome = world.outcome_of(e, effect, wrong, c)
    truth = world.truth(c)
    numbers = {}
    for name, q in {**e.combinations, **e.parameters}.items():
        if name in truth and q.value is not None and q.std:
            low, high = truth[name]
            off = q.value - min(max(q.value, low), high)
            size = max(abs(low), abs(high)) or 1.0
            numbers[name] = [round(x, 6) for x in (off / size, q.std / size, q.total_std / size)]
    return key, _row(
        outcome, about, begin, numbers=numbers, wrong=sorted(wrong), model=e.model,
        codes=sorted(f"{f.severity[0]}:{f.code}" for f in e.findings),
    )  # fmt: skip


def _row(outcome: str, about: str, begin: float, **more: object) -> dict[str, object]:
    return {
        "outcome": outcome,
        "about": about,
        "cpu": round(time.process_time() - begin, 3),
        **more,
    }


def summary(rows: dict[str, dict]) -> str:
    """Return the figures of a set of outcomes as lines of text."""
    lines = []
    clean = {k: r for k, r in rows.items() if k.startswith("baseline/")}
    effects = {k: r for k, r in rows.items() if k not in clean}
    for title, part in (("clean", clean), ("effects", effects)):
        if not part:
            continue
        n = len(part)
        counts = Counter(r["outcome"] for r in part.values())
        cpu = np.array([r["cpu"] for r in part.values()])
        notes = [len(r.get("codes", ())) for r in part.values()]
        sharp = sum(is_sharp(r) for r in part.values())
        lines.append(
            f"{title}: {n} records; "
            + ", ".join(f"{k} {v}" for k, v in counts.most_common())
            + f"; right or covered {100 * sum(counts[k] for k in GOOD) / n:.1f} %, wrong "
            f"{100 * sum(counts[k] for k in WRONG) / n:.1f} %, right and within 5 % "
            f"{100 * sharp / n:.0f} %"
        )
        lines.append(
            f"  processor time: median {np.median(cpu):.2f} s, 95 % {np.quantile(cpu, 0.95):.1f} "
            f"s, longest {cpu.max():.1f} s, sum {cpu.sum():.0f} s; findings {np.mean(notes):.1f}"
        )
        for name in ("dc_gain", "time_constant", "static_voltage", "resistance", "inductance",
                     "motor_constant", "inertia"):  # fmt: skip
            z = [r["numbers"][name][0] / r["numbers"][name][1] for r in part.values()
                 if name in r.get("numbers", {}) and r["numbers"][name][1] > 0]  # fmt: skip
            std = [r["numbers"][name][1] for r in part.values() if name in r.get("numbers", {})]
            if z:
                z = np.abs(z)
                lines.append(
                    f"  {name:16} {len(z):4}: |error|/std median {np.median(z):.2f}, within 1.96 "
                    f"{100 * np.mean(z < 1.96):.0f} %; std median {100 * np.median(std):.3f} %"
                )
    return "\n".join(lines)


def is_sharp(row: dict) -> bool:
    """Tell whether gain and time constant are right and stated to 5 % (random)."""
    numbers = row.get("numbers", {})
    both = [numbers.get(name) for name in ("dc_gain", "time_constant")]
    return row["outcome"] in GOOD and all(b and 1.96 * b[1] < SHARP for b in both)


def rank(row: dict) -> tuple[int, bool]:
    """Return how good an outcome is, 0 being best."""
    kind = 2 if row["outcome"] in WRONG else int(row["outcome"] not in GOOD)
    return kind, not is_sharp(row)


def differs(one: dict, other: dict) -> bool:
    """Tell whether outcome or numbers are others."""
    a, b = one.get("numbers", {}), other.get("numbers", {})
    moved = (max(abs(x[k] - b[n][k]) for k in (0, 1)) > MOVED * x[1] for n, x in a.items())
    return one["outcome"] != other["outcome"] or set(a) != set(b) or any(moved)


def compare(before: dict[str, dict], now: dict[str, dict]) -> str:
    """Return the records whose outcome changed."""
    lines = []
    for key, row in now.items():
        old = before.get(key)
        if old and old["outcome"] != row["outcome"]:
            detail = row.get("wrong") or row.get("message") or ""
            lines.append(
                f"{old['outcome']:>8} -> {row['outcome']:8} {key} ({row['about']}) {detail}"
            )
    return "\n".join(lines)


def main() -> None:
    """Run the set and print or keep what came out."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--update", action="store_true")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--effects", default="")
    parser.add_argument("--clean", type=int, default=60, help="clean records")
    parser.add_argument("--world", type=int, default=2, help="records an effect and strength")
    parser.add_argument("--seed", type=int, default=0, help="another set")
    parser.add_argument("--output", type=Path, help="keep the outcomes in this file")
    parser.add_argument("--list", action="store_true")
    args = parser.parse_args()
    words = [w.strip().lower() for w in args.effects.split(",") if w.strip()]
    rows: dict[str, dict] = {}
    with ProcessPoolExecutor(args.processes) as pool:
        for key, row in pool.map(identify, jobs(words, args.world, args.clean, args.seed)):
            rows[key] = row
            if args.list:
                print(f"{row['outcome']:8} {row['cpu']:6.1f} s {key} {row['about']} "
                      f"{row.get('wrong') or row.get('message') or ''}", flush=True)  # fmt: skip
    target = KEPT if args.update else args.output
    if target:
        lines = (f"{json.dumps(k)}: {json.dumps(r)}" for k, r in rows.items())
        target.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    print(summary(rows))
    if KEPT.exists() and not args.update:
        before = json.loads(KEPT.read_text())
        print("\nkept outcomes of the same records:")
        print(summary({k: before[k] for k in rows if k in before}))
        print("\nchanged:")
        print(compare(before, rows))


if __name__ == "__main__":
    sys.exit(main())
