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
from typing import NamedTuple

from smp_motor_control.errors import ParameterError
from smp_motor_control.pid_gains import EPSILON, STRATEGIES, PidGains

__all__ = ["EPSILON", "STRATEGIES", "Pid", "PidGains", "PidOutput"]


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

    Attributes
    ----------
    gains : PidGains
        Settings in force.
    i_term : float
        Integral term of the next step.

    Examples
    --------
    >>> pid = Pid(PidGains(p=2.0, i=1.0, u_clamp_max=5.0))
    >>> pid.step(1.0, 0.0, dt=0.5).output, pid.step(1.0, 0.0, dt=0.5).output
    (2.0, 2.5)
    """

    gains: PidGains
    i_term: float
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
        """Advance the controller by one sample.

        Parameters
        ----------
        reference, measurement : float
            Reference and measured speed [rad/s, wheel].
        dt : float
            Time since the previous step [s].  With 0 the previous output is returned.
        acceleration : float
            Rate of the reference [rad/s^2], for the feed-forward only.
        error_rate : float, optional
            Measured rate of ``c r - y`` [rad/s^2]; replaces differencing, not the filter.  A later
            step does not difference from such a step, as in control_toolbox.

        Returns
        -------
        PidOutput
            All NaN except the unchanged integral when an input is not finite; such a step has no
            effect on later ones.

        Raises
        ------
        ParameterError
            When dt is negative, NaN or infinite.

        Notes
        -----
        Before the first step the reference is assumed equal to the measurement, so that enabling
        the controller on a turning wheel gives no derivative kick unless ``setpoint_weight_d``
        is set.
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
        """Discard the state.

        Parameters
        ----------
        save_i_term : bool
            Keep the integral.
        """
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
