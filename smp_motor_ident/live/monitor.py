# SPDX-License-Identifier: Apache-2.0
"""Track R, K and friction of a commissioned motor while it drives.

Voltage and torque are summed over short blocks, so that nothing is differentiated:

    int v dt = R int i dt + K dtheta + L di + c T,
    K int i dt - J dw = f (b dtheta + Tc T),

with c an offset of the sensors and f the friction relative to the commissioned one, separately for
each direction, since a slope helps one way and hinders the other.  The parameters are a random walk
(Kalman filter): estimates follow the data, and without excitation their standard deviations grow
up to the commissioned prior.

References
----------
L. Ljung, System Identification, 2nd ed., section 11.2 (recursive least squares as Kalman filter).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident import limits
from smp_motor_ident.errors import ParameterError
from smp_motor_ident.finding import Finding
from smp_motor_ident.result import Estimate

Validity = Literal["unestimated", "estimated", "invalid"]

BLOCK_S = 0.25
"""Length of a block [s]: shorter ones amplify the current's noise, longer ones blur changes."""

MAX_GAP_INTERVALS = 5.0
"""Number of usual intervals without a sample after which the motion between is unknown."""

RANDOM_WALK_STD = {"resistance": 5e-3, "motor_constant": 5e-4, "friction": 0.05}
"""Standard deviation of a second's random walk, relative: a winding that heats by a per cent in
three seconds is followed within some ten."""

PRIOR_STD = {"resistance": 0.3, "motor_constant": 0.1, "inductance": 0.01, "friction": 1.0}
"""Relative standard deviations of the prior; iron, and so the inductance, hardly changes."""

MAX_DEVIATIONS = 4.0  # standard deviations beyond which a block is left out: a bad sample, a blow

COPPER_COEFFICIENT = 0.00393  # temperature coefficient of copper's resistance [1/K]


