# SPDX-License-Identifier: Apache-2.0
"""Run every accuracy table in a short form, and compare it with the baseline.

    python benchmarks/accuracy.py [--table NAME ...] [--write]

A table is reduced to counts (``k`` of ``n``), to lists of squared errors over their bound, and to
plain figures.  Worse is a count where Fisher's exact test rejects "as before or better", a list
where the one-sided test of Mann and Whitney does (both at 1 % over all comparisons together,
Bonferroni), and a plain figure, which has no chance in it, that is more than a tenth worse.
``--write`` makes this run the baseline.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

import bad_data
import cold_start
import efficiency
import honesty
import numpy as np
import observer
import together
import tuning
from scipy import stats

BASELINE = Path(__file__).with_name("accuracy_baseline.json")
SIZE = 0.01  # of the whole comparison: the chance that an equally good version is called worse
DETERMINISTIC = 0.10  # relative tolerance of a deterministic figure

Figures = dict[str, dict]


def count(good: int, of: int) -> dict:
    return {"good": int(good), "of": int(of)}


def efficiency_table() -> Figures:
    lines = efficiency.run(
        Namespace(realisations=8, torque=0.0, seconds=10.0, wheel=None, voltage=None,
                  model="known", lines=None)
    )  # fmt: skip
    return efficiency_figures(lines)


def efficiency_figures(lines: list[dict]) -> Figures:
    squares, hits, total = [], 0, 0
    for line in lines:
        for true, variance, got in line.get("found", {}).values():
            total += 1
            if got is not None:
                squares.append(round((got[0] - true) ** 2 / variance, 4))
                hits += got[2] <= true <= got[3]
    return {
        "squared error over the Cramer-Rao bound": {"squares": squares},
        "intervals that cover": count(hits, total),
        "records answered": count(sum("found" in x for x in lines), len(lines)),
    }


def cold_start_table() -> Figures:
    return cold_start_figures(
        cold_start.run(Namespace(motors=30, seconds=6.0, rate=1000.0, lines=None))
    )


def cold_start_figures(lines: list[dict]) -> Figures:
    figures = {}
    for case in cold_start.CASES:
        here = [x for x in lines if x["case"] == case]
        figures[f"right minimum: {case}"] = count(sum(x["right"] for x in here), len(here))
    wrong = sum(x["says"] == "sure" and x["sigmas"] > cold_start.FAR for x in lines)
    figures["not wrong silently"] = count(len(lines) - wrong, len(lines))
    return figures


def honesty_table() -> Figures:
    lines = list(honesty.run())
    return {"as theory says": count(sum(x["fine"] for x in lines), len(lines))}


def bad_data_table() -> Figures:
    return bad_data_figures(list(bad_data.run(Namespace(sound=60, records=4))))


def bad_data_figures(lines: list[dict]) -> Figures:
    faults = [x for x in lines if x["fault"] != "none"]
    sound = [x for x in lines if x["fault"] == "none"]
    named = sum(x["says"] in ("named", "right") for x in faults)
    return {
        "faults named, or answered rightly": count(named, len(faults)),
        "faults not wrong silently": count(sum(x["says"] != "wrong" for x in faults), len(faults)),
        "sound records right": count(sum(x["says"] == "right" for x in sound), len(sound)),
        "sound records not wrong silently": count(
            sum(x["says"] != "wrong" for x in sound), len(sound)
        ),
    }


def tuning_table() -> Figures:
    motors = [*tuning.TABLE_1.values(), *tuning.random_motors(10)]
    outcomes = [
        o
        for motor in motors
        for rate in (100.0, 1000.0)
        for o in tuning.check((motor, rate, list(tuning.METHODS)))
    ]
    return tuning_figures([vars(o) for o in outcomes])


def tuning_figures(outcomes: list[dict]) -> Figures:
    done = [o for o in outcomes if o["designed"]]
    held = ("stable", "gain_margin", "delay_margin", "required", "draws_stable")
    best = [o for o in done if o["method"] == tuning.RECOMMENDED]
    return {
        "designed": count(len(done), len(outcomes)),
        "as specified": count(sum(all(o[n] for n in held) for o in done), len(done)),
        "settling of the recommended method [s]": {
            "figure": float(np.nanmedian([o["settling"] for o in best]))
        },
    }


def together_table() -> Figures:
    spread = []
    for rate in (100.0, 200.0, 1000.0):
        for draw in range(2):
            found = together.identify_recorded(together.ENTRIES, min(rate, 200.0), draw)
            runs = together.compare(together.ENTRIES, found, rate, draw)
            times = list(together.assess(runs["together"]).settling.values())
            spread.append(1e3 * (max(times) - min(times)))
    return together_figures(spread)


def together_figures(spread: list[float]) -> Figures:
    return {"wheels that settle within 5 ms of each other": count(
        sum(s <= 5.0 for s in spread), len(spread)
    )}  # fmt: skip


def observer_table() -> Figures:
    figures = {}
    motors = together.ENTRIES.items()
    for rate in (200.0, 1000.0):
        ratios = []
        for seed, (_, entry) in enumerate(motors):
            plain, observed = (observer.run(entry, rate, way, 4.0, seed) for way in (False, True))
            ratios += [observed.speed / plain.speed, observed.voltage / plain.voltage]
        figures[f"observer's noise over that of differences, {rate:g} Hz"] = {"figure": max(ratios)}
    return figures


TABLES: dict[str, Callable[[], Figures]] = {
    "efficiency": efficiency_table,
    "cold start": cold_start_table,
    "honesty": honesty_table,
    "bad data": bad_data_table,
    "tuning": tuning_table,
    "together": together_table,
    "observer": observer_table,
}


def compared(before: dict, now: dict, size: float) -> tuple[str, str, bool]:
    """Return both figures in words, and whether the new one is worse beyond chance."""
    if "good" in now:
        bad = [
            [now["good"], now["of"] - now["good"]],
            [before["good"], before["of"] - before["good"]],
        ]
        p = stats.fisher_exact(bad, alternative="less")[1]
        return (f"{before['good']} of {before['of']}", f"{now['good']} of {now['of']}", p < size)
    if "squares" in now:
        p = stats.mannwhitneyu(now["squares"], before["squares"], alternative="greater")[1]
        words = (f"mean {np.mean(x['squares']):.3f} of {len(x['squares'])}" for x in (before, now))
        return (*words, p < size)
    worse = now["figure"] > before["figure"] * (1 + DETERMINISTIC)
    return f"{before['figure']:.4g}", f"{now['figure']:.4g}", worse


def main() -> int:
    """Run the tables and compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--table", nargs="*", choices=list(TABLES), help="only these")
    parser.add_argument("--write", action="store_true", help="make this run the baseline")
    args = parser.parse_args()
    before = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    found = {}
    for name in args.table or TABLES:
        begun = time.perf_counter()
        found[name] = TABLES[name]()
        print(f"{name}: {time.perf_counter() - begun:.0f} s", file=sys.stderr)
    if args.write:
        BASELINE.write_text(json.dumps({**before, **found}, indent=1) + "\n")
        return 0
    rows = [(name, key) for name in found for key in found[name] if key in before.get(name, {})]
    worse = 0
    for name, key in rows:
        old, new, bad = compared(before[name][key], found[name][key], SIZE / len(rows))
        worse += bad
        print(f"{name:11} {key:55} {old:>20} {new:>20}  {'WORSE' if bad else 'holds'}")
    print(f"{worse} of {len(rows)} worse than before, beyond chance of {100 * SIZE:.0f} %")
    return int(worse > 0)


if __name__ == "__main__":
    sys.exit(main())
