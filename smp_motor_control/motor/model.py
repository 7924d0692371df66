"""The motor as voltage and speed tell it: what feed-forward and observer are built from.

    tp w'' + tau w' + w = K (v(t - delay) - Vs sign(w) - d)

with ``K = dc_gain``, ``tau = time_constant``, ``tp = time_constant_product`` and
``Vs = static_voltage``, at the motor shaft; d is what the load takes, as a voltage.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from smp_motor_control.errors import ParameterError


@dataclass(frozen=True, kw_only=True)
class MotorModel:
    """The combinations of motor parameters that fix the response from voltage to speed.

    Attributes
    ----------
    dc_gain : float
        [rad/s/V], positive.
    time_constant : float
        [s], positive.
    time_constant_product : float
        [s^2]; 0 for a motor of first order.
    static_voltage : float
        What dry friction takes [V].
    delay : float
        From the voltage to its effect [s].

    Raises
    ------
    ParameterError
        When a value is not finite or has a sign that no motor has.
    """

    dc_gain: float
    time_constant: float
    time_constant_product: float = 0.0
    static_voltage: float = 0.0
    delay: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            positive = field.name in ("dc_gain", "time_constant")
            if not math.isfinite(value) or value < 0.0 or (positive and value == 0.0):
                wanted = "positive" if positive else "zero or positive"
                raise ParameterError(f"{field.name} of the model is {value}: must be {wanted}")

    @property
    def a0(self) -> float:
        """Voltage per speed [V s/rad]."""
        return 1.0 / self.dc_gain

    @property
    def a1(self) -> float:
        """Voltage per acceleration [V s^2/rad]."""
        return self.time_constant / self.dc_gain

    @property
    def a2(self) -> float:
        """Voltage per jerk [V s^3/rad]."""
        return self.time_constant_product / self.dc_gain
