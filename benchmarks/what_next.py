# SPDX-License-Identifier: Apache-2.0
"""Check whether the proposed excitation brings the predicted accuracy.

Each motor of Table 1 is recorded without current and identified, with a proposal for the next
recording; the proposal is simulated with the Fourier voltage of the `excite` node and identified
again.

Usage: python benchmarks/what_next.py [--accuracy 0.01] [--recordings 5]
"""

from __future__ import annotations

import argparse

import numpy as np
from known_motors import CURRENT_NOISE, QUANTUM, TABLE_1, independent, recording, table, truth_of

from smp_motor_control.excitation import Fourier
from smp_motor_ident.estimate import estimate
from smp_motor_ident.infer.planning import what_next
from smp_motor_ident.record import Hardware, Record


def follow(p, proposal, static: float, seed: int, rate: float) -> Record:
    """Return the recording that a proposal asks for."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(proposal.duration * rate)) / rate
    tones = Fourier(
        amplitude=proposal.amplitude, lowest=proposal.band[0],
        highest=proposal.band[1], tones=16, seed=seed,
    )  # fmt: skip
    v = np.concatenate([[0.0], tones(t[:-1])])
    r, el, k, j, b = p
    out = independent.simulate(
        t, v, r, el, k, j, b, static * k / r, np.zeros(t.size), max(20, int(10_000 / rate))
    )
    count = np.floor(out[:, 2] / QUANTUM + rng.uniform()).astype(np.int64)
    amps = out[:, 0] + CURRENT_NOISE * rng.standard_normal(t.size)
    hardware = Hardware(1.0, 500.0, 0, 12.0, None)
    return Record("motor", t, v, amps, None, None, count, hardware=hardware)


def main() -> None:
    """Run all motors and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--accuracy", type=float, default=0.01, help="wanted relative std")
    parser.add_argument("--recordings", type=int, default=5)
    parser.add_argument("--friction", type=float, default=0.3, help="[V]")
    args = parser.parse_args()
    rows = []
    for wheel, p in TABLE_1.items():
        first, motor = recording(
            p, "all", current=False, static_voltage=args.friction, seconds=10.0
        )
        proposal = what_next(estimate(first), args.accuracy, current_noise=CURRENT_NOISE)
        truth = truth_of(motor)
        stated: dict[str, list[float]] = {}
        errors: dict[str, list[float]] = {}
        for seed in range(args.recordings):
            e = estimate(follow(p, proposal, args.friction, seed, 1 / first.sample_time))
            for name in proposal.relative_std:
                q = e.parameters[name]
                known = q.value is not None
                stated.setdefault(name, []).append(q.std / truth[name] if known else np.inf)
                errors.setdefault(name, []).append((q.value / truth[name] - 1) if known else np.inf)
        for name, predicted in proposal.relative_std.items():
            rows.append(
                (wheel, f"{proposal.amplitude:.3g} V, {proposal.band[0]:.2g} to "
                 f"{proposal.band[1]:.2g} Hz, {proposal.duration:.0f} s", name,
                 f"{100 * predicted:.3f} %", f"{100 * np.median(stated[name]):.3f} %",
                 f"{100 * np.sqrt(np.mean(np.square(errors[name]))):.3f} %")
            )  # fmt: skip
    head = ("motor", "proposal", "parameter", "predicted std", "std then stated", "rms error then")
    print(table(head, rows))


if __name__ == "__main__":
    main()
