"""Two-degree-of-freedom PID controller: one step from a reference and a measurement to volts.

With ``e = r - y``, ``e_b = b r - y`` and ``e_c = c r - y`` one step computes

``unsaturated = p e_b + integral + d f(de_c/dt) + feedforward``,
``output = clamp(unsaturated)``,
``integral += dt (i e + anti-windup)`` and clamps it,

where ``f`` is a first-order filter.  The integral is advanced after the output (forward
Euler), as control_toolbox does, so its configurations give the same numbers here.

References
----------
K. J. Astrom and T. Hagglund, *Advanced PID Control*, ISA, 2006: sections 3.3 (set-point
weighting), 3.4 (derivative filter), 3.5 (anti-windup) and 13.4 (bumpless changes).
"""

import math
from typing import NamedTuple

from smp_motor_control.errors import ParameterError
from smp_motor_control.pid_gains import EPSILON, STRATEGIES, PidGains

__all__ = ["EPSILON", "STRATEGIES", "Pid", "PidGains", "PidOutput"]


class PidOutput(NamedTuple):
    """What one step of a controller computed; immutable, a new one every step."""

    output: float  # the command within its clamps; NaN when an input was not finite
    unsaturated: float  # the command before its clamps
    p_term: float
    i_term: float  # the integral after the step; the command holds the one before it
    d_term: float
    feedforward: float
    saturated: bool  # whether the clamps changed the command


_NAN = math.nan
_INF = math.inf


class Pid:
    """PID controller with its integral and derivative state.

    Parameters
    ----------
    gains : PidGains
        Settings; change them later with :meth:`set_gains`.

    Attributes
    ----------
    gains : PidGains
        Settings in force.
    i_term : float
        The integral term as it will enter the next step.

    Examples
    --------
    >>> pid = Pid(PidGains(p=2.0, i=1.0, u_clamp_max=5.0))
    >>> pid.step(1.0, 0.0, dt=0.5).output, pid.step(1.0, 0.0, dt=0.5).output
    (2.0, 2.5)
    """

    gains: PidGains
    i_term: float
    _previous: float | None  # c r - y of the step before
    _rate: float  # filtered rate of c r - y
    _seen: tuple[float, float, float] | None  # inputs of the last step
    _last: PidOutput

    def __init__(self, gains: PidGains) -> None:
        self.reset()
        self._adopt(gains)

    def _adopt(self, gains: PidGains) -> None:
        """Copy the settings to where a step finds them without a second look-up."""
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
        """Time constant [s] of back-calculation in force, its default filled in."""
        return self._tracking

    @property
    def saturated(self) -> bool:
        """Whether the clamps changed the last command."""
        return self._last.saturated

    def step(
        self,
        reference: float,
        measurement: float,
        dt: float,
        acceleration: float = 0.0,
        error_rate: float | None = None,
    ) -> PidOutput:
        """Advance the controller by one sample.

        Parameters
        ----------
        reference, measurement : float
            What is asked for and what is; [rad/s] at the wheel.
        dt : float
            Time since the step before [s].  With 0 nothing changes and the output of the
            step before is returned.
        acceleration : float
            Rate of the reference [rad/s^2], for the feed-forward alone.
        error_rate : float, optional
            Rate of ``c r - y`` [rad/s^2] where a sensor or an observer tells it; replaces
            differencing, not the filter.  Such a step is not what a later one differences
            from, as in control_toolbox.

        Returns
        -------
        PidOutput
            All NaN but the unchanged integral where an input is not finite: nothing is
            remembered of such a step.

        Raises
        ------
        ParameterError
            When dt is negative, NaN or infinite.

        Notes
        -----
        Before the first step the reference is taken to have rested at the measurement, so
        that a controller which is enabled on a turning wheel gives no derivative kick
        unless ``setpoint_weight_d`` asks for it.
        """
        if not EPSILON < dt < _INF:
            if -EPSILON <= dt <= EPSILON:
                return self._last
            raise ParameterError(f"dt is {dt} s: must be finite and not negative")
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
        self._seen = (reference, measurement, acceleration)
        last = PidOutput(
            output, unsaturated, p_term, i_term, d_term, feedforward, output != unsaturated
        )
        self._last = last
        return last

    def _filtered_rate(
        self, weighted: float, measurement: float, dt: float, given: float | None
    ) -> float:
        """Return the rate of ``c r - y``: backward Euler of ``s / (1 + T s)``."""
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
        """Return the voltage that the model says the reference needs.

        Dry friction opposes the direction of turning; at a reference of zero that is the
        direction in which the reference is about to go.
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
        """Return the integral after a step of ``dt`` with the anti-windup in force."""
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
        """Return NaN for a step whose inputs mean nothing; only the answer is remembered."""
        self._last = PidOutput(_NAN, _NAN, _NAN, self.i_term, _NAN, _NAN, False)
        return self._last

    def reset(self, save_i_term: bool = False) -> None:
        """Forget the past, as before the first step.

        Parameters
        ----------
        save_i_term : bool
            Keep the integral.
        """
        if not save_i_term:
            self.i_term = 0.0
        self._previous = None
        self._rate = 0.0
        self._seen = None
        self._last = PidOutput(0.0, 0.0, 0.0, self.i_term, 0.0, 0.0, False)

    def set_gains(self, gains: PidGains) -> None:
        """Change the settings without a jump of the command.

        The integral takes up what the other terms change by at the inputs of the last step,
        as far as its clamps let it.  Without integral action there is nothing that could
        unwind it later: the integral is zero then.
        """
        before = self._without_integral()
        self._adopt(gains)
        if self._seen is not None and self._previous is not None:
            self._previous = self._weight_d * self._seen[0] - self._seen[1]
        self._store_integral(self.i_term + before - self._without_integral())

    def _without_integral(self) -> float:
        """Return the command at the last inputs less its integral term."""
        if self._seen is None:
            return 0.0
        reference, measurement, acceleration = self._seen
        return (
            self._p * (self._weight_p * reference - measurement)
            + self._d * self._rate
            + self._feedforward(reference, acceleration)
        )

    def _store_integral(self, value: float) -> None:
        if abs(self._i) <= EPSILON or not math.isfinite(value):
            value = 0.0
        self.i_term = min(max(value, self._i_min), self._i_max)
        self._last = self._last._replace(i_term=self.i_term)
