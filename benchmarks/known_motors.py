# SPDX-License-Identifier: Apache-2.0
"""Recordings of known motors for the benchmarks of identification.

The simulator (test/ident/motors.py) integrates in small fixed steps and shares nothing
with the estimator.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "test"), str(ROOT / "test" / "ident")]

import motors as independent  # noqa: E402

from smp_motor_control.motor.parameters import COMBINATIONS, PHYSICAL, MotorParameters  # noqa: E402
from smp_motor_ident.record import Hardware, Record  # noqa: E402

QUANTUM = 2 * np.pi / 500
CURRENT_NOISE = 0.01
EXACT = 0.0, 0.0  # accuracy of current and voltage: the tables are about scatter
TABLE_1 = independent.TABLE_1


def voltage(t: np.ndarray, kind: str, amplitude: float, rng: np.random.Generator) -> np.ndarray:
    """Return an excitation that never repeats in step with the sampling: slowly detuned.

    Frequency and amplitude wander by 7 %; a ``plain square`` keeps its amplitude, so that the
    motor turns at two exact speeds and the counter's error repeats.
    """
    s = np.concatenate([[t[0]], t[:-1]])
    slow = 1 + 0.07 * np.sin(0.61 * s + rng.uniform(0, 6))
    phase = 2 * np.pi * np.cumsum(slow) * (s[2] - s[1])
    if kind == "sine":
        return amplitude * slow * np.sin(1.037 * phase + rng.uniform(0, 6))
    if kind.endswith("square"):
        level = amplitude if kind == "plain square" else amplitude * slow / 1.07
        return level * np.sign(np.sin(0.917 * phase + rng.uniform(0, 6)))
    f = np.geomspace(0.1, 20, 24) * (1 + 0.01 * rng.standard_normal(24))
    x = np.zeros(t.size)  # tone by tone: ten million samples must fit
    for tone, phase0 in zip(f, rng.uniform(0, 2 * np.pi, 24)):
        x += np.cos(2 * np.pi * tone * s + phase0)
    return amplitude * x / np.abs(x).max()


def recording(
    parameters: tuple[float, ...],
    kind: str = "fourier",
    *,
    current: bool = True,
    static_voltage: float = 0.0,
    torque_noise: float = 0.0,
    seconds: float = 10.0,
    rate: float = 200.0,
    amplitude: float = 12.0,
    seed: int = 0,
    counts: bool = True,
    coarse: int = 0,
) -> tuple[Record, MotorParameters]:
    """Return a recording of a motor (R, L, K, J, b), and the motor."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * rate)) / rate
    if kind == "all":
        n = len(t) // 3
        parts = [voltage(t[:n], k, amplitude, rng) for k in ("sine", "square")]
        v = np.concatenate([*parts, voltage(t[: len(t) - 2 * n], "fourier", amplitude, rng)])
    else:
        v = voltage(t, kind, amplitude, rng)
    r, el, k, j, b = parameters
    load = torque_noise * k / r * rng.standard_normal(t.size)
    motor = motor_of(parameters, static_voltage)
    steps = coarse or substeps(motor, 1 / rate)
    out = independent.simulate(t, v, r, el, k, j, b, motor.coulomb_friction, load, steps)
    count = np.floor(out[:, 2] / QUANTUM + rng.uniform()).astype(np.int64)
    amps = out[:, 0] + CURRENT_NOISE * rng.standard_normal(t.size) if current else None
    hardware = Hardware(1.0, 500.0 if counts else None, 0, amplitude, None, *EXACT)
    made = Record(
        "motor",
        t,
        v,
        amps,
        None if counts else out[:, 1],
        None,
        count if counts else None,
        hardware=hardware,
        source="simulated",
    )
    return made, motor


def substeps(motor: MotorParameters, step: float) -> int:
    """Return the steps of the simulator within a sample."""
    slow = motor.resistance * motor.inertia / (motor.a0 * motor.motor_constant)
    fastest = min(motor.inductance / motor.resistance, slow)
    return int(np.clip(20 * step / max(fastest, 1e-6), 20, 2000))


def motor_of(parameters: tuple[float, ...], static_voltage: float) -> MotorParameters:
    """Return the motor with R, L, K, J, b and a breakaway voltage."""
    torque = static_voltage * parameters[2] / parameters[0]
    return MotorParameters(**dict(zip(PHYSICAL, (*parameters, torque))))


def truth_of(motor: MotorParameters) -> dict[str, float]:
    """Return the true physical parameters and combinations of a motor by their names."""
    return {name: getattr(motor, name) for name in (*PHYSICAL, *COMBINATIONS)}


def table(head: tuple[str, ...], rows: list[tuple[object, ...]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    lines += ["| " + " | ".join(str(x) for x in row) + " |" for row in rows]
    return "\n".join(lines)
