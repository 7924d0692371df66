# SPDX-License-Identifier: Apache-2.0
"""Identify motors through known firmware loops, from set-points and speeds.

    python benchmarks/known_loops.py                     # 20 random motors a loop
    python benchmarks/known_loops.py --motors 5 --seed 7

The loops' laws are those of benchmarks/exports.py, written from the targets' documentation.
Printed for each loop: how many were identified or refused, the root mean square of error over
stated deviation, and how many 95 % intervals hold the truth.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "test"), str(ROOT / "test" / "ident")]

import exports  # noqa: E402
import test_known_loop as loops  # noqa: E402

from smp_motor_ident.errors import SmpError  # noqa: E402
from smp_motor_ident.estimate import estimate  # noqa: E402
from smp_motor_ident.tune.exports import FORMATS  # noqa: E402
from smp_motor_ident.tune.known_loop import reconstruct  # noqa: E402

LAWS = exports.LAWS, exports.RATIO, exports.COUNTS


def one(name: str, gain: float, lag: float, seed: int) -> list[float]:
    """Return the errors of a motor over their stated deviations; raises where it is refused."""
    loops.GAIN, loops.LAG = gain, lag
    when, setpoints, speed, _ = loops.drive(LAWS, name, seed=seed)
    record = loops.record(LAWS, when, setpoints, speed)
    result = estimate(reconstruct(record, FORMATS[name].known, loops.given(name)))
    # An answer of one lag counts the winding's to the lag or to the delay.
    lowest = lag + loops.FAST if result.value("time_constant_product") else lag
    truth = {"dc_gain": (gain, gain), "time_constant": (lowest, lag + loops.FAST)}
    stated = {key: result.combinations[key] for key in truth if key in result.combinations}
    if any(f.severity in ("unreliable", "refused") for f in result.findings):
        raise SmpError("unreliable")
    return [float(q.value - np.clip(q.value, *truth[key])) / q.std
            for key, q in stated.items() if q.std]  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--motors", type=int, default=20)
    parser.add_argument("--seed", type=int, default=int(np.random.SeedSequence().entropy % 10**6))
    arguments = parser.parse_args()
    print(f"seed {arguments.seed}\n")
    print("| loop | identified | refused or unreliable | error over deviation | 95 % hold |")
    print("| --- | --- | --- | --- | --- |")
    for name in loops.LOOPS:
        rng, errors, refused = np.random.default_rng(arguments.seed), [], 0
        for k in range(arguments.motors):
            gain, lag = rng.uniform(15.0, 40.0), rng.uniform(0.04, 0.2)
            try:
                errors += one(name, gain, lag, arguments.seed + k)
            except SmpError as error:
                refused += 1
                print(f"{name}: K {gain:.1f}, tau {lag:.3f}: {error}", file=sys.stderr)
        z = np.array(errors)
        hold = int(np.sum(np.abs(z) < 1.96))
        print(f"| `{name}` | {arguments.motors - refused} | {refused} | "
              f"{np.sqrt(np.mean(z**2)):.2f} | {hold} of {z.size} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
