# SPDX-License-Identifier: Apache-2.0
"""Validated settings of the PID controller."""

import math
from dataclasses import dataclass

from smp_motor_control.errors import ParameterError, check_range
from smp_motor_control.fields import described, documented, parameters_in

EPSILON = 2.220446049250313e-16
"""Errors, gains and time steps up to this size count as zero."""

MAX_GAIN = 1e9
"""Maximum of any gain, weight, clamp or time constant; products of three stay finite."""

STRATEGIES = ("none", "back_calculation", "conditional_integration")
"""Anti-windup strategies."""


_CLAMP = "limit of the output [V], in addition to the supply."


@documented
@dataclass(frozen=True, kw_only=True, slots=True)
class PidGains:
    """Validated settings of a PID controller, named as in control_toolbox.

    Raises
    ------
    ParameterError
        When a value is NaN or beyond 1e9 (limits may be infinite), a time constant, dead band
        or static feed-forward is negative, the output limits are not in order, the limits of
        the integral do not enclose zero, or the strategy is unknown.

    Examples
    --------
    >>> PidGains(p=2.0, u_clamp_min=-12.0, u_clamp_max=12.0).p
    2.0
    """

    p: float = described(1.0, "Proportional gain [V s/rad, wheel].")
    i: float = described(0.0, "Integral gain [V/rad].")
    d: float = described(0.0, "Derivative gain [V s^2/rad].")
    u_clamp_min: float = described(-math.inf, f"Lower {_CLAMP}")
    u_clamp_max: float = described(math.inf, f"Upper {_CLAMP}")
    i_clamp_min: float = described(
        -math.inf, "Lower limit of the integral term [V], not above zero."
    )
    i_clamp_max: float = described(
        math.inf, "Upper limit of the integral term [V], not below zero."
    )
    antiwindup_strategy: str = described(
        "none",
        "Integral while the output is clamped: none (it continues), back_calculation (it is driven "
        "back) or conditional_integration (it stops winding up).",
    )
    tracking_time_constant: float = described(
        0.0, "Time constant of back-calculation [s]; 0: sqrt(d/i), or p/i without d.", minimum=0.0
    )
    error_deadband: float = described(
        EPSILON, "Error up to which the integral is frozen [rad/s].", minimum=0.0
    )
    setpoint_weight_p: float = described(1.0, "Weight of the reference in the proportional term.")
    setpoint_weight_d: float = described(0.0, "Weight of the reference in the derivative term.")
    derivative_filter_time_constant: float = described(
        0.0, "Time constant of the first-order derivative filter [s]; 0: none.", minimum=0.0
    )
    feedforward_static: float = described(
        0.0, "Voltage against dry friction, in the direction of the reference [V].", minimum=0.0
    )
    feedforward_velocity: float = described(0.0, "Voltage per speed [V s/rad].")
    feedforward_acceleration: float = described(0.0, "Voltage per acceleration [V s^2/rad].")

    def __post_init__(self) -> None:
        _check_strategy(self.antiwindup_strategy)
        for name, least in _MIN_VALUES.items():
            value = getattr(self, name)
            if not ("_clamp_" in name and value in (-math.inf, math.inf)):
                value = check_range(name, value, least, MAX_GAIN)
            object.__setattr__(self, name, value)
        if not self.u_clamp_min < self.u_clamp_max:
            raise ParameterError(
                f"u_clamp_min is {self.u_clamp_min} and u_clamp_max {self.u_clamp_max}: "
                "the first must be below the second"
            )
        if self.i_clamp_min > 0.0 or self.i_clamp_max < 0.0:
            raise ParameterError(
                f"i_clamp_min is {self.i_clamp_min} and i_clamp_max {self.i_clamp_max}: "
                "the first must not be above zero, the second not below"
            )

    @property
    def effective_tracking_time_constant(self) -> float:
        """Time constant of back-calculation [s], with the default for 0 filled in.

        With an effective value of 0 the integral follows the clamp at once.
        """
        given = self.tracking_time_constant
        if given > EPSILON or abs(self.i) <= EPSILON:
            return given
        if abs(self.d) > EPSILON:
            return math.sqrt(abs(self.d / self.i))
        return abs(self.p / self.i)


_MIN_VALUES = {
    name: max(one.minimum, -MAX_GAIN)
    for name, one in parameters_in(PidGains).items()
    if name != "antiwindup_strategy"
}


def _check_strategy(value: object) -> None:
    if value == "legacy":
        raise ParameterError(
            "antiwindup_strategy 'legacy' is not offered: use 'none' with i_clamp_min and "
            "i_clamp_max, which limits the integral as legacy_antiwindup did"
        )
    if value not in STRATEGIES:
        raise ParameterError(
            f"antiwindup_strategy is {value!r}; it must be one of {', '.join(STRATEGIES)}"
        )
