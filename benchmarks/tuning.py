# SPDX-License-Identifier: Apache-2.0
"""Check the margins of designed loops: every method, 4 + N motors, four rates.

    python benchmarks/tuning.py [--motors 200] [--jobs 2] [--rates 100 200] [--output FILE]

Finished results are read from FILE, a line of JSON for each motor and rate, so an interrupted run
can be resumed.

Each design is run by ``closed_loop``, which shares no code with the designer: counts, clamp and
delay included.  With 95 % of the gain or delay margin added
the simulated loop must still decay, with 105 % it must not.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from closed_loop import (
    COUNTS,
    RATIO,
    SUPPLY,
    TABLE_1,
    Conditions,
    Controller,
    as_delivered,
    from_gains,
    overshoot,
    run,
    settling,
)

from smp_motor_ident.errors import DesignError
from smp_motor_ident.result import Estimate, Quantity
from smp_motor_ident.tune import METHODS, Design, Loop, design
from smp_motor_ident.tune.feedback import Feedback, batch_margins, make_grid, spectral_radius
from smp_motor_ident.tune.motors import draw_motors, make_motors
from smp_motor_ident.tune.plant import sample
from smp_motor_ident.tune.problem import Problem

RATES = (100.0, 200.0, 500.0, 1000.0)
SPREAD = 0.01
"""Relative standard deviation of every combination of the estimate."""

RECOMMENDED = "margin"

SHARES = (0.1, 0.5)
"""Set-point steps of the comparison, as shares of the no-load speed: a small one that no loop
saturates on, and a large one on which a plain step has all of the supply at once."""


def random_motors(count: int) -> list[tuple[float, ...]]:
    """Draw motors of two decades around Table 1: R, L, K, J, b of equal response."""
    rng = np.random.default_rng(6)
    motors = []
    for _ in range(count):
        a0 = 1 / np.exp(rng.uniform(np.log(12), np.log(60)))
        tau = np.exp(rng.uniform(np.log(0.02), np.log(0.4)))
        # Up to 0.25 two real time constants, above a complex pair, as the paper's motors.
        a1, a2 = tau * a0, rng.uniform(0.005, 0.45) * tau**2 * a0
        R = rng.uniform(1, 13)
        motors.append((R, a2 * R / a1, a0, a1 * a0 / R, 0.0))
    return motors


def combinations(motor):
    """Return a0, a1, a2."""
    R, L, K, J, b = motor
    return (R * b + K * K) / K, (R * J + L * b) / K, L * J / K


def estimate_of(motor) -> Estimate:
    """Return an error-free identification of this motor."""
    a0, a1, a2 = combinations(motor)
    values = {"dc_gain": 1 / a0, "time_constant": a1 / a0, "time_constant_product": a2 / a0}
    return Estimate(
        wheel="motor",
        model="second_order",
        parameters={},
        combinations={name: Quantity(value) for name, value in values.items()},
        names=tuple(values),
        covariance=np.diag([(SPREAD * value) ** 2 for value in values.values()]),
    )


@dataclass
class Outcome:
    """Result of one design of one motor at one rate."""

    rate: float
    method: str
    designed: bool = False
    stable: bool = False
    gain_margin: bool = False
    delay_margin: bool = False
    required: bool = False
    draws_stable: bool = False
    settling: float = np.nan
    overshoot: float = np.nan
    load: float = np.nan
    faster: dict | None = None
    possible: list | None = None
    seconds: float = 0.0
    why: str = ""


def decays(motor, controller, conditions, crossover) -> bool:
    """Return whether the linear loop decays: late against early deviation from its step."""
    seconds = 90 / crossover + 60 * conditions.delay
    n = int(np.clip(seconds / conditions.sample_time, 600, 60_000))
    linear = replace(conditions, counts=0.0, supply=np.inf)
    speed = run(motor, controller, linear, np.ones(n))[0]
    if not np.all(np.isfinite(speed)):
        return False
    off = np.abs(speed - 1)
    return off[3 * n // 4 :].max() < 0.999 * off[n // 2 : 3 * n // 4].max() or off[-1] < 1e-9


def step(motor, controller, conditions, target, planned=None):
    """Return settling [s] and overshoot [%] of a set-point step with counts and clamp."""
    a0, a1, _ = combinations(motor)
    T = conditions.sample_time
    t = T * np.arange(int((1.0 + 15 * a1 / a0) / T))
    reference, forward, high = np.full(t.size, target), np.zeros(t.size), None
    if planned is not None:
        reference, forward, high = as_delivered(planned, target, t)
    speed = run(motor, controller, conditions, reference, forward, high=high)[0]
    return settling(t, speed, target), overshoot(speed, target), speed


def load_step(motor, controller, conditions):
    """Return the integral of the error after a load of 1 V, per volt [rad/V]."""
    a0, a1, _ = combinations(motor)
    T = conditions.sample_time
    t = T * np.arange(int((0.5 + 15 * a1 / a0) / T))
    torque = np.full(t.size, motor[2] / motor[0])
    ideal = replace(conditions, counts=0.0)
    speed = run(motor, controller, ideal, np.zeros(t.size), load=torque)[0]
    return float(np.trapezoid(np.abs(speed), t))


def scale_to_sensitivity(plant, shape: Feedback, peak: float) -> Feedback:
    """Scale a rule's gains by the largest factor that gives the wanted Ms."""
    omega = make_grid(plant, 400)
    base = plant.response(omega) * shape.response(omega, plant.sample_time)
    low, high = 1e-3, 10.0
    for _ in range(50):
        middle = np.sqrt(low * high)
        fine = batch_margins(middle * base, omega).sensitivity[0] <= peak
        fine = fine and spectral_radius(plant, shape.scaled(middle))[0] < 1
        low, high = (middle, high) if fine else (low, middle)
    return shape.scaled(low)


