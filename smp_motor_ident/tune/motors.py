"""Motors as the design takes them: the combinations that fix their response, or draws of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smp_motor_ident.errors import DesignError
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune.arrays import Array

PHYSICAL = ("resistance", "inductance", "motor_constant", "inertia", "viscous_friction")


@dataclass(frozen=True, eq=False)
class Motors:
    """Combinations that fix the response from voltage to speed, for a batch of motors.

    Attributes
    ----------
    a0, a1, a2 : ndarray, shape (n,)
        Coefficients [V s/rad], [V s^2/rad], [V s^3/rad] of ``a2 s^2 + a1 s + a0``.
    delay : ndarray, shape (n,), [s]
        The motor's own delay, from applied voltage to reported speed.
    static_voltage : ndarray, shape (n,), [V]
        What Coulomb friction takes.
    """

    a0: Array
    a1: Array
    a2: Array
    delay: Array
    static_voltage: Array

    def __len__(self) -> int:
        """Return the number of motors."""
        return int(self.a0.size)


def motors_of(estimate: Estimate) -> Motors:
    """Return the motor of an estimate, from whatever combinations or parameters it holds.

    Parameters
    ----------
    estimate : Estimate
        With ``dc_gain`` and ``time_constant``, or with all physical parameters.

    Returns
    -------
    Motors
        A batch of one.

    Raises
    ------
    DesignError
        When the estimate holds neither, or one of them is not positive.
    """
    return _motors(estimate, {name: np.array([estimate.value(name)]) for name in _names(estimate)})


def draw_motors(estimate: Estimate, n: int, rng: np.random.Generator) -> Motors | None:
    """Draw motors from the distribution of the estimation error.

    Parameters
    ----------
    estimate : Estimate
        As for :func:`motors_of`.
    n : int
        Number of draws.
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    Motors or None
        A batch of ``n``, or None where the estimate tells no uncertainty of its response.
    """
    names = _names(estimate)
    known = [name for name in names if name in estimate.names]
    if not known or not np.any(np.diag(estimate.covariance) > 0):
        return None
    draws = estimate.samples_of(names, n, rng)
    return _motors(estimate, dict(zip(names, draws.T, strict=True)))


def _names(estimate: Estimate) -> tuple[str, ...]:
    tail = ("static_voltage", "delay")
    if estimate.value("dc_gain") and estimate.value("time_constant"):
        return ("dc_gain", "time_constant", "time_constant_product", *tail)
    if all(estimate.value(n) for n in ("resistance", "motor_constant", "inertia")):
        return (*PHYSICAL, "coulomb_friction", "delay")
    raise DesignError(
        f"{estimate.wheel}: the estimate holds neither dc_gain and time_constant nor all physical "
        "parameters; identify the motor again"
    )


def _motors(estimate: Estimate, value: dict[str, Array]) -> Motors:
    if "dc_gain" in value:
        a0 = 1 / value["dc_gain"]
        a1 = value["time_constant"] * a0
        a2 = value["time_constant_product"] * a0
        static = value["static_voltage"]
    else:
        R, L, K, J, b = (value[name] for name in PHYSICAL)
        a0, a1, a2 = (R * b + K * K) / K, (R * J + L * b) / K, L * J / K
        static = R * value["coulomb_friction"] / K
    if not (np.all(a0 > 0) and np.all(a1 > 0) and np.all(a2 >= 0) and np.all(np.isfinite(a0))):
        raise DesignError(
            f"{estimate.wheel}: dc_gain and time_constant must be positive, they are "
            f"{1 / a0[0]:.4g} rad/s/V and {a1[0] / a0[0]:.4g} s"
        )
    return Motors(a0, a1, a2, np.maximum(value["delay"], 0.0), np.abs(static))
