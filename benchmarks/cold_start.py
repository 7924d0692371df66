"""Random motors over two decades around Table 1, from an independent simulator, from cold.

Usage: python benchmarks/cold_start.py [--motors 200] [--seconds 6] [--rate 1000]
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from known_motors import TABLE_1, recording, table

from smp_motor_ident import fit
from smp_motor_ident.cold import cold_fit
from smp_motor_ident.descent import Options
from smp_motor_ident.errors import SmpError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.experiments import prepare
from smp_motor_ident.models import Structure

CASES = (
    ("linear, voltage only", False, False, 0.0),
    ("linear, with current", True, False, 0.0),
    ("friction, with current", True, True, 0.0),
    ("friction and torque noise, with current", True, True, 0.2),
    ("friction, voltage only", False, True, 0.0),
)


def motor(rng: np.random.Generator) -> tuple[float, ...]:
    """Return a motor whose parameters lie within a decade of one of Table 1's, each way."""
    base = np.array(list(TABLE_1.values())[rng.integers(4)])
    return tuple(base * 10 ** rng.uniform(-1, 1, 5))


def main() -> None:
    """Run all cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--motors", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    args = parser.parse_args()
    rows = []
    for name, current, friction, torque in CASES:
        right = doubtful = silent = unclear = 0
        spent = []
        rng = np.random.default_rng(7)
        for n in range(args.motors):
            p = motor(rng)
            volts = rng.uniform(0.1, 2.0) if friction else 0.0
            record, z = recording(
                p, "all", current=current, static_voltage=volts, torque_noise=torque,
                seconds=args.seconds, rate=args.rate, seed=n,
            )  # fmt: skip
            structure = Structure(
                "trial", friction="symmetric" if friction else "none", current=current,
                shape=friction and not current,
            )  # fmt: skip
            data = prepare([record], current)
            begun = time.perf_counter()
            found = cold_fit(data, structure, Options())
            spent.append(time.perf_counter() - begun)
            if found is None:
                unclear += 1
                continue
            near = fit.solve(
                data, structure, structure.complete(z), np.zeros((1, 4)), found.noise, found.ratio
            )
            # At or below the deviance that a start from the truth reaches; 0.1 % of noise.
            if found.deviance <= near.deviance + max(10.0, 1e-3 * data.size):
                right += 1
                continue
            try:
                e = estimate(record)
                flagged = any("doubtful" in w for w in e.warnings)
            except SmpError:
                flagged = True
            doubtful += flagged
            silent += not flagged
        rows.append(
            (name, f"{right} of {args.motors}", doubtful + unclear, silent,
             f"{1e3 * np.median(spent):.0f} ms")
        )  # fmt: skip
        print(rows[-1], flush=True)
    head = ("case", "right minimum", "said to be doubtful", "neither", "median time")
    print("\n" + table(head, rows))


if __name__ == "__main__":
    main()