def soonest(motor, conditions, target) -> float:
    """Return when the whole supply, switched on at once, brings the speed within 2 % [s]."""
    a0, a1, _ = combinations(motor)
    T = conditions.sample_time
    n = int((1.0 + 15 * a1 / a0) / T)
    nothing = Controller(0.0, 0.0)
    speed = run(motor, nothing, conditions, np.zeros(n), np.full(n, SUPPLY))[0]
    # Between samples as a straight line: no loop can be faster.
    k = int(np.argmax(speed >= 0.98 * target))
    return T * (k - (speed[k] - 0.98 * target) / (speed[k] - speed[k - 1]))


def check(job) -> list[Outcome]:
    """Design one motor at one rate by every method, and try each."""
    motor, rate, methods = job
    T = 1 / rate
    loop = Loop(sample_time=T, delay=T, gear_ratio=RATIO,
                counts_per_revolution=COUNTS, supply_voltage=SUPPLY)  # fmt: skip
    conditions = Conditions(T, T)
    estimate = estimate_of(motor)
    outcomes, designs = [], {}
    for method in methods:
        outcome = Outcome(rate, method)
        outcomes.append(outcome)
        begin = time.perf_counter()
        try:
            one = design(estimate, loop, method, samples=300)
        except DesignError as error:
            outcome.why = str(error)
            continue
        outcome.seconds = time.perf_counter() - begin
        outcome.designed, designs[method] = True, one
        try_design(outcome, motor, one, conditions, estimate)
    if RECOMMENDED in designs:
        outcome = next(o for o in outcomes if o.method == RECOMMENDED)
        compare_with_rules(outcome, motor, designs[RECOMMENDED], conditions, estimate, loop)
    return outcomes


