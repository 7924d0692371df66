"""The motor as voltage and speed tell it: what feed-forward and observer are built from.

    tp w'' + tau w' + w = K (v(t - delay) - Vs sign(w) - d)

with ``K = dc_gain``, ``tau = time_constant``, ``tp = time_constant_product`` and
``Vs = static_voltage``, at the motor shaft; d is what the load takes, as a voltage.
"""

from dataclasses import MISSING, dataclass

from smp_motor_control.errors import check_range
from smp_motor_control.fields import described

LONGEST_DELAY = 2.0
"""From a voltage to its effect [s]; the observer keeps the voltages of that long."""


@dataclass(frozen=True, kw_only=True)
class MotorModel:
    """The combinations of motor parameters that fix the response from voltage to speed."""

    dc_gain: float = described(MISSING, "Speed per volt [rad/s/V, motor]; 0: no model.")
    time_constant: float = described(MISSING, "Sum of the time constants [s].")
    time_constant_product: float = described(0.0, "Their product [s^2].")
    static_voltage: float = described(0.0, "What dry friction takes [V].")
    delay: float = described(0.0, "From voltage to effect [s].")

    def __post_init__(self) -> None:
        check_range("dc_gain of the model", self.dc_gain, 1e-9, 1e9, "rad/s/V")
        tau = check_range("time_constant of the model", self.time_constant, 1e-7, 1e5, "s")
        # The largest product leaves a thousandth of the critical damping.
        limits = (
            ("time_constant_product", 2.5e5 * tau * tau, "s^2"),
            ("static_voltage", 1e6, "V"),
            ("delay", LONGEST_DELAY, "s"),
        )
        for name, most, unit in limits:
            check_range(f"{name} of the model", getattr(self, name), 0.0, most, unit)
