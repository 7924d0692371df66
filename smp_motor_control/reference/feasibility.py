"""What several motors can do together within a voltage limit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from smp_motor_control.errors import ParameterError


class VoltageModel(Protocol):
    """A motor's ``a2 w'' + a1 w' + a0 w = v - static_voltage sign(w)``, at the motor shaft."""

    @property
    def a0(self) -> float:
        """[V s/rad]."""

    @property
    def a1(self) -> float:
        """[V s^2/rad]."""

    @property
    def a2(self) -> float:
        """[V s^3/rad]."""

    @property
    def static_voltage(self) -> float:
        """[V]."""


def peak_voltage(
    models: Sequence[VoltageModel], start: Sequence[float], target: Sequence[float], duration: float
) -> float:
    """Return the largest voltage that any motor needs along a minimum-jerk transition.

    ``v = a0 w + a1 w' + a2 w'' + static_voltage sign(w)``.
    """
    s = np.linspace(0.0, 1.0, 501)
    shape = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    slope = 30.0 * s**2 * (1.0 - s) ** 2 / duration
    bend = 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / duration**2
    a0, a1, a2, static = (
        np.array([[getattr(m, name)] for m in models])
        for name in ("a0", "a1", "a2", "static_voltage")
    )
    begin = np.asarray(start, dtype=np.float64)[:, None]
    step = np.asarray(target, dtype=np.float64)[:, None] - begin
    speed = begin + step * shape
    voltage = a0 * speed + step * (a1 * slope + a2 * bend) + static * np.sign(speed)
    return float(np.max(np.abs(voltage)))


def shortest_common_transition(
    models: Sequence[VoltageModel],
    start: Sequence[float],
    target: Sequence[float],
    voltage_limit: float,
) -> float:
    """Return the shortest minimum-jerk transition that every motor can follow."""
    for k, model in enumerate(models):
        for speed in (start[k], target[k]):
            needed = model.a0 * abs(speed) + (model.static_voltage if speed else 0.0)
            if not needed < voltage_limit:
                raise ParameterError(
                    f"motor {k + 1} needs {needed:.2f} V to hold {speed:.1f} rad/s, "
                    f"the limit is {voltage_limit:.2f} V: lower the speed"
                )
    if list(start) == list(target):
        return 0.0

    from scipy.optimize import brentq  # takes a while to load, for tuning alone

    def excess(log_duration: float) -> float:
        return peak_voltage(models, start, target, math.exp(log_duration)) - voltage_limit

    longest = math.log(1.0)
    while excess(longest) > 0.0:
        longest += 1.0
    shortest = longest - 1.0
    while excess(shortest) < 0.0:
        shortest -= 1.0
    return math.exp(float(brentq(excess, shortest, longest, xtol=1e-6)))