def try_design(outcome: Outcome, motor, one: Design, conditions, estimate) -> None:
    """Fill in the independent simulation of one design."""
    controller, m = from_gains(one.gains), one.margins
    target = 0.5 * SUPPLY / combinations(motor)[0]
    outcome.settling, outcome.overshoot, speed = step(motor, controller, conditions, target, one)
    tail = speed[-speed.size // 5 :]
    outcome.stable = bool(np.all(np.abs(tail / target - 1) < 0.03))
    inside = replace(conditions, gain=1 + 0.95 * (m.gain - 1)) if np.isfinite(m.gain) else None
    outcome.gain_margin = inside is None or (
        decays(motor, controller, inside, m.crossover)
        and not decays(motor, controller, replace(conditions, gain=1.05 * m.gain), m.crossover)
    )
    if np.isfinite(m.delay):
        later = [replace(conditions, delay=conditions.delay + f * m.delay) for f in (0.95, 1.05)]
        outcome.delay_margin = decays(motor, controller, later[0], m.crossover) and not decays(
            motor, controller, later[1], m.crossover
        )
    else:
        outcome.delay_margin = True
    required = METHODS[outcome.method].required
    outcome.required = (
        m.phase >= 0.99 * required.phase
        and m.gain >= 0.99 * required.gain
        and m.sensitivity <= 1.01 * required.sensitivity
    )
    outcome.load = load_step(motor, controller, conditions)
    draws = draw_motors(estimate, 5, np.random.default_rng(1))
    drawn = [
        (1.0, draws.a2[k] / draws.a1[k], draws.a0[k], draws.a1[k] * draws.a0[k], 0.0)
        for k in range(len(draws))
    ]
    outcome.draws_stable = one.robustness.stable == 1.0 and all(
        decays(each, controller, conditions, m.crossover) for each in drawn
    )


def compare_with_rules(outcome: Outcome, motor, one: Design, conditions, estimate, loop) -> None:
    """Compare the recommended design with SIMC and Ziegler-Nichols at the same Ms."""
    plant = sample(make_motors(estimate), loop)
    top = SUPPLY / combinations(motor)[0]
    ours = {share: step(motor, from_gains(one.gains), conditions, share * top, one)[0]
            for share in SHARES}  # fmt: skip
    outcome.faster = {}
    outcome.possible = [soonest(motor, conditions, share * top) for share in SHARES]
    for rule in ("simc", "ziegler_nichols"):
        shape = METHODS[rule].solve(Problem(plant, loop))
        same = scale_to_sensitivity(plant, shape, one.margins.sensitivity)
        controller = Controller(same.p, same.i, same.d, same.filter_time, tracking=same.p / same.i)
        load = load_step(motor, controller, conditions)
        # One that never settles within the record counts as slow as the record is long.
        a0, a1, _ = combinations(motor)
        longest = 1.0 + 15 * a1 / a0
        faster = []
        for share, least in zip(SHARES, outcome.possible, strict=True):
            seconds = step(motor, controller, conditions, share * top)[0]
            seconds = longest if np.isnan(seconds) else seconds
            mine = longest if np.isnan(ours[share]) else ours[share]
            faster.append((seconds / mine, seconds / least))
        outcome.faster[rule] = (*faster, load / outcome.load)


def table(outcomes: list[Outcome]) -> None:
    """Print the results."""
    head = "  ".join(
        f"{h:>9s}"
        for h in ("designed", "stable", "gain mgn", "delay mgn", "required", "draws", "ms/design")
    )
    for rate in sorted({o.rate for o in outcomes}):
        print(f"\n{rate:g} Hz{'':12s}{head}")
        for method in METHODS:
            of = [o for o in outcomes if o.rate == rate and o.method == method]
            done = [o for o in of if o.designed]
            names = ("stable", "gain_margin", "delay_margin", "required", "draws_stable")
            cells = [f"{len(done)}/{len(of)}"]
            cells += [f"{sum(getattr(o, n) for o in done)}" for n in names]
            cells.append(f"{1e3 * np.median([o.seconds for o in done]):.0f}" if done else "-")
            print(f"  {method:16s}" + "  ".join(f"{c:>9s}" for c in cells))
    print(f"\nrecommended ({RECOMMENDED}), as delivered, against rules at the same Ms:")
    print("how many times faster it settles (2 %), and how much less a load step disturbs it;")
    print("possible: where the whole supply at once would be 1.3 times faster than the rule")
    print(
        "  rate  rule              step   median   10 %  worst   at least 1.3 (load: 1)  possible"
    )
    for rate in sorted({o.rate for o in outcomes}):
        for rule in ("simc", "ziegler_nichols"):
            found = [o.faster[rule] for o in outcomes if o.rate == rate and o.faster]
            for k, share in enumerate(SHARES):
                row(rate, rule, f"{100 * share:.0f} %", np.array([t[k][0] for t in found]), 1.3,
                    np.mean([t[k][1] >= 1.3 for t in found]))  # fmt: skip
            row(rate, rule, "load", np.array([t[-1] for t in found]), 1.0, 1.0)


def row(rate, rule, name, ratios, enough, possible) -> None:
    """Print one line of the comparison."""
    print(
        f"{rate:6g}  {rule:16s}  {name:>4s}   {np.median(ratios):6.2f} "
        f"{np.quantile(ratios, 0.1):6.2f} {ratios.min():6.2f}   "
        f"{100 * np.mean(ratios >= enough):21.1f} %  {100 * possible:.1f} %"
    )


def known_and_unknown(rates) -> None:
    """Print the difference between gains from combinations and gains from all true parameters."""
    worst = 0.0
    for motor in TABLE_1.values():
        names = ("resistance", "inductance", "motor_constant", "inertia", "viscous_friction")
        found = {name: Quantity(value) for name, value in zip(names, motor, strict=True)}
        true = Estimate("motor", "electromechanical", found, {})
        # Only what voltage and speed tell; R, L, K, J and b stay unknown.
        known = replace(estimate_of(motor), covariance=np.zeros((3, 3)))
        for rate in rates:
            loop = Loop(sample_time=1 / rate)
            for method in METHODS:
                one, other = (design(each, loop, method).gains for each in (known, true))
                for name in ("p", "i", "feedforward_velocity", "feedforward_acceleration"):
                    worst = max(worst, abs(getattr(one, name) / getattr(other, name) - 1))
    print(f"\ngains from combinations alone, relative to those from all: within  {worst:.1e}")


def remembered(file: Path | None) -> dict[tuple[int, float], list[Outcome]]:
    """Return the results of earlier runs in a file, by motor and rate."""
    if file is None or not file.exists():
        return {}
    found: dict[tuple[int, float], dict[str, Outcome]] = {}
    for text in file.read_text().splitlines():
        line = json.loads(text)
        of = found.setdefault((line["motor"], line["rate"]), {})
        # A later line replaces the same methods of an earlier one.
        of.update({each["method"]: Outcome(**each) for each in line["outcomes"]})
    return {key: list(of.values()) for key, of in found.items()}


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--motors", type=int, default=200, help="random ones beside the paper's")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--rates", type=float, nargs="*", default=RATES)
    parser.add_argument("--output", type=Path, help="where outcomes are kept and taken up from")
    parser.add_argument(
        "--again", nargs="*", metavar="METHOD", help="try these anew, whatever FILE holds of them"
    )
    arguments = parser.parse_args()
    motors = [*TABLE_1.values(), *random_motors(arguments.motors)]
    done = remembered(arguments.output)
    keys = [(k, rate) for k in range(len(motors)) for rate in arguments.rates]
    left = keys if arguments.again else [key for key in keys if key not in done]
    methods = arguments.again or list(METHODS)
    begin = time.perf_counter()
    with ProcessPoolExecutor(arguments.jobs) as pool:
        found = pool.map(check, [(motors[k], rate, methods) for k, rate in left])
        for number, (key, outcomes) in enumerate(zip(left, found, strict=True)):
            rest = [o for o in done.get(key, []) if o.method not in methods]
            done[key] = [*outcomes, *rest]
            if arguments.output is not None:
                line = {"motor": key[0], "rate": key[1], "outcomes": [asdict(o) for o in outcomes]}
                with arguments.output.open("a") as file:
                    file.write(json.dumps(line) + "\n")
            print(f"\r{number + 1}/{len(left)} ", end="", file=sys.stderr, flush=True)
    print(f"{len(left)} motors and rates, {time.perf_counter() - begin:.0f} s", file=sys.stderr)
    outcomes = [outcome for key in keys for outcome in done[key]]
    table(outcomes)
    known_and_unknown(arguments.rates)
    for o in outcomes:
        held = o.stable and o.gain_margin and o.delay_margin and o.required and o.draws_stable
        if o.designed and not held:
            print(f"not held: {o}")
        elif not o.designed:
            print(f"no design at {o.rate:g} Hz by {o.method}: {o.why}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
