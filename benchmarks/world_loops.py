# SPDX-License-Identifier: Apache-2.0
"""Check that gains from recordings with the effects of real drives keep their specification.

    python benchmarks/world_loops.py [--motors 3] [--seed S] [--effects NAME,...] [--processes 2]
                                     [--rich] [--list]

Each case of ``world`` is recorded, identified and tuned as the tools do it without arguments.  The
wheel's own loop then changes its speed on the simulated drive, with the same effects in driver,
motor and sensor, by the change in ``gains.json``, from a set-point of zero.  ``kept``: overshoot
and settling within the stated bands and tolerances (`OVER`, `LATE`); ``declined``: no estimate, one
that ``tune`` refuses, or a recording that must be refused;
``unstated``: the gains state no largest settling time, and keep the rest.
"""

from __future__ import annotations

import os
import sys
import traceback
from itertools import pairwise
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parent)]

import numpy as np  # noqa: E402
import world_motor  # noqa: E402
from world import recorded, table  # noqa: E402
from world_effects import EFFECTS, Case  # noqa: E402
from world_record import at_bridge, case, fine_steps, floor_torque, plant  # noqa: E402

OUTCOMES = ("kept", "declined", "unstated", "overshoot", "settling", "unstable", "crash")
OVER = 2.0  # percentage points: the width of the band of settling
LATE = 1.15  # times the stated settling, and two samples
BAND = 0.03  # that it settles in; stated is 2 %, at whose very edge noise would decide
MOST = 40_000  # samples of a run


class Drive:
    """The simulated drive of a case, sampled and commanded by a loop."""

    def __init__(self, c: Case, samples: int, late: float, rng: np.random.Generator) -> None:
        self.c, self.rng, self.every = c, rng, fine_steps(c)
        self.fine = c.step / self.every
        n = samples * self.every
        self.p = world_motor.drive(**{**plant(c), **c.drive})
        self.end = max(n * self.fine, c.samples * c.step)
        self.change = at_bridge(c, samples, rng, late)
        self.noise = floor_torque(c, n, self.fine, rng)
        self.command = np.zeros(samples)
        self.out, self.state = np.zeros((n + 1, 7)), world_motor.rest()
        self.filtered = 0.0
        self.count = self.lost = 0.0

    def advance(self, k: int, command: float) -> None:
        """Give the command of a sample, and go on to the next."""
        self.command[k] = command
        first = k * self.every
        world_motor.advance(
            first, first + self.every, self.fine, self.change[: k + 1], self.command[: k + 1],
            self.noise, self.p, self.end, self.state, self.out,
        )  # fmt: skip

    def sample(self, k: int) -> tuple[float, int]:
        """Return the reported speed [rad/s, motor] and the counts."""
        c, s, quantum = self.c, self.c.sensor, 2 * np.pi / self.c.turn
        at = k * self.every
        if c.signals == "speed":
            return self._speed(k), 0
        angle = self.out[at, 4]
        if s.get("eccentric"):
            angle += s["eccentric"] * np.sin(angle + 1.0)
        moved = self.out[at, 4] - self.out[max(at - self.every, 0), 4]
        if abs(moved) > 0.5 * c.fastest * c.step:
            self.lost += s.get("missed", 0.0) * moved
        before, self.count = self.count, np.floor((angle - self.lost) / quantum + 0.3)
        return (self.count - before) * quantum * c.rate, int(self.count)

    def _speed(self, k: int) -> float:
        c, s, at = self.c, self.c.sensor, k * self.every
        y = self.out[at, 3]
        if s.get("lowpass"):
            kept = np.exp(-self.fine / s["lowpass"])
            mean = s["lowpass"] / self.fine * (1 - kept)
            for before, w in pairwise(self.out[max(at - self.every, 0) : at + 1, 3]):
                straight = (1 - mean) * w + (mean - kept) * before
                self.filtered = kept * self.filtered + straight
            y = self.filtered
        if s.get("window") or s.get("late"):
            grid = np.arange(at + 1) * self.fine
            now = at * self.fine
            if s.get("window"):
                begun = np.interp(now - s["window"], grid, self.out[: at + 1, 4])
                y = (self.out[at, 4] - begun) / s["window"]
            else:
                y = np.interp(now - s["late"], grid, self.out[: at + 1, 3])
        y += 0.003 * c.fastest * self.rng.standard_normal()
        if s.get("coarse"):
            y = s["coarse"] * np.round(y / s["coarse"])
        if self.rng.random() < s.get("outliers", 0.0):
            y += c.fastest * self.rng.uniform(-1, 1)
        return float(y)


