# SPDX-License-Identifier: Apache-2.0
"""Validated parameters of a DC motor and its gearbox."""

from dataclasses import dataclass, fields
from typing import TypeVar

from smp_motor_control.arrays import Array
from smp_motor_control.errors import check_range

_UNITS = {
    "resistance": "ohm",
    "inductance": "H",
    "motor_constant": "N m/A",
    "inertia": "kg m^2",
    "viscous_friction": "N m s/rad",
    "coulomb_friction": "N m",
}
PHYSICAL = tuple(_UNITS)
"""Physical parameters."""

COMBINATIONS = ("dc_gain", "time_constant", "time_constant_product", "static_voltage")
"""Parameter combinations that voltage and speed identify."""

SUPPLY_RANGE_V = (0.1, 1000.0)
"""Range of supply voltages [V]."""

_MAY_BE_ZERO = ("inductance", "viscous_friction", "coulomb_friction")
Motion = TypeVar("Motion", float, Array)


@dataclass(frozen=True, kw_only=True)
class MotorParameters:
    """Physical parameters of a brushed DC motor at its own shaft.

    Attributes
    ----------
    resistance : float
        Armature resistance R [ohm], positive.
    inductance : float
        Armature inductance L [H]; 0 gives a first-order motor.
    motor_constant : float
        Torque constant = back-EMF constant K [N m/A = V s/rad], positive.
    inertia : float
        Total inertia J [kg m^2], positive.
    viscous_friction : float
        Viscous friction b [N m s/rad].
    coulomb_friction : float
        Coulomb friction Tc [N m]; also the break-away torque.

    Raises
    ------
    ParameterError
        When a value is out of range.
    """

    resistance: float
    inductance: float
    motor_constant: float
    inertia: float
    viscous_friction: float
    coulomb_friction: float = 0.0

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


def check_supply(name: str, voltage: float) -> float:
    """Return a supply voltage [V]; raise when it is out of range."""
    return check_range(name, voltage, *SUPPLY_RANGE_V, "V")


@dataclass(frozen=True)
class Gearbox:
    """Conversion between motor shaft and wheel.

    Examples
    --------
    >>> Gearbox(65.5).to_motor(2.0)
    131.0
    """

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
