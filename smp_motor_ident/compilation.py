# SPDX-License-Identifier: Apache-2.0
"""Compile all functions in advance: ``python -m smp_motor_ident.compilation``.

Python and numba cache their output next to the modules.  A motor is simulated, estimated from each
kind of signal and tuned, so every compiled function is called with the types of real use.  If all
functions are compiled already, this takes a second.
"""

from __future__ import annotations

import compileall
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from smp_motor_control.motor.friction import Motor
from smp_motor_control.motor.parameters import MotorParameters
from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Hardware, Record

STEP, SAMPLES, COUNTS = 0.01, 400, 500.0
SHORT_SAMPLES = 100  # samples of an estimate that only loads the compiled functions
MOTOR = MotorParameters(
    resistance=3.0, inductance=0.05, motor_constant=0.03, inertia=1.4e-5, viscous_friction=5e-5
)
"""A motor similar to the third one of Table 1 of the paper."""


def recording(friction: float, samples: int = SAMPLES) -> Record:
    """Return every signal of a simulated motor at random levels of voltage."""
    motor = Motor(replace(MOTOR, coulomb_friction=friction))
    rng = np.random.default_rng(1)
    voltage = np.repeat(rng.uniform(-8.0, 8.0, samples // 20), 20)
    shown = [(motor.step(float(u), STEP), motor.current, motor.angle) for u in voltage]
    speed, current, angle = np.array(shown).T
    return Record(
        "rehearsal",
        STEP * np.arange(samples, dtype=np.float64),
        voltage,
        current + 0.01 * rng.standard_normal(samples),
        speed + 0.1 * rng.standard_normal(samples),
        None,
        np.floor(angle * COUNTS / (2 * np.pi)).astype(np.int64),
        hardware=Hardware(counts_per_revolution=COUNTS, supply_voltage=12.0),
    )


def load() -> None:
    """Load the functions of estimates before processes are forked."""
    estimate(recording(1e-3, SHORT_SAMPLES), "electromechanical")


def rehearse(signals: str) -> None:
    """Estimate from some signals, and design gains."""
    from smp_motor_ident.tune import Loop, design  # `load` does without

    if signals == "whole":
        design(estimate(recording(1e-3)), Loop())
    else:
        estimate(replace(recording(0.0), current=None, count=None))


def main() -> int:
    """Compile all functions on two cores; return the exit code."""
    for package in ("smp_motor_control", "smp_motor_ident"):
        compileall.compile_dir(Path(__file__).parents[1] / package, quiet=2)
    with ProcessPoolExecutor(2) as pool:
        list(pool.map(rehearse, ("whole", "speed")))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
