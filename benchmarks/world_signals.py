# SPDX-License-Identifier: Apache-2.0
"""Draw random motors and their excitation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

WAVES = (
    "step", "square", "prbs", "multisine", "chirp", "sine", "staircase", "teleop", "ramps",
    "random_steps", "closed_loop", "one_direction",
)  # fmt: skip
RICH = ("square", "prbs", "multisine", "chirp", "random_steps")


@dataclass(frozen=True)
class Motor:
    """A motor with its supply: SI, at the motor shaft."""

    R: float
    L: float
    K: float
    J: float
    b: float
    tc: float
    supply: float
    gear: float

    def truth(self) -> dict[str, float]:
        """Return the correct identification of the plain motor."""
        a0 = self.K + self.R * self.b / self.K
        return {
            "dc_gain": 1 / a0,
            "time_constant": (self.R * self.J + self.L * self.b) / (self.R * self.b + self.K**2),
            "time_constant_product": self.L * self.J / (self.R * self.b + self.K**2),
            "static_voltage": self.R * self.tc / self.K,
            "resistance": self.R,
            "inductance": self.L,
            "motor_constant": self.K,
            "inertia": self.J,
            "viscous_friction": self.b,
            "coulomb_friction": self.tc,
        }


def motor(rng: np.random.Generator) -> Motor:
    """Return a motor between a toy's and a wheelchair's."""
    supply = float(rng.choice([5.0, 6.0, 9.0, 12.0, 24.0, 48.0]))
    fastest = float(np.exp(rng.uniform(np.log(100), np.log(900))))
    r = float(np.exp(rng.uniform(np.log(0.15), np.log(20))))
    tau = float(np.exp(rng.uniform(np.log(0.01), np.log(0.4))))
    te = tau * float(np.exp(rng.uniform(np.log(0.003), np.log(0.15))))
    lost = float(rng.uniform(0.01, 0.3))
    a0 = supply / fastest
    k = (1 - lost) * a0
    b = lost * a0 * k / r
    j = tau * a0 * k / r - te * b
    static = supply * float(np.exp(rng.uniform(np.log(0.01), np.log(0.12))))
    return Motor(
        r, te * r, k, j, b, static * k / r, supply, float(rng.choice([1, 10, 30, 65, 100]))
    )


def wave(kind: str, t: np.ndarray, tau: float, rng: np.random.Generator) -> np.ndarray:
    """Return a command between -1 and 1, one value a sample; starts from rest."""
    n, step = t.size, t[1] - t[0]
    f = float(np.clip(0.15 / tau, 0.15, 4.0))
    hold = max(3, int(rng.uniform(0.7, 2.5) * tau / step))
    if kind == "step":
        out = np.full(n, rng.uniform(0.6, 1.0) * rng.choice([-1, 1]))
        out[: rng.integers(5, max(6, n // 8))] = 0
        return out
    if kind == "square":
        return np.where(np.sin(2 * np.pi * 0.5 * f * t + rng.uniform(0, 6)) > 0, 1.0, -1.0)
    if kind == "prbs":
        return np.repeat(rng.choice([-1.0, 1.0], n // hold + 1), hold)[:n]
    if kind == "multisine":
        tones = np.geomspace(0.1 * f, min(8 * f, 0.2 / step), 18) * rng.uniform(0.95, 1.05, 18)
        x = np.sin(2 * np.pi * np.outer(t, tones) + rng.uniform(0, 6, 18)).sum(axis=1)
        return x / np.abs(x).max()
    if kind == "chirp":
        return np.sin(2 * np.pi * (0.1 * f * t + 0.5 * (4 * f - 0.1 * f) * t**2 / t[-1]))
    if kind == "sine":
        return np.sin(2 * np.pi * f * rng.uniform(0.3, 1.5) * t)
    if kind == "staircase":
        levels = np.concatenate([np.linspace(0, 1, 7), np.linspace(1, -1, 13)])
        return np.repeat(levels, n // levels.size + 1)[:n]
    if kind == "random_steps":
        return np.repeat(rng.uniform(-1, 1, n // (2 * hold) + 1), 2 * hold)[:n]
    if kind == "one_direction":
        return np.repeat(rng.uniform(0.25, 1, n // (2 * hold) + 1), 2 * hold)[:n]
    if kind == "ramps":
        return 2 / np.pi * np.arcsin(np.sin(2 * np.pi * 0.3 * f * t))
    return _teleop(n, step, rng)


def _teleop(n: int, step: float, rng: np.random.Generator) -> np.ndarray:
    """Return keys held for a while, seldom backwards, with rests."""
    out = np.zeros(n)
    k = 0
    while k < n:
        run = int(rng.uniform(0.3, 2.5) / step)
        out[k : k + run] = rng.choice([0.0, 0.5, 0.5, 1.0, 0.8, -0.5])
        k += max(run, 1)
    limit = step / rng.uniform(0.05, 0.3)
    for m in range(1, n):
        out[m] = out[m - 1] + np.clip(out[m] - out[m - 1], -limit, limit)
    return out
