# SPDX-License-Identifier: Apache-2.0
"""Time of estimates against what people write today, on the same data in one run.

One fit: 60,000 samples from the chain that a search of 4,000 of them found, as `estimate` makes it,
against lfilter + least_squares.  `estimate` without initial values, of a motor without and with
friction, against every peer, which start from a motor of no particular size (`peers.GUESS`).  Wall
and processor time, one thread.  With ``--growth``: `identify` of CSV files up to ten million rows.

Usage: python benchmarks/speed.py [--samples 60000] [--peers lsq,control,casadi,...] [--friction]
       python benchmarks/speed.py --growth [--most 10000000]
Peers are optional: pip install -r benchmarks/requirements-peers.txt
"""

from __future__ import annotations

import os

for _library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import argparse  # noqa: E402
import importlib.util  # noqa: E402
import subprocess  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable  # noqa: E402
from dataclasses import dataclass  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402
import peers  # noqa: E402
from known_motors import ROOT, TABLE_1, recording, table  # noqa: E402

from smp_motor_control.motor.parameters import MotorParameters  # noqa: E402
from smp_motor_ident.estimate import estimate  # noqa: E402
from smp_motor_ident.fit.data import MIN_SEARCH_ROWS, prepare  # noqa: E402
from smp_motor_ident.fit.descend import evaluate_on_rows, fit  # noqa: E402
from smp_motor_ident.fit.search import search  # noqa: E402
from smp_motor_ident.record import Record  # noqa: E402

NOISE = 2.0  # rad/s
STATIC = 0.3  # V, where there is friction
GOALS = {"fit": 0.005, "estimate": 0.15}  # processor time [s]
FIT_GOAL = 6.0  # times as fast as lfilter + least_squares


@dataclass(frozen=True)
class Run:
    """Time and result of one program."""

    title: str
    wall: float
    processor: float
    built: float
    error: float
    cost: float


def shown(motor: MotorParameters, friction: bool) -> np.ndarray:
    """Return what voltage and speed tell: the response, and the friction where there is some."""
    response = np.log([motor.a0, motor.a1, motor.a2])
    return np.append(response, motor.static_voltage) if friction else response


def one_fit(record: Record, friction: bool) -> Callable[[], np.ndarray]:
    """Return the fit of all samples that begins at the chain that a part of them shows."""
    data = prepare([record], False)
    found = search(data.thin(MIN_SEARCH_ROWS))

    def call() -> np.ndarray:
        values = fit(data, evaluate_on_rows(data, found)).chain.values
        names = ("ln_a0", "ln_a1", "ln_a2", *(("vc",) if friction else ()))
        return np.array([values[n] for n in names])

    return call


def whole(record: Record, friction: bool) -> np.ndarray:
    """Return the same by `estimate`: screening, search, intervals and validation included."""
    e = estimate(record)
    gain, tau, product = (e.value(n) for n in ("dc_gain", "time_constant", "time_constant_product"))
    x = np.log([1 / gain, tau / gain, product / gain])
    return np.append(x, e.value("static_voltage")) if friction else x


def measured(call: Callable[[], np.ndarray], repeats: int) -> tuple[float, float, np.ndarray]:
    """Return the shortest wall and processor times (of all threads), and the answer."""
    wall, processor = [], []
    for _ in range(repeats):
        built = tuple(peers.set_up)
        begun, spent = time.perf_counter(), time.process_time()
        answer = call()
        wall.append(time.perf_counter() - begun - (peers.set_up[0] - built[0]))
        processor.append(time.process_time() - spent - (peers.set_up[1] - built[1]))
    return min(wall), min(processor), answer


def noisy(samples: int, friction: bool, coarse: int = 0) -> tuple[Record, np.ndarray]:
    """Return voltage and noisy speed of Table 1's fourth motor at 1 kHz, and the truth."""
    made, motor = recording(
        TABLE_1["rear_right"],
        current=False,
        seconds=samples / 1000,
        rate=1000.0,
        counts=False,
        coarse=coarse,
        static_voltage=STATIC if friction else 0.0,
    )
    speed = made.velocity + NOISE * np.random.default_rng(0).standard_normal(len(made))
    truth = shown(motor, friction)
    return Record("motor", made.time, made.voltage, velocity=speed), truth


def compare(samples: int, wanted: list[str], friction: bool, repeats: int) -> None:
    """Run everybody and print the table."""
    record, truth = noisy(samples, friction)
    runs: list[Run] = []

    def add(title: str, call: Callable[[], np.ndarray], times: int) -> None:
        before = peers.set_up[0]
        wall, processor, x = measured(call, times)
        built = peers.set_up[0] - before
        error = float(np.abs(x[:3] - truth[:3]).max()) if np.all(np.isfinite(x)) else np.nan
        runs.append(Run(title, wall, processor, built, error, peers.cost(record, x)))
        r = runs[-1]
        print(f"{title}: {r.wall:.4f} s, {r.processor:.4f} s of processor", flush=True)

    fit = one_fit(record, friction)
    fit()
    add("this project: one fit", fit, repeats)
    whole(record, friction)
    add("this project: estimate()", lambda: whole(record, friction), 3)
    for name in wanted:
        peer = peers.PEERS[name]
        if peer.friction != friction:
            continue
        if importlib.util.find_spec(peer.module) is None:
            print(f"{peer.title}: {peer.module} is not installed, left out")
            continue
        add(peer.title, lambda peer=peer: peer.fit(record), 3 if peer.quick else 1)
    report(runs, samples, friction)


