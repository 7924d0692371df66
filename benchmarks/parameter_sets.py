# SPDX-License-Identifier: Apache-2.0
"""Draw random parameters of a wheel; accepted ones must run and follow.

    python benchmarks/parameter_sets.py 5000 --seed 15

In the loop's own code, without processes; `faults.py --parameters` sets them in a live wheel.
"""

from __future__ import annotations

import argparse
import math
import random
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "test" / "control")]
GAINS = {
    "p": 1.5, "i": 20.0, "u_clamp_min": -12.0, "u_clamp_max": 12.0, "fault_retry": 0.5,
    "antiwindup_strategy": "back_calculation", "max_acceleration": 15.0, "feedback_timeout": 0.3,
    "feedforward_velocity": 2.6, "feedforward_acceleration": 0.13, "feedforward_static": 0.4,
    "model.dc_gain": 25.55, "model.time_constant": 0.051, "model.static_voltage": 0.45,
}  # fmt: skip
"""With the model of the wheel, so that sets of parameters are judged by it."""


def random_parameters(draw: random.Random) -> dict[str, Any]:
    """Return a set of parameters of wheel_pid around usual values and at the boundaries."""
    usual = {
        "p": 2.0, "i": 60.0, "d": 0.02, "u_clamp_max": 12.0, "i_clamp_max": 12.0,
        "setpoint_weight_p": 0.5, "setpoint_weight_d": 0.2, "error_deadband": 1e-3,
        "derivative_filter_time_constant": 0.005, "feedforward_static": 0.4,
        "feedforward_velocity": 2.6, "feedforward_acceleration": 0.13,
        "model__dc_gain": 25.5, "model__time_constant": 0.05, "model__static_voltage": 0.45,
        "model__time_constant_product": 8e-4, "model__delay": 0.005, "observer__load": 1.0,
        "observer__voltage": 0.005, "observer__count": 0.3, "max_acceleration": 15.0,
        "max_jerk": 300.0, "transition_time": 0.2, "reference_delay": 0.0075,
        "drive__top_speed": 3.0, "drive__time_constant": 0.05,
    }  # fmt: skip
    values: dict[str, Any] = {}
    for name in draw.sample(sorted(usual), draw.randint(1, 6)):
        boundary = [0.0, 5e-324, 1e-300, 1.7e308, -1.7e308, 1e9, math.nan, math.inf, -1.0]
        spread = usual[name] * 10.0 ** draw.gauss(0.0, 1.0)
        values[name] = draw.choice(boundary) if draw.random() < 0.15 else spread
    if draw.random() < 0.3:
        values["speed_source"] = draw.choice(["measured", "difference", "observer"])
    return values


def usual(values: dict[str, Any]) -> dict[str, Any]:
    """Return what takes a random set back."""
    none = {name: 0.0 for name in values if name.startswith(("model__", "drive__"))}
    rest = {
        "max_jerk": 0.0, "transition_time": 0.0, "reference_delay": 0.0, "d": 0.0,
        "i_clamp_max": math.inf, "setpoint_weight_p": 1.0, "setpoint_weight_d": 0.0,
        "error_deadband": 0.0, "derivative_filter_time_constant": 0.0, "observer__load": 1.0,
        "observer__voltage": 0.005, "observer__count": 0.3, "speed_source": "measured",
    }  # fmt: skip
    return {**rest, **none, **{name.replace(".", "__"): value for name, value in GAINS.items()}}


def core(count: int, seed: int) -> bool:
    """Judge sets without processes; return whether all that are accepted follow."""
    from test_acceptance import accepted_sets

    accepted = wrong = 0
    for given, share in accepted_sets(random.Random(seed), count):
        accepted += 1
        if not share < 2.5:
            wrong += 1
            print(f"FAILED {share:.2f} set-points: {given}")
    print(f"seed {seed}: {count} sets, {accepted} accepted, {wrong} wrong")
    return not wrong


def main() -> int:
    """Judge as many sets as are asked for; exit code 1 where one is accepted and wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("count", type=int, metavar="N")
    parser.add_argument("--seed", type=int, default=int(time.time()) // 86400)
    arguments = parser.parse_args()
    return 0 if core(arguments.count, arguments.seed) else 1


if __name__ == "__main__":
    sys.exit(main())
