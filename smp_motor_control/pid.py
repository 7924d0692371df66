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


_NAN = math.nan
_INF = math.inf


class Pid:
    """PID controller with its integral and derivative state.

    Parameters
    ----------
    gains : PidGains
        Settings; change them later with :meth:`set_gains`.
    """

    gains: PidGains  # in force
    i_term: float  # integral term of the next step
    _previous: float | None  # c r - y of the previous step
    _rate: float  # filtered rate of c r - y
    _last_inputs: tuple[float, float, float] | None  # inputs of the last step
    _last_output: PidOutput

    def __init__(self, gains: PidGains) -> None:
        self.reset()
        self._adopt(gains)

    def _adopt(self, gains: PidGains) -> None:
        """Copy the settings to attributes, which saves look-ups in a step."""
        self.gains = gains
        self._p, self._i, self._d = gains.p, gains.i, gains.d
        self._u_min, self._u_max = gains.u_clamp_min, gains.u_clamp_max
        self._i_min, self._i_max = gains.i_clamp_min, gains.i_clamp_max
        strategy = gains.antiwindup_strategy
        self._conditional = strategy == "conditional_integration"
        self._back_calculation = strategy == "back_calculation"
        self._tracking = gains.effective_tracking_time_constant
        self._deadband = gains.error_deadband
        self._weight_p, self._weight_d = gains.setpoint_weight_p, gains.setpoint_weight_d
        self._filter = gains.derivative_filter_time_constant
        self._ff_static = gains.feedforward_static
        self._ff_velocity = gains.feedforward_velocity
        self._ff_acceleration = gains.feedforward_acceleration

    @property
    def tracking_time_constant(self) -> float:
        """Effective time constant of back-calculation [s]."""
        return self._tracking

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
        if not EPSILON < dt < _INF:
            if -EPSILON <= dt <= EPSILON:
                return self._last_output
            raise ParameterError(f"dt is {dt} s; it must be finite and not negative")
        error = reference - measurement
        weighted = self._weight_d * reference - measurement
        rate = self._filtered_rate(weighted, measurement, dt, error_rate)
        i_term = self.i_term
        p_term = self._p * (self._weight_p * reference - measurement)
        d_term = self._d * rate
        feedforward = self._feedforward(reference, acceleration)
        unsaturated = p_term + i_term + d_term + feedforward
        inputs = error + acceleration + (error_rate or 0.0)
        if inputs - inputs != 0.0 or unsaturated != unsaturated:  # NaN, or an infinite input
            return self._refuse()
        output = unsaturated
        if output > self._u_max:
            output = self._u_max
        elif output < self._u_min:
            output = self._u_min
        if error > self._deadband or error < -self._deadband:
            i_term = self._integrate(error, dt, output, unsaturated)
            self.i_term = i_term
        if error_rate is None:
            self._previous = weighted
        self._rate = rate if -_INF < rate < _INF else 0.0
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
        if given is None:
            previous = self._previous
            if previous is None:
                previous = self._weight_d * measurement - measurement
            change = weighted - previous
        elif self._filter == 0.0:
            return given
        else:
            change = given * dt
        return (self._filter * self._rate + change) / (self._filter + dt)

    def _feedforward(self, reference: float, acceleration: float) -> float:
        """Return the feed-forward voltage.

        Dry friction opposes the reference; at a reference of zero it opposes the acceleration.
        """
        value = self._ff_velocity * reference + self._ff_acceleration * acceleration
        if self._ff_static:
            direction = reference or acceleration
            if direction > 0.0:
                return value + self._ff_static
            if direction < 0.0:
                return value - self._ff_static
        return value

    def _integrate(self, error: float, dt: float, output: float, unsaturated: float) -> float:
        """Return the integral after a step of ``dt``, with anti-windup."""
        gain = self._i
        old = self.i_term
        if self._back_calculation:
            if -EPSILON <= gain <= EPSILON:
                return old
            if self._tracking > 0.0:
                new = old + dt * (gain * error + 1.0 / self._tracking * (output - unsaturated))
            else:
                new = old + dt * gain * error + (output - unsaturated)
        elif self._conditional and output != unsaturated and error * unsaturated > 0.0:
            new = old
        else:
            new = old + dt * gain * error
        if new > self._i_max:
            return self._i_max
        if new < self._i_min:
            return self._i_min
        return new if -_INF < new < _INF else old

    def _refuse(self) -> PidOutput:
        """Return NaN for a step with non-finite inputs."""
        self._last_output = PidOutput(_NAN, _NAN, _NAN, self.i_term, _NAN, _NAN, False)
        return self._last_output

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
        self._adopt(gains)
        if self._last_inputs is not None and self._previous is not None:
            self._previous = self._weight_d * self._last_inputs[0] - self._last_inputs[1]
        self._store_integral(self.i_term + before - self._without_integral())

    def _without_integral(self) -> float:
        """Return the command at the last inputs without its integral term."""
        if self._last_inputs is None:
            return 0.0
        reference, measurement, acceleration = self._last_inputs
        return (
            self._p * (self._weight_p * reference - measurement)
            + self._d * self._rate
            + self._feedforward(reference, acceleration)
        )

    def _store_integral(self, value: float) -> None:
        if abs(self._i) <= EPSILON or not math.isfinite(value):
            value = 0.0
        self.i_term = min(max(value, self._i_min), self._i_max)
        self._last_output = self._last_output._replace(i_term=self.i_term)