def report(runs: list[Run], samples: int, friction: bool) -> None:
    """Print the table and the goals."""
    fit, ours = runs[:2]
    best = min(r.cost for r in runs if np.isfinite(r.cost))
    rows = [
        (r.title, f"{r.wall:.4f}", f"{r.processor:.4f}", f"{r.built:.1f}" if r.built else "",
         f"{r.processor / fit.processor:.1f}", f"{r.processor / ours.processor:.1f}",
         f"{r.error:.1e}", f"{(r.cost - best) / NOISE**2:.1f}")
        for r in runs
    ]  # fmt: skip
    head = ("program", "wall s", "processor s", "building s", "times one fit", "times estimate()",
            "error of ln a", "squares above the least, of the noise")  # fmt: skip
    print("\n" + table(head, rows) + "\n")
    for run, goal in zip((fit, ours), GOALS.values()):
        verdict = "reached" if run.processor <= goal else "NOT reached"
        print(f"{run.title}: {run.processor:.4f} s of processor, goal {goal} s: {verdict}")
    for r in runs[2:]:
        # Of wall and processor time the less favourable: the machine may be shared.
        ratio = min(r.wall / fit.wall, r.processor / fit.processor)
        if r.title == peers.PEERS["lsq"].title and not friction:
            verdict = "reached" if ratio >= FIT_GOAL else "NOT reached"
            print(f"{r.title}: {ratio:.1f} times one fit, goal {FIT_GOAL:g}: {verdict}")
    what = f"with {STATIC} V of Coulomb friction" if friction else "linear"
    print(f"\n{samples} samples, {what}; peers start from a0, a1, a2 = {peers.GUESS}")


def growth(most: int) -> None:
    """Print time and memory of `identify` against the rows of a CSV file."""
    rows = []
    for n in (10_000, 100_000, 1_000_000, 10_000_000):
        if n > most:
            break
        made, _ = noisy(n, True, coarse=4)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "log.csv"
            with file.open("w") as text:
                text.write("time,voltage,velocity\n")
                np.savetxt(text, np.column_stack([made.time, made.voltage, made.velocity]),
                           fmt=("%.3f", "%.4f", "%.3f"), delimiter=",")  # fmt: skip
            size = file.stat().st_size / 2**20
            del made
            code = "import sys; from smp_motor_ident.cli.identify import main; sys.exit(main())"
            command = [sys.executable, "-c", code, str(file), "-o", f"{folder}/result", "--quiet",
                       "--map", "time=time", "voltage=voltage", "velocity=velocity"]  # fmt: skip
            begun = time.perf_counter()
            process = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": _path()})
            _, status, used = os.wait4(process.pid, 0)
            wall = time.perf_counter() - begun
        spent = used.ru_utime + used.ru_stime
        rows.append(
            (
                n,
                f"{size:.0f} MiB",
                f"{wall:.1f}",
                f"{spent:.1f}",
                f"{used.ru_maxrss / 2**20:.2f} GiB",
                os.waitstatus_to_exitcode(status),
            )
        )
        print(*rows[-1], flush=True)
    head = ("rows", "file", "wall s", "processor s", "memory at most", "exit code")
    print("\n" + table(head, rows))
    print("\ngoals: a million rows in 10 s, ten million in 60 s of processor and 3 GB")


def _path() -> str:
    return os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])


def main() -> None:
    """Run the comparison, or the growth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=60_000)
    usual = ",".join(name for name in peers.PEERS if name != "virtual")  # it takes minutes
    parser.add_argument("--peers", default=usual, help=f"of {', '.join(peers.PEERS)}")
    parser.add_argument("--friction", action="store_true", help="only the motor with friction")
    parser.add_argument("--linear", action="store_true", help="only the linear motor")
    parser.add_argument("--repeats", type=int, default=9, help="of this project's fit")
    parser.add_argument("--growth", action="store_true", help="of CSV files, to 10 million rows")
    parser.add_argument("--most", type=int, default=10_000_000, help="rows of the growth")
    args = parser.parse_args()
    if args.growth:
        growth(args.most)
        return
    for friction in (False, True):
        if (friction and not args.linear) or (not friction and not args.friction):
            with tempfile.TemporaryDirectory() as folder:
                os.chdir(folder)  # CasADi leaves the code that it compiles where it is
                compare(args.samples, args.peers.split(","), friction, args.repeats)
                os.chdir("/")


if __name__ == "__main__":
    main()