@dataclass(frozen=True)
class CommissionedValues:
    """Commissioned values of a motor, at the motor shaft, SI."""

    # resistance, inductance, motor_constant, inertia: [ohm, H, N m/A, kg m^2]
    resistance: float
    inductance: float
    motor_constant: float
    inertia: float
    # viscous_friction, coulomb_friction: [N m s/rad, N m]
    viscous_friction: float
    coulomb_friction: float
    supply_voltage: float = 12.0  # [V], the scale for contradictions

    def __post_init__(self) -> None:
        """Raise an error for impossible values."""
        for name in ("resistance", "motor_constant", "inertia", "supply_voltage"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ParameterError(f"commissioned {name} is {value}; it must be positive")


def read_commissioned_values(found: Estimate) -> CommissionedValues:
    """Return the commissioned values of a motor whose recording determined all of them."""
    names = ("resistance", "inductance", "motor_constant", "inertia", "viscous_friction",
             "coulomb_friction")  # fmt: skip
    held = {name: found.parameters.get(name) for name in names}
    values = {name: q.value for name, q in held.items() if q is not None and q.value is not None}
    if lacking := [name for name in names if name not in values]:
        raise ParameterError(
            f"{found.wheel}: {', '.join(lacking)} unknown: to watch a motor, commission it with "
            "its current measured"
        )
    return CommissionedValues(**values, supply_voltage=found.hardware.supply_voltage or 12.0)


@dataclass
class _Filter:
    """Kalman filter for random-walk parameters with linear equations."""

    value: Array
    walk: Array
    prior: Array
    noise: float
    covariance: Array = field(init=False)

    def __post_init__(self) -> None:
        self.covariance = np.diag(self.prior**2)

    def update(self, row: Array, seen: float, duration: float) -> None:
        """Update the estimate with one equation of some duration."""
        p = self.covariance + np.diag(self.walk**2 * duration)
        scale = np.minimum(1.0, self.prior / np.sqrt(np.diag(p)))
        p = p * np.outer(scale, scale)  # no uncertainty exceeds the prior's
        miss = seen - float(row @ self.value)
        spread = float(row @ p @ row)
        total = spread + self.noise
        if miss * miss <= MAX_DEVIATIONS**2 * total:  # raise the noise until the block is plausible
            gain = p @ row / total
            self.value = self.value + gain * miss
            p = p - np.outer(gain, row @ p)
        self.covariance = 0.5 * (p + p.T)
        left = min(miss * miss, MAX_DEVIATIONS**2 * total)
        self.noise += 0.02 * (max(left - spread, 0.02 * left) - self.noise)

    def std(self, k: int) -> float:
        """Return the standard deviation of one parameter."""
        return math.sqrt(max(float(self.covariance[k, k]), 0.0))


@dataclass
class _Block:
    """Sums over the samples of a block."""

    time: float = 0.0
    volts: float = 0.0
    amps: float = 0.0
    turned: float = 0.0
    first_amps: float = 0.0
    first_speed: float = 0.0
    directions: set[int] = field(default_factory=set)


class Monitor:
    """Monitor of one motor relative to its commissioned values."""

    def __init__(self, commissioned: CommissionedValues) -> None:
        self.commissioned = c = commissioned
        names = ("resistance", "motor_constant", "inductance")
        start = np.array([*(getattr(c, name) for name in names), 0.0])
        size = np.array([*(PRIOR_STD[name] for name in names), 0.0])
        pace = np.array([*(RANDOM_WALK_STD.get(name, 0.0) for name in names), 0.0])
        offset = np.array([0.0, 0.0, 0.0, 0.02 * c.supply_voltage])
        noise = (0.02 * c.supply_voltage * BLOCK_S) ** 2
        self._electrical = _Filter(
            start, pace * start + 0.01 * offset, size * start + offset, noise
        )
        torque = (0.5 * c.coulomb_friction + 1e-3 * c.motor_constant) * BLOCK_S
        self._friction = {
            way: _Filter(np.ones(1), np.array([RANDOM_WALK_STD["friction"]]),
                         np.array([PRIOR_STD["friction"]]), torque**2)
            for way in (1, -1)
        }  # fmt: skip
        self._block = _Block()
        self._last: tuple[float, float, float] | None = None
        self._usual = 0.0
        self._clock = 0.0
        self._outside: dict[str, float] = {}

    def add(self, time: float, voltage: float, current: float, turned: float) -> None:
        """Add one sample with its stamp [s], of any epoch; NaN for unknown signals.

        Voltage [V] is the mean since the sample before, and ``turned`` the motor's way since then
        [rad]; the current [A] is that at the stamp.
        """
        before, self._last = self._last, None
        if not all(map(math.isfinite, (time, voltage, current, turned))):
            self._block = _Block()
            return
        dt = 0.0 if before is None else time - before[0]
        usable = before is not None and 0 < dt <= MAX_GAP_INTERVALS * (self._usual or dt)
        if dt > 0:
            self._usual += (0.01 if self._usual else 1.0) * (
                min(dt, 2 * (self._usual or dt)) - self._usual
            )
        speed = turned / dt if usable else 0.0
        self._last = (time, current, speed)
        if before is None or not usable:
            self._block = _Block()
            return
        block = self._block
        if block.time == 0.0:
            block.first_amps, block.first_speed = before[1], before[2]
        block.time += dt
        block.volts += voltage * dt
        block.amps += 0.5 * (current + before[1]) * dt
        block.turned += turned
        block.directions.add((turned > 0) - (turned < 0))
        if block.time >= BLOCK_S:
            self._close(block, current, speed)
            self._block = _Block()

    def _close(self, block: _Block, current: float, speed: float) -> None:
        """Update the estimates with a full block that has enough excitation."""
        c = self.commissioned
        if abs(block.volts) < 0.01 * c.supply_voltage * block.time:
            return  # at rest only the sensors' offset shows
        self._clock += block.time
        row = np.array([block.amps, block.turned, current - block.first_amps, block.time])
        self._electrical.update(row, block.volts, block.time)
        if len(block.directions) == 1 and (way := next(iter(block.directions))):
            constant = float(self._electrical.value[1])
            torque = constant * block.amps - c.inertia * (speed - block.first_speed)
            usual = c.viscous_friction * block.turned + way * c.coulomb_friction * block.time
            self._friction[way].update(np.array([way * usual]), way * torque, block.time)
        self._judge()

    def values(self) -> Mapping[str, tuple[float, float]]:
        """Return value and standard deviation by name; friction as a multiple of the usual."""
        e, calm = self._electrical, min(self._friction.values(), key=lambda f: float(f.value[0]))
        return {
            "resistance": (float(e.value[0]), e.std(0)),
            "motor_constant": (float(e.value[1]), e.std(1)),
            "friction": (float(calm.value[0]), max(f.std(0) for f in self._friction.values())),
        }

    def _shares(self) -> dict[str, tuple[float, float, float]]:
        """Return relative change, its standard deviation and its band, by name."""
        c, now = self.commissioned, self.values()
        usual = {"resistance": c.resistance, "motor_constant": c.motor_constant, "friction": 1.0}
        band = {"resistance": limits.RESISTANCE_BAND, "motor_constant": limits.MOTOR_CONSTANT_BAND,
                "friction": limits.FRICTION_BAND}  # fmt: skip
        return {
            name: (value / usual[name] - 1.0, std / usual[name], band[name])
            for name, (value, std) in now.items()
        }

    def validity(self) -> dict[str, tuple[Validity, str]]:
        """Return by name whether a value is known, or the reason if not."""
        out: dict[str, tuple[Validity, str]] = {}
        scale = 0.1 * self.commissioned.supply_voltage * BLOCK_S
        contradicts = self._electrical.noise > scale**2
        for name, (_, std, band) in self._shares().items():
            if contradicts:
                out[name] = "invalid", "voltage, current and speed contradict each other"
            elif std > 0.5 * band:
                out[name] = "unestimated", f"known to {100 * std:.2g} % so far"
            else:
                out[name] = "estimated", ""
        return out

    def _judge(self) -> None:
        """Store since when, in time of motion, each value is significantly out of its band."""
        for name, (share, std, band) in self._shares().items():
            if abs(share) - band > limits.CI95_HALF_WIDTH * std:
                self._outside.setdefault(name, self._clock)
            elif abs(share) < band:
                self._outside.pop(name, None)

    def findings(self) -> list[Finding]:
        """Return findings on values that have left their band and stayed outside."""
        known = self.validity()
        shares = self._shares()
        out = {
            name: shares[name][0]
            for name, since in self._outside.items()
            if self._clock - since >= limits.MIN_OUT_OF_BAND_S and known[name][0] == "estimated"
        }
        return [_finding(name, share, out) for name, share in out.items()]


def _finding(name: str, share: float, out: Mapping[str, float]) -> Finding:
    evidence: dict[str, float | str | None] = {"change": share}
    change = f"{100 * abs(share):.0f} % {'above' if share > 0 else 'below'} its commissioned value"
    if name == "resistance" and share > 0:
        warmer = share / COPPER_COEFFICIENT
        return Finding(
            "winding_hot", "warning",
            f"resistance is {change}: the winding is {warmer:.0f} K warmer, or brushes wear",
            {**evidence, "warmer": warmer},
            "let it cool; if it stays, measure the resistance at rest and look at the brushes",
        )  # fmt: skip
    if name == "motor_constant" and share < 0:
        hot = out.get("resistance", 0.0) > 0
        return Finding(
            "magnet_hot" if hot else "magnet_weak", "warning",
            f"motor constant is {change}" + (": magnets are hot too" if hot else
            ", and not by heat: the magnets have lost strength"),
            evidence,
            "let it cool" if hot else "commission the motor again, and replace it if it goes on",
        )  # fmt: skip
    if name == "friction" and share > 0:
        return Finding(
            "friction_high", "warning",
            f"friction is {change}, in both directions: bearings, gearbox, or a part that rubs",
            evidence, "turn the wheel by hand with the power off",
        )  # fmt: skip
    return Finding(
        f"{name}_changed", "warning", f"{name.replace('_', ' ')} is {change}", evidence,
        "commission the motor again; it is another, or a sensor has changed",
    )  # fmt: skip
