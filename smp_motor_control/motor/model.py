# SPDX-License-Identifier: Apache-2.0
"""Motor model from voltage to speed, for feed-forward and observer.

    tp w'' + tau w' + w = K (v(t - delay) - Vs sign(w) - d)

with ``K = dc_gain``, ``tau = time_constant``, ``tp = time_constant_product`` and
``Vs = static_voltage``, at the motor shaft; d is the load, as a voltage.
"""

from dataclasses import MISSING, dataclass

from smp_motor_control.errors import check_range
from smp_motor_control.fields import described

MAX_DELAY_S = 2.0
"""Maximum delay from voltage to effect; the observer stores voltages for this long."""


@dataclass(frozen=True, kw_only=True)
class MotorModel:
    """Parameter combinations that determine the response from voltage to speed."""

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
