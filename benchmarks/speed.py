"""Cold estimation of one motor against what people write today, on the same data in one run.

Every program starts from the same guess, a motor of no particular size (`GUESS`); this
project takes none.  Wall and processor time, one thread.

Usage: python benchmarks/speed.py [--samples 60000] [--peers lsq,control,casadi,...] [--friction]
       python benchmarks/speed.py --growth
Peers are optional: pip install -r benchmarks/requirements-peers.txt
"""

from __future__ import annotations

import os

for _library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import argparse  # noqa: E402
import importlib.util  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable  # noqa: E402
from dataclasses import dataclass  # noqa: E402

import numpy as np  # noqa: E402
import peers  # noqa: E402
from growth import growth  # noqa: E402
from known_motors import TABLE_1, recording, table  # noqa: E402

from smp_motor_ident.estimate import estimate  # noqa: E402
from smp_motor_ident.estimation.fit import Options  # noqa: E402
from smp_motor_ident.estimation.initialisation import initial_fit  # noqa: E402
from smp_motor_ident.likelihood.experiments import prepare  # noqa: E402
from smp_motor_ident.model.coordinates import Coordinates  # noqa: E402
from smp_motor_ident.model.structures import SecondOrder  # noqa: E402
from smp_motor_ident.record import Record  # noqa: E402

NOISE = 2.0  # rad/s
STATIC = 0.3  # V, where there is friction


@dataclass(frozen=True)
class Run:
    """What one program took and found."""

    title: str
    wall: float
    processor: float
    built: float
    error: float
    cost: float


def shown(z: Coordinates, friction: bool) -> np.ndarray:
    """Return what voltage and speed tell: the response, and the friction where there is some."""
    return np.array([z.ln_a0, z.ln_a1, z.ln_a2, *([z.vc_plus] if friction else [])])


def ours(record: Record, friction: bool) -> np.ndarray:
    """Return the coordinates from cold: the fit alone."""
    kind = "symmetric" if friction else "none"
    fit = initial_fit(prepare([record], False), SecondOrder(friction=kind), Options())
    return shown(fit.z, friction)


def whole(record: Record, friction: bool, model: str = "second_order") -> np.ndarray:
    """Return the same from `estimate`: screening, choice, intervals, validation included."""
    e = estimate(record, model)
    gain, tau, product = (e.value(n) for n in ("dc_gain", "time_constant", "time_constant_product"))
    z = np.log([1 / gain, tau / gain, product / gain])
    return np.append(z, e.value("static_voltage")) if friction else z


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


def noisy(samples: int, friction: bool) -> tuple[Record, np.ndarray]:
    """Return voltage and noisy speed of Table 1's fourth motor at 1 kHz, and the truth."""
    made, z = recording(
        TABLE_1["rear_right"],
        current=False,
        seconds=samples / 1000,
        rate=1000.0,
        counts=False,
        static_voltage=STATIC if friction else 0.0,
    )
    speed = made.velocity + NOISE * np.random.default_rng(0).standard_normal(len(made))
    truth = shown(z, friction)
    return Record("motor", made.time, made.voltage, velocity=speed), truth


def compare(samples: int, wanted: list[str], friction: bool, repeats: int) -> None:
    """Run everybody and print the table."""
    record, truth = noisy(samples, friction)
    begun = time.perf_counter()
    ours(record, friction)
    first = time.perf_counter() - begun
    runs: list[Run] = []

    def add(title: str, call: Callable[[], np.ndarray], times: int) -> None:
        before = peers.set_up[0]
        wall, processor, x = measured(call, times)
        built = peers.set_up[0] - before
        error = float(np.abs(x[:3] - truth[:3]).max()) if np.all(np.isfinite(x)) else np.nan
        runs.append(Run(title, wall, processor, built, error, peers.cost(record, x)))
        r = runs[-1]
        print(f"{title}: {r.wall:.4f} s, {r.processor:.4f} s of processor", flush=True)

    add("this project: the fit", lambda: ours(record, friction), repeats)
    whole(record, friction)
    add("this project: estimate(), second_order", lambda: whole(record, friction), 3)
    whole(record, friction, "auto")
    add("this project: estimate(), auto", lambda: whole(record, friction, "auto"), 3)
    for name in wanted:
        peer = peers.PEERS[name]
        if peer.friction != friction:
            continue
        if importlib.util.find_spec(peer.module) is None:
            print(f"{peer.title}: {peer.module} is not installed, left out")
            continue
        add(peer.title, lambda peer=peer: peer.fit(record), 3 if peer.quick else 1)
    report(runs, samples, first, friction)


def report(runs: list[Run], samples: int, first: float, friction: bool) -> None:
    """Print the table and the goals."""
    base, best = runs[0], min(r.cost for r in runs if np.isfinite(r.cost))
    rows = []
    for r in runs:
        excess = r.cost / best - 1  # in variances of the noise: times the samples
        reached = "yes" if excess * samples < 1 else f"no ({100 * excess:.2g} % above)"
        reached = "no" if not np.isfinite(r.cost) else reached
        if friction and "estimate()" in r.title:
            reached = "of a model with L/R free"  # which friction makes felt
        rows.append(
            (
                r.title,
                f"{r.wall:.4f}",
                f"{r.processor:.4f}",
                f"{r.built:.1f}" if r.built else "",
                f"{r.wall / base.wall:.0f}",
                f"{r.processor / base.processor:.0f}",
                "-" if np.isnan(r.error) else f"{r.error:.1e}",
                reached,
            )
        )
    head = ("program", "wall s", "processor s", "building s", "times ours (wall)", "(processor)",
            "error of ln a", "least squares reached")  # fmt: skip
    print("\n" + table(head, rows) + "\n")
    goals = {p.title: p.goal for p in peers.PEERS.values() if p.goal and p.friction == friction}
    for r in runs:
        if r.title in goals:
            # Of wall and processor time the less favourable: the machine may be shared.
            ratio = min(r.wall / base.wall, r.processor / base.processor)
            goal = goals[r.title]
            verdict = "reached" if ratio >= goal else "NOT reached"
            print(f"{r.title}: {ratio:.0f} times, goal {goal}: {verdict}")
    what = f"with {STATIC} V of Coulomb friction" if friction else "linear"
    print(
        f"\n{samples} samples, {what}; peers start from a0, a1, a2 = {peers.GUESS}; first call of "
        f"this project {first:.2f} s with compilation or its cache"
    )


def main() -> None:
    """Run the comparison, or the growth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=60_000)
    usual = ",".join(name for name in peers.PEERS if name != "virtual")  # it takes minutes
    parser.add_argument("--peers", default=usual, help=f"of {', '.join(peers.PEERS)}")
    parser.add_argument("--friction", action="store_true", help="only the motor with friction")
    parser.add_argument("--linear", action="store_true", help="only the linear motor")
    parser.add_argument("--repeats", type=int, default=9, help="of this project's fit")
    parser.add_argument("--growth", action="store_true", help="time and memory to 10 million")
    parser.add_argument("--most", type=int, default=10_000_000, help="samples of the growth")
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