def changed_speed(c: Case, design, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the instants [s] and the true speed [rad/s, motor] of a change of set-point."""
    from smp_motor_control.encoder import Encoder
    from smp_motor_control.motor.parameters import Gearbox
    from smp_motor_control.wheel.loop import WheelLoop
    from smp_motor_ident.tune.verification import loop_settings
    from smp_motor_ident.tune.writing import parameters

    ratio, spec = c.motor.gear, design.specification
    longest = max(spec.settling.high if np.isfinite(spec.settling.high) else 0.0,
                  design.reference.transition_time + 6 * c.tau)  # fmt: skip
    before = int(min(max(5 * c.tau * c.rate, 30), MOST // 4))
    samples = min(before + int(2.5 * longest * c.rate) + 20, MOST)
    drive = Drive(c, samples, c.step, rng)  # answers take a sample, as designs assume
    encoder = Encoder(c.turn, 0) if c.signals != "speed" else None
    loop = WheelLoop(
        loop_settings(parameters(design)).clamp_to_supply(c.motor.supply), Gearbox(ratio), encoder,
        1.5 * c.motor.supply,
    )  # fmt: skip
    loop.start(0.0)
    command = 0.0
    for k in range(samples):
        velocity, count = drive.sample(k)
        # The voltage over the last interval is the response to the sample before it.
        ran = drive.command[k - 2] if k > 1 else 0.0
        speed = loop.speed(c.step, velocity / ratio, count, ran)
        if not np.isnan(speed):
            wanted = spec.change / ratio if k >= before else 0.0
            command = loop.step(wanted, speed, c.step).output
        drive.advance(k, command)
    shown = drive.out[:: drive.every, 3]
    return (np.arange(samples + 1) - before)[before:] * c.step, shown[before:]


def read(instants: np.ndarray, speed: np.ndarray, change: float) -> tuple[float, float, bool]:
    """Return overshoot [%], settling [s], and whether it oscillates at the end."""
    y = speed / change
    outside = np.flatnonzero(np.abs(y - 1) > BAND)
    last = int(outside[-1]) + 1 if outside.size else 0
    settling = float(instants[last]) if last < y.size else np.inf
    late = y[-max(y.size // 4, 8) :]
    return 100 * (float(y.max()) - 1), settling, bool(np.ptp(late) > 0.5)


def judge(job: tuple[int, int, int, bool]) -> tuple[int, str, str]:
    """Record, identify, tune and run one case; return effect, outcome and words."""
    number, level, seed, rich = job
    from smp_motor_ident.cli import tune, tuning
    from smp_motor_ident.errors import SmpError
    from smp_motor_ident.estimate import estimate
    from smp_motor_ident.tune import design
    from smp_motor_ident.tune.source import choose_source

    effect = EFFECTS[number]
    if effect.expect != "answer":
        return number, "declined", f"{effect.name}: nothing to tune"
    rng = np.random.default_rng(seed)
    c = case(effect, level, rng, rich)
    if c.signals == "angle":
        c.signals = "counts"
    about = (
        f"{effect.name}[{level}] seed {seed}: {c.kind} {c.rate:g} Hz n {c.samples} {c.signals} "
        f"turn {c.turn:g} tau {c.tau:.3g}"
    )
    try:
        found = estimate(recorded(c, rng))
        usual = tune.parser().parse_args(["identification", "--rate", str(c.rate)])
        loop, _ = choose_source(found, tuning.loop_for(found, usual))
        made_for = design(found, loop)
        spec = made_for.specification
        over, settled, rings = read(*changed_speed(c, made_for, rng), spec.change)
    except SmpError as refusal:
        return number, "declined", f"{about}: {refusal}"
    except Exception:  # a benchmark wants to go on
        return number, "crash", f"{about}: {traceback.format_exc(limit=-3)}"
    words = (
        f"{about}: {found.model} by {made_for.loop.speed_source}: overshoot {over:.2f} of "
        f"{spec.overshoot.high:.2f} %, settles {settled:.3g} of {spec.settling.high:.3g} s"
    )
    if rings:
        return number, "unstable", words
    if over > spec.overshoot.high + OVER:
        return number, "overshoot", words
    if settled > LATE * spec.settling.high + 2 * c.step:
        return number, "settling", words
    return number, "kept" if np.isfinite(spec.settling.high) else "unstated", words


if __name__ == "__main__":
    table(judge, OUTCOMES, __doc__)
