# SPDX-License-Identifier: Apache-2.0
"""Check exported gains in the arithmetic of their target.

    python benchmarks/exports.py [--motors 50]

Each target's control law is written here from its documentation, on a motor that is sampled by the
matrix exponential: counts, whole numbers, clamp and one sample of delay included.  Printed is, for
the paper's motors and random ones, specified and simulated settling and overshoot of an abrupt
change by half of the largest speed, and Ms.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping

import numpy as np
from closed_loop import COUNTS, RATIO, SUPPLY, TABLE_1, overshoot, settling
from scipy.linalg import expm
from tuning import combinations, estimate_of, random_motors

from smp_motor_ident.errors import DesignError
from smp_motor_ident.tune import Loop, design
from smp_motor_ident.tune.exports import FORMATS, TARGETS, check
from smp_motor_ident.tune.exports.target import duration

Law = Callable[[float, float, int], float]
"""From set-point and speed [rad/s, motor] and the counts of the interval to volts."""


def ros2_controllers(n: Mapping[str, float], T: float) -> Law:
    """control_toolbox: forward Euler, used one step later, driven back while clamped."""
    integral = 0.0

    def law(r: float, y: float, counts: int) -> float:
        nonlocal integral
        e = (r - y) / RATIO
        wanted = n["p"] * e + integral
        command = min(max(wanted, n["u_clamp_min"]), n["u_clamp_max"])
        integral += T * (n["i"] * e + (command - wanted) / n["tracking_time_constant"])
        return min(max(command + n["feedforward_gain"] * r / RATIO, -SUPPLY), SUPPLY)

    return law


def linorobot2(n: Mapping[str, float], T: float) -> Law:
    """RPM of the wheel in, PWM of ten bits out, the sum unlimited."""
    total = 0.0

    def law(r: float, y: float, counts: int) -> float:
        nonlocal total
        measured = counts / T * 60 / (COUNTS * RATIO)
        error = r / RATIO * 60 / (2 * math.pi) - measured
        total += error
        pwm = min(max(n["K_P"] * error + n["K_I"] * total, -1023), 1023)
        return int(pwm) / 1023 * SUPPLY

    return law


def ros_arduino_bridge(n: Mapping[str, float], T: float) -> Law:
    """Whole numbers, set-point too, divided towards zero, added to the output of before."""
    output, before = 0, 0

    def law(r: float, y: float, counts: int) -> float:
        nonlocal output, before
        error = int(r * COUNTS / (2 * math.pi) * T) - counts
        output += int((n["Kp"] * error - n["Kd"] * (counts - before)) / n["Ko"])
        output = min(max(output, -255), 255)
        before = counts
        return output / 255 * SUPPLY

    return law


def arduino_pid(n: Mapping[str, float], T: float) -> Law:
    """The sum with the present error, sum and output clamped."""
    total = 0.0

    def law(r: float, y: float, counts: int) -> float:
        nonlocal total
        e = (r - counts / T * 2 * math.pi / COUNTS) / RATIO
        total = min(max(total + n["Ki"] * T * e, -255), 255)
        return int(min(max(n["Kp"] * e + total, -255), 255)) / 255 * SUPPLY

    return law


LAWS = {
    law.__name__: law for law in (ros2_controllers, linorobot2, ros_arduino_bridge, arduino_pid)
}


def run(motor, law: Law, T: float, target: float, seconds: float):
    """Return instants and true speed of an abrupt change of set-point from rest."""
    a0, a1, a2 = combinations(motor)
    A = np.zeros((4, 4))
    A[0, 1], A[2, 0] = 1.0, 1.0
    A[1] = (-a0 / a2, -a1 / a2, 0.0, 1 / a2)
    step = expm(A * T)
    x, sent, before, speeds = np.zeros(4), 0.0, 0, []
    y = 0.0
    for _ in range(int(seconds / T)):
        speeds.append(x[0])
        count = math.floor(x[2] * COUNTS / (2 * math.pi))
        y = (count - before) / T * 2 * math.pi / COUNTS
        x[3], sent = sent, law(target, y, count - before)
        before = count
        x = step @ x
    return T * np.arange(len(speeds)), np.array(speeds)


def attempt(name: str, motor) -> tuple[float, ...] | None:
    """Return specified and simulated settling [s] and overshoot [%], Ms, whether it is kept."""
    target = FORMATS[name]
    T = 1 / target.rate
    loop = Loop(sample_time=T, gear_ratio=RATIO, counts_per_revolution=COUNTS,
                supply_voltage=SUPPLY, speed_source="difference")  # fmt: skip
    try:
        one = design(estimate_of(motor), loop, samples=100, **TARGETS)
        gains = target.convert(one)
    except DesignError:
        return None
    found = check(one, gains)
    change = 0.5 * one.reference.max_velocity
    t, speed = run(motor, LAWS[name](gains.numbers, T), T, change, duration(one, gains))
    # A tick of the encoder plus the rounding to whole numbers
    band = max(0.02, found.resting_error + 2 * math.pi / COUNTS / T / change)
    # As specified: within half a percent of the band, from 1.2 times the settling time on.
    specified = found.step.settling
    kept = settling(t, speed, change, band + 0.005) <= 1.2 * specified + 3 * T
    if math.isnan(specified):
        kept = not math.isnan(settling(t, speed, change, band))
    return (
        specified, settling(t, speed, change, band),
        found.step.overshoot, overshoot(speed, change), found.margins.sensitivity, kept,
    )  # fmt: skip


def median(values: np.ndarray) -> str:
    """Return the median of those that settle, and of how many."""
    there = values[np.isfinite(values)]
    rests = "" if there.size == values.size else f", {values.size - there.size} with an error"
    return f"{1e3 * np.median(there):.0f} ms{rests}" if there.size else "remaining error"


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--motors", type=int, default=50, help="random ones in addition to the paper's"
    )
    motors = [*TABLE_1.values(), *random_motors(parser.parse_args().motors)]
    print("| format | designed | settling specified | simulated | overshoot specified | simulated"
          " | largest difference | settles as specified | Ms |")  # fmt: skip
    print("| --- " * 9 + "|")
    for name in FORMATS:
        rows = [one for motor in motors if (one := attempt(name, motor)) is not None]
        s, t, o, p, m, kept = np.array(rows, dtype=float).T
        print(
            f"| `{name}` | {len(rows)} of {len(motors)} | {median(s)} | {median(t)} | "
            f"{np.median(o):.1f} % | {np.median(p):.1f} % | "
            f"{np.max(np.abs(p - o)):.1f} points | {int(kept.sum())} | {m.max():.2f} |",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
