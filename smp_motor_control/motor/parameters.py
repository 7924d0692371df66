# SPDX-License-Identifier: Apache-2.0
"""Validated parameters of a DC motor and its gearbox."""

from dataclasses import MISSING, dataclass, fields
from typing import TypeVar

from smp_motor_control.arrays import Array
from smp_motor_control.errors import check_range
from smp_motor_control.fields import described

_UNITS = {
    "resistance": "ohm",
    "inductance": "H",
    "motor_constant": "N m/A",
    "inertia": "kg m^2",
    "viscous_friction": "N m s/rad",
    "coulomb_friction": "N m",
}
PHYSICAL = tuple(_UNITS)  # physical parameters

COMBINATIONS = ("dc_gain", "time_constant", "time_constant_product", "static_voltage")
"""Parameter combinations that voltage and speed identify."""

SUPPLY_RANGE_V = (0.1, 1000.0)  # range of supply voltages [V]

MAX_DELAY_S = 2.0
"""Maximum delay from voltage to effect; the observer stores voltages for this long."""

_MAY_BE_ZERO = ("inductance", "viscous_friction", "coulomb_friction")
Motion = TypeVar("Motion", float, Array)


@dataclass(frozen=True, kw_only=True)
class MotorParameters:
    """Physical parameters of a brushed DC motor at its own shaft."""

    resistance: float  # R, of the armature [ohm]
    inductance: float  # L, of the armature [H]; 0 gives a first-order motor
    motor_constant: float  # K, of torque and of back-EMF [N m/A = V s/rad]
    inertia: float  # J, total [kg m^2]
    viscous_friction: float  # b [N m s/rad]
    coulomb_friction: float = 0.0  # Tc, also the break-away torque [N m]

    def __post_init__(self) -> None:
        for item in fields(self):
            value, unit = getattr(self, item.name), _UNITS[item.name]
            least = 0.0 if item.name in _MAY_BE_ZERO else 1e-21
            value = check_range(item.name, value, least, 1e12, unit)
            object.__setattr__(self, item.name, value)

    @classmethod
    def from_combinations(
        cls,
        *,
        dc_gain: float,
        time_constant: float,
        time_constant_product: float = 0.0,
        static_voltage: float = 0.0,
        resistance: float = 1.0,
    ) -> "MotorParameters":
        """Return the motor without viscous friction that has these combinations.

        ``K = a0``, ``J = a1 K / R``, ``L = a2 R / a1``.  While it slides, its response to a voltage
        is that of every motor with these combinations; voltage and speed cannot separate the
        physical parameters.
        """
        named = {"dc_gain": dc_gain, "time_constant": time_constant, "resistance": resistance}
        for name, value in named.items():
            check_range(name, value, 1e-9, 1e9)
        check_range("time_constant_product", time_constant_product, 0.0, 1e12, "s^2")
        check_range("static_voltage", static_voltage, 0.0, 1e6, "V")
        motor_constant = 1.0 / dc_gain
        return cls(
            resistance=resistance,
            inductance=time_constant_product * resistance / time_constant,
            motor_constant=motor_constant,
            inertia=time_constant * motor_constant * motor_constant / resistance,
            viscous_friction=0.0,
            coulomb_friction=static_voltage * motor_constant / resistance,
        )

    @property
    def a0(self) -> float:
        """Voltage per speed in steady state, ``(R b + K^2) / K`` [V s/rad]."""
        return (
            self.resistance * self.viscous_friction + self.motor_constant**2
        ) / self.motor_constant

    @property
    def a1(self) -> float:
        """``(R J + L b) / K`` [V s^2/rad]."""
        return (
            self.resistance * self.inertia + self.inductance * self.viscous_friction
        ) / self.motor_constant

    @property
    def a2(self) -> float:
        """``L J / K`` [V s^3/rad]."""
        return self.inductance * self.inertia / self.motor_constant

    @property
    def dc_gain(self) -> float:
        """Steady speed per volt, without Coulomb friction [rad/s/V]."""
        return 1.0 / self.a0

    @property
    def time_constant(self) -> float:
        """``a1 / a0`` [s], the sum of the two time constants."""
        return self.a1 / self.a0

    @property
    def time_constant_product(self) -> float:
        """``a2 / a0`` [s^2], the product of the two time constants."""
        return self.a2 / self.a0

    @property
    def static_voltage(self) -> float:
        """Voltage at which the unloaded motor breaks away, ``R Tc / K`` [V]."""
        return self.resistance * self.coulomb_friction / self.motor_constant


@dataclass(frozen=True, kw_only=True)
class MotorModel:
    """Response from voltage to speed at the motor shaft, for feed-forward and observer.

        tp w'' + tau w' + w = K (v(t - delay) - Vs sign(w) - d)

    with ``K = dc_gain``, ``tau = time_constant``, ``tp = time_constant_product`` and
    ``Vs = static_voltage``; d is the load, as a voltage.
    """

    dc_gain: float = described(MISSING, "Steady speed per volt [rad/s/V, motor]; 0: no model.")
    time_constant: float = described(MISSING, "Sum of the time constants [s].")
    time_constant_product: float = described(0.0, "Product of the time constants [s^2].")
    static_voltage: float = described(0.0, "Voltage that overcomes dry friction [V].")
    delay: float = described(0.0, "Dead time from voltage to effect [s].")

    def __post_init__(self) -> None:
        check_range("dc_gain of the model", self.dc_gain, 1e-9, 1e9, "rad/s/V")
        tau = check_range("time_constant of the model", self.time_constant, 1e-7, 1e5, "s")
        # The largest product gives a thousandth of the critical damping.
        limits = (
            ("time_constant_product", 2.5e5 * tau * tau, "s^2"),
            ("static_voltage", 1e6, "V"),
            ("delay", MAX_DELAY_S, "s"),
        )
        for name, most, unit in limits:
            check_range(f"{name} of the model", getattr(self, name), 0.0, most, unit)


def check_supply(name: str, voltage: float) -> float:
    """Return a supply voltage [V]; raise when it is out of range."""
    return check_range(name, voltage, *SUPPLY_RANGE_V, "V")


@dataclass(frozen=True)
class Gearbox:
    """Conversion between motor shaft and wheel."""

    ratio: float = 1.0  # motor revolutions per wheel revolution; positive

    def __post_init__(self) -> None:
        check_range("gear ratio", self.ratio, 1e-6, 1e6)

    def to_motor(self, wheel: Motion) -> Motion:
        """Convert an angle [rad], speed [rad/s] or acceleration from wheel to motor."""
        return wheel * self.ratio

    def to_wheel(self, motor: Motion) -> Motion:
        """Convert an angle [rad], speed [rad/s] or acceleration from motor to wheel."""
        return motor / self.ratio

    def torque_to_motor(self, wheel_torque: float) -> float:
        """Convert a load torque from wheel to motor shaft, without losses."""
        return wheel_torque / self.ratio
