"""Mean squared error over the Cramer-Rao bound, and coverage of the 95 % intervals.

Usage: python benchmarks/efficiency.py [--realisations 100] [--torque]
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from known_motors import CURRENT_NOISE, QUANTUM, TABLE_1, recording, table

from smp_motor_ident import fit, models
from smp_motor_ident import recursion as rc
from smp_motor_ident.errors import SmpError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.experiments import prepare
from smp_motor_ident.models import PHYSICAL, Structure

COMBINATIONS = ("dc_gain", "time_constant", "time_constant_product")


def bound(record, z, current: bool, torque: float) -> dict[str, float]:
    """Return the Cramer-Rao variance of every quantity, sensitivities taken at the truth."""
    structure = Structure("bound", current=current, shape=not current)
    data = prepare([record], current)
    step = data.step
    noise = np.diag([QUANTUM**2 / 12, CURRENT_NOISE**2])
    gain = np.zeros((3, 2))
    if torque > 0:
        # White torque of `torque` volts held for a sample, as intensity on the acceleration.
        par, _ = models.to_internal(z, 2)
        ratio = (torque / par[1]) ** 2 * step / noise[0, 0]
        relative = noise[1, 1] / noise[0, 0] if current else 0.0
        gain, scale = fit.kalman_gain(z, 2, rc.ANGLE, step, ratio, relative)
        noise = scale * noise[0, 0] if current else np.diag([scale[0, 0] * noise[0, 0], 1.0])
    z = structure.complete(z)
    start = np.zeros((1, 4))
    here = fit._pass(data, structure, z, start, start, gain, noise, np.inf, ())
    cov = np.linalg.inv(here.normal)
    m = structure.matrix()
    values, gradients = models.combinations(z, 2)
    names = list(COMBINATIONS)
    if current:
        physical, rows = models.physical(z)
        values, gradients = {**values, **physical}, {**gradients, **rows}
        names += PHYSICAL[:5]
    return {n: (values[n], float(gradients[n] @ m @ cov @ m.T @ gradients[n])) for n in names}


def main() -> None:
    """Run all cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--realisations", type=int, default=100)
    parser.add_argument("--torque", type=float, default=0.0, help="torque noise [V]")
    parser.add_argument("--seconds", type=float, default=10.0)
    args = parser.parse_args()
    rows, inside, asked, begun = [], 0, 0, time.perf_counter()
    for wheel, p in TABLE_1.items():
        for kind in ("sine", "square", "fourier"):
            for current in (True, False):
                ratios, hits, tries, refused = {}, 0, 0, 0
                for seed in range(args.realisations):
                    record, z = recording(
                        p, kind, current=current, seed=seed, seconds=args.seconds,
                        torque_noise=args.torque, static_voltage=0.3,
                    )  # fmt: skip
                    limits = bound(record, z, current, args.torque)
                    model = "electromechanical" if current else "second_order"
                    try:
                        e = estimate(record, model)
                    except SmpError:
                        refused += 1
                        continue
                    for name, (true, variance) in limits.items():
                        q = e.parameters.get(name) or e.combinations.get(name)
                        if q is None or q.value is None or variance > (0.3 * true) ** 2:
                            continue
                        ratios.setdefault(name, []).append((q.value - true) ** 2 / variance)
                        hits += q.ci95[0] <= true <= q.ci95[1]
                        tries += 1
                inside, asked = inside + hits, asked + tries
                mean = {n: float(np.mean(x)) for n, x in ratios.items()}
                worst = max(mean, key=lambda n: mean[n]) if mean else "-"
                average = float(np.mean(list(mean.values()))) if mean else float("nan")
                rows.append(
                    (wheel, kind, "yes" if current else "no", f"{average:.2f}",
                     f"{mean.get(worst, float('nan')):.2f} ({worst})",
                     f"{100 * hits / max(tries, 1):.1f} %", refused)
                )  # fmt: skip
                print(rows[-1], flush=True)
    print()
    head = ("motor", "voltage", "current", "mean MSE/CRB", "worst quantity", "coverage", "refused")
    print(table(head, rows))
    print(
        f"\n{args.realisations} realisations a case, torque noise {args.torque} V; pooled coverage "
        f"of the 95 % intervals {100 * inside / max(asked, 1):.1f} % of {asked}; "
        f"{time.perf_counter() - begun:.0f} s"
    )


if __name__ == "__main__":
    main()
