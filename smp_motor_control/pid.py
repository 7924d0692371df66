# SPDX-License-Identifier: Apache-2.0
"""Two-degree-of-freedom PID controller.

With ``e = r - y``, ``e_b = b r - y`` and ``e_c = c r - y`` one step computes

``unsaturated = p e_b + integral + d f(de_c/dt) + feedforward``,
``output = clamp(unsaturated)``,
``integral += dt (i e + anti-windup)`` and clamps it,

where ``f`` is a first-order filter.  The integral is advanced after the output (forward Euler),
as in control_toolbox, so that equal configurations give equal numbers.

References
----------
K. J. Astrom and T. Hagglund, *Advanced PID Control*, ISA, 2006: sections 3.3 (set-point
weighting), 3.4 (derivative filter), 3.5 (anti-windup) and 13.4 (bumpless changes).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from smp_motor_control.errors import ParameterError, check_range
from smp_motor_control.fields import described, parameters_in

EPSILON = 2.220446049250313e-16  # errors, gains and time steps up to this size count as zero

MAX_GAIN = 1e9  # maximum of any gain, weight, clamp or time constant; products of three stay finite

STRATEGIES = ("none", "back_calculation", "conditional_integration")  # anti-windup strategies

_CLAMP = "limit of the output [V], in addition to the supply."


@dataclass(frozen=True, kw_only=True, slots=True)
class PidGains:
    """Validated settings of a PID controller, named as in control_toolbox."""

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


class PidOutput(NamedTuple):
    """Result of one step."""

    output: float  # clamped command; NaN for non-finite inputs
    unsaturated: float  # command before clamping
    p_term: float
    i_term: float  # integral after the step; the command contains the one before
    d_term: float
    feedforward: float
    saturated: bool  # whether clamping changed the command


class Pid:
    """PID controller with its integral and derivative state.

    Parameters
    ----------
    gains : PidGains
        Settings; change them later with :meth:`set_gains`.
    """

    gains: PidGains  # in force
    tracking_time_constant: float  # effective, of back-calculation [s]
    i_term: float  # integral term of the next step
    _previous: float | None  # c r - y of the previous step
    _rate: float  # filtered rate of c r - y
    _last_inputs: tuple[float, float, float] | None  # inputs of the last step
    _last_output: PidOutput

    def __init__(self, gains: PidGains) -> None:
        self.reset()
        self._use(gains)

    def _use(self, gains: PidGains) -> None:
        self.gains = gains
        self.tracking_time_constant = gains.effective_tracking_time_constant

    @property
    def saturated(self) -> bool:
        """Whether clamping changed the last command."""
        return self._last_output.saturated

    def step(
        self,
        reference: float,
        measurement: float,
        dt: float,
        acceleration: float = 0.0,
        error_rate: float | None = None,
    ) -> PidOutput:
        """Advance the controller by one sample of ``dt`` [s]; with 0 return the previous output.

        Speeds are at the wheel [rad/s]; ``acceleration`` of the reference [rad/s^2] is for the
        feed-forward only.  A measured ``error_rate`` of ``c r - y`` [rad/s^2] replaces
        differencing, not the filter, and later steps do not difference from it, as in
        control_toolbox.  When an input is not finite all but the integral is NaN, and the step has
        no effect on later ones.  Before the first step the reference is assumed equal to the
        measurement, so that a turning wheel gets no derivative kick without ``setpoint_weight_d``.
        """
        if not EPSILON < dt < math.inf:
            if -EPSILON <= dt <= EPSILON:
                return self._last_output
            raise ParameterError(f"dt is {dt} s; it must be finite and not negative")
        gains = self.gains
        error = reference - measurement
        weighted = gains.setpoint_weight_d * reference - measurement
        rate = self._filtered_rate(weighted, measurement, dt, error_rate)
        i_term = self.i_term
        p_term = gains.p * (gains.setpoint_weight_p * reference - measurement)
        d_term = gains.d * rate
        feedforward = self._feedforward(reference, acceleration)
        unsaturated = p_term + i_term + d_term + feedforward
        inputs = error + acceleration + (error_rate or 0.0)
        if inputs - inputs != 0.0 or unsaturated != unsaturated:  # NaN, or an infinite input
            nan = math.nan
            self._last_output = PidOutput(nan, nan, nan, self.i_term, nan, nan, False)
            return self._last_output
        output = unsaturated
        if output > gains.u_clamp_max:
            output = gains.u_clamp_max
        elif output < gains.u_clamp_min:
            output = gains.u_clamp_min
        if error > gains.error_deadband or error < -gains.error_deadband:
            i_term = self._integrate(error, dt, output, unsaturated)
            self.i_term = i_term
        if error_rate is None:
            self._previous = weighted
        self._rate = rate if math.isfinite(rate) else 0.0
        self._last_inputs = (reference, measurement, acceleration)
        last = PidOutput(
            output, unsaturated, p_term, i_term, d_term, feedforward, output != unsaturated
        )
        self._last_output = last
        return last

    def _filtered_rate(
        self, weighted: float, measurement: float, dt: float, given: float | None
    ) -> float:
        """Return the rate of ``c r - y`` by backward Euler of ``s / (1 + T s)``."""
        filter_time = self.gains.derivative_filter_time_constant
        if given is None:
            previous = self._previous
            if previous is None:
                previous = self.gains.setpoint_weight_d * measurement - measurement
            change = weighted - previous
        elif filter_time == 0.0:
            return given
        else:
            change = given * dt
        return (filter_time * self._rate + change) / (filter_time + dt)

    def _feedforward(self, reference: float, acceleration: float) -> float:
        """Return the feed-forward voltage.

        Dry friction opposes the reference; at a reference of zero it opposes the acceleration.
        """
        gains = self.gains
        value = gains.feedforward_velocity * reference
        value += gains.feedforward_acceleration * acceleration
        if gains.feedforward_static:
            direction = reference or acceleration
            if direction > 0.0:
                return value + gains.feedforward_static
            if direction < 0.0:
                return value - gains.feedforward_static
        return value

    def _integrate(self, error: float, dt: float, output: float, unsaturated: float) -> float:
        """Return the integral after a step of ``dt``, with anti-windup."""
        gains, old = self.gains, self.i_term
        strategy, tracking = gains.antiwindup_strategy, self.tracking_time_constant
        if strategy == "back_calculation":
            if -EPSILON <= gains.i <= EPSILON:
                return old
            if tracking > 0.0:
                new = old + dt * (gains.i * error + 1.0 / tracking * (output - unsaturated))
            else:
                new = old + dt * gains.i * error + (output - unsaturated)
        elif (
            strategy == "conditional_integration"
            and output != unsaturated
            and error * unsaturated > 0.0
        ):
            new = old
        else:
            new = old + dt * gains.i * error
        if new > gains.i_clamp_max:
            return gains.i_clamp_max
        if new < gains.i_clamp_min:
            return gains.i_clamp_min
        return new if math.isfinite(new) else old

    def reset(self, save_i_term: bool = False) -> None:
        """Discard the state, except the integral if ``save_i_term``."""
        if not save_i_term:
            self.i_term = 0.0
        self._previous = None
        self._rate = 0.0
        self._last_inputs = None
        self._last_output = PidOutput(0.0, 0.0, 0.0, self.i_term, 0.0, 0.0, False)

    def set_gains(self, gains: PidGains) -> None:
        """Change the settings without a jump of the command (bumpless transfer).

        The integral absorbs the change of the other terms at the last inputs, within its clamps.
        Without integral action it is set to zero, as nothing could unwind it later.
        """
        before = self._without_integral()
        self._use(gains)
        if self._last_inputs is not None and self._previous is not None:
            reference, measurement, _ = self._last_inputs
            self._previous = gains.setpoint_weight_d * reference - measurement
        integral = self.i_term + before - self._without_integral()
        if abs(gains.i) <= EPSILON or not math.isfinite(integral):
            integral = 0.0
        self.i_term = min(max(integral, gains.i_clamp_min), gains.i_clamp_max)
        self._last_output = self._last_output._replace(i_term=self.i_term)

    def _without_integral(self) -> float:
        """Return the command at the last inputs without its integral term."""
        if self._last_inputs is None:
            return 0.0
        reference, measurement, acceleration = self._last_inputs
        gains = self.gains
        return (
            gains.p * (gains.setpoint_weight_p * reference - measurement)
            + gains.d * self._rate
            + self._feedforward(reference, acceleration)
        )
