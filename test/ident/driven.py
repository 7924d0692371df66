# SPDX-License-Identifier: Apache-2.0
"""Records of a motor of first order behind a driver that has one effect on its command."""

import math
from functools import cache

import numpy as np

from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Record
from smp_motor_ident.result import Estimate

GAIN, TAU, STATIC, STEP = 20.0, 0.08, 0.4, 0.005
NOISE = 0.3  # rad/s


def commands(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-12.0, 12.0, 60), rng.integers(20, 40, 60))


def run(voltage: np.ndarray, seed: int, most: float = math.inf, noise: float = NOISE) -> np.ndarray:
    """Return the speed of a motor of first order with friction, exactly but for its stops.

    Its driver gives no more than ``most`` volts beyond the back-EMF.
    """
    fine, w, out = 100, 0.0, np.zeros(voltage.size)
    keep = math.exp(-STEP / fine / TAU)
    for k, command in enumerate(voltage.tolist()[1:], 1):
        for _ in range(fine):
            volts = w / GAIN + min(max(command - w / GAIN, -most), most)
            if w == 0.0 and abs(volts) <= STATIC:
                break
            direction = math.copysign(1.0, w or volts)
            after = keep * w + (1 - keep) * GAIN * (volts - STATIC * direction)
            w = 0.0 if after * direction < 0.0 else after
        out[k] = w
    return out + noise * np.random.default_rng(1000 + seed).standard_normal(out.size)


def dead(u: np.ndarray) -> np.ndarray:
    return np.where(np.abs(u) > 1.0, u - np.sign(u), 0.0)


def clipped(u: np.ndarray) -> np.ndarray:
    return np.clip(u, -9.0, 9.0)


def slewed(u: np.ndarray, rate: float = 200.0) -> np.ndarray:
    """Return the means of a voltage that rises at a rate, from nothing, by a fine grid."""
    fine, now, out = 200, 0.0, np.zeros(u.size)
    most = rate * STEP / fine
    for k, target in enumerate(u.tolist()[1:], 1):
        total = 0.0
        for _ in range(fine):
            before = now
            now += min(max(target - now, -most), most)
            total += 0.5 * (before + now)
        out[k] = total / fine
    return out


DRIVERS = {"dead_zone": (dead, 1.0), "clip_voltage": (clipped, 9.0), "slew_rate": (slewed, 200.0)}


@cache
def recorded(name: str, seed: int) -> Record:
    command = commands(seed)
    time = np.arange(command.size) * STEP
    return Record("motor", time, command, velocity=run(DRIVERS[name][0](command), seed))


@cache
def estimated(name: str, seed: int) -> Estimate:
    return estimate(recorded(name, seed))
