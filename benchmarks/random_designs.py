# SPDX-License-Identifier: Apache-2.0
"""Design gains for random motors and loops; anything but gains or a refusal is a crash.

    python benchmarks/random_designs.py [--count 5000] [--seed 1] [--jobs 2]

Motors of L/R from 10 us to 10 ms and mechanical time constants from 5 ms to 1 s, at 20 Hz to 5 kHz,
with 11 to 4096 counts, reported, differenced and observed speed, with and without averaging, sensor
lag and delay.  The loop's own simulation checks a design; an exception other than DesignError, a
non-finite number, an unstable loop and parameters that the running loop refuses count as crashes.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
import traceback
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from smp_motor_ident.errors import DesignError
from smp_motor_ident.result import Estimate, Quantity
from smp_motor_ident.tune import Loop, design
from smp_motor_ident.tune.verification import loop_settings
from smp_motor_ident.tune.writing import parameters


def draw(seed: int) -> tuple[Estimate, Loop]:
    """Return a random motor, as identified, and a loop for it."""
    rng = np.random.default_rng(seed)

    def log(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    electrical, tau, gain, rate = log(1e-5, 1e-2), log(5e-3, 1.0), log(3, 300), log(20, 5000)
    T = 1 / rate
    values = {
        "dc_gain": gain,
        "time_constant": tau + electrical,
        "time_constant_product": tau * electrical,
        "static_voltage": rng.uniform(0, 2),
    }
    if rng.random() < 0.3:
        values["delay"] = rng.uniform(0, 3) * T
    if rng.random() < 0.3:
        values["averaging_window"] = rng.uniform(0.1, 8) * T
    if rng.random() < 0.3:
        values["sensor_lag"] = rng.uniform(0.1, 5) * T
    std = np.array([0.01 * v for v in values.values()])
    estimate = Estimate(
        "motor", "second_order", {}, {n: Quantity(v) for n, v in values.items()}, tuple(values),
        np.diag(std**2),
    )  # fmt: skip
    source = rng.choice(["measured", "difference", "observer"])
    loop = Loop(
        sample_time=T, gear_ratio=log(1, 100), counts_per_revolution=log(11, 4096),
        supply_voltage=12.0, speed_source=str(source), difference_window=int(rng.integers(1, 9)),
    )  # fmt: skip
    return estimate, loop


def attempt(seed: int) -> str:
    """Return ``designed``, ``refused`` or what went wrong."""
    try:
        one = design(*draw(seed), samples=60)
        loop_settings(parameters(one))
    except DesignError as refusal:
        return f"refused: {refusal}"
    except Exception:
        return f"crash: {seed}: {traceback.format_exc(limit=-2)}"
    gains = (one.gains.p, one.gains.i, one.gains.d, one.margins.phase, one.performance.overshoot)
    if not all(math.isfinite(x) for x in gains):
        return f"crash: {seed}: not finite: {gains}"
    if not one.margins.stable or one.performance.overshoot > 100.0:
        return f"crash: {seed}: unstable, overshoot {one.performance.overshoot:.3g} %"
    return "designed"


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args()
    begin = time.perf_counter()
    seeds = range(arguments.seed * 1_000_000, arguments.seed * 1_000_000 + arguments.count)
    with ProcessPoolExecutor(arguments.jobs) as pool:
        found = []
        for one in pool.map(attempt, seeds, chunksize=20):
            found.append(one)
            if len(found) % 250 == 0:
                spent = time.perf_counter() - begin
                print(f"{len(found)} of {arguments.count}, {spent:.0f} s", file=sys.stderr)
    crashes = [one for one in found if one.startswith("crash")]
    refused = [one for one in found if one.startswith("refused")]
    print(
        f"{found.count('designed')} designed, {len(refused)} refused, {len(crashes)} crashed, "
        f"{time.perf_counter() - begin:.0f} s"
    )
    for words in sorted({one[:90] for one in refused})[:10]:
        print(words)
    for one in crashes[:10]:
        print(one)
    return 1 if crashes else 0


if __name__ == "__main__":
    raise SystemExit(main())
