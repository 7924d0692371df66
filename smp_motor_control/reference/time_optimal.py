# SPDX-License-Identifier: Apache-2.0
"""Time-optimal change of speed under a voltage limit, in whole samples.

A motor obeys ``tp w'' + tau w' + w = u``, where u is the steady speed at its voltage.  Within
``|u| <= U`` the fastest transition is u at one bound, then at the other (Pontryagin).  In discrete
time both phases last whole samples, and the two end conditions determine their values of u.

References
----------
L. S. Pontryagin et al., *The Mathematical Theory of Optimal Processes* (1962), section 5;
K. J. Astrom, B. Wittenmark, *Computer-Controlled Systems* (1997), section 4.3 on dead-beat.
"""

import math
from dataclasses import MISSING, dataclass

from smp_motor_control.errors import check_range
from smp_motor_control.fields import described
from smp_motor_control.motor.response import FreeResponse
from smp_motor_control.reference.minimum_jerk import Reference

_ROUNDING_MARGIN = 1.0 + 1e-9
_BISECTIONS = 60
_MAX_FIRST_ORDER_RATIO = 1e-6  # largest ``tp / tau^2`` of a motor treated as first order


@dataclass(frozen=True, kw_only=True)
class Drive:
    """Speed and time constants of a motor under the voltage available for transitions."""

    # Steady speed at this voltage, less that of dry friction
    top_speed: float = described(
        MISSING, "Steady speed at the voltage for transitions [rad/s]; 0: no limit."
    )
    time_constant: float = described(MISSING, "Sum of the time constants for transitions [s].")
    time_constant_product: float = described(0.0, "Product of these time constants [s^2].")

    def __post_init__(self) -> None:
        tau = check_range("time_constant of the drive", self.time_constant, 1e-7, 1e5, "s")
        check_range("top_speed of the drive", self.top_speed, 1e-6, 1e12, "rad/s")
        product, most = self.time_constant_product, 2.5e5 * tau * tau
        check_range("time_constant_product of the drive", product, 0.0, most, "s^2")

    def needed(self, reference: Reference) -> float:
        """Return u, the steady speed at the voltage that a reference needs."""
        bend = self.time_constant_product * reference.jerk
        return reference.velocity + self.time_constant * reference.acceleration + bend


_State = tuple[float, float]
"""Speed and acceleration."""


class _Motor:
    """Exact response to a constant u."""

    def __init__(self, drive: Drive) -> None:
        tau, tp = drive.time_constant, drive.time_constant_product
        self.free = FreeResponse(tau, tp if tp > _MAX_FIRST_ORDER_RATIO * tau * tau else 0.0)
        self.tau, self.tp = tau, self.free.product

    def after(self, state: _State, u: float, t: float) -> _State:
        w, a = state
        off = w - u
        g, h, g_rate, h_rate = self.free.after(t)
        return u + g * off + h * a, g_rate * off + h_rate * a

    def time_to_zero_acceleration(self, state: _State, u: float) -> float:
        """Return the time until a braking u has reduced the acceleration to zero [s]."""
        w, a = state
        if a == 0.0:
            return 0.0
        # After 20 of the slowest time constants the response has decayed.
        longest = -20.0 / self.free.slow
        turns = self.free.turning_points(w - u, a, longest)
        return turns[0] if turns else longest

    def jerk(self, state: _State, u: float) -> float:
        """Return the jerk; 0 for a first-order motor."""
        w, a = state
        return (u - w - self.tau * a) / self.tp if self.tp else 0.0


class VoltageLimited:
    """Fastest transition within a voltage, in whole samples, of at least ``least`` seconds.

    For a target at or beyond the top speed the voltage limit is raised to 1.02 times its need.
    """

    __slots__ = ("_legs", "_motor", "duration", "target")

    def __init__(
        self, start: Reference, target: float, drive: Drive, sample_time: float, least: float = 0.0
    ) -> None:
        check_range("sample_time of a transition", sample_time, 1e-9, 1e6, "s")
        self.target = target
        self._motor = motor = _Motor(drive)
        top = max(drive.top_speed, 1.02 * abs(target))
        state = (start.velocity, start.acceleration if motor.tp else 0.0)
        first, second = _find_switching_times(motor, state, target, top)
        samples = max(math.ceil(max(first + second, least) / sample_time - 1e-6), 1)
        lag = second / sample_time
        while (
            legs := _fit_whole_samples(motor, state, target, top, samples, lag, sample_time)
        ) is None:
            samples += max(1, samples // 16)
        self._legs: list[tuple[float, _State, float]] = []
        self.duration = 0.0
        for u, length in legs:
            self.duration += length
            self._legs.append((self.duration, state, u))
            state = motor.after(state, u, length)

    def at(self, t: float) -> Reference:
        """Return the reference at time ``t`` [s]."""
        begin, motor = 0.0, self._motor
        for end, state, u in self._legs:
            if t < end * (1.0 - 1e-12):
                now = motor.after(state, u, t - begin)
                return Reference(*now, motor.jerk(now, u))
            begin = end
        return Reference(self.target, 0.0, 0.0)


def _find_switching_times(
    motor: _Motor, state: _State, target: float, top: float
) -> tuple[float, float]:
    """Return the lengths of the two phases in continuous time [s]."""
    speed = state[0]
    if not motor.tp:
        bound = math.copysign(top, target - speed)
        return motor.tau * math.log((bound - speed) / (bound - target)), 0.0
    brake = -math.copysign(top, state[1])
    braked_speed = motor.after(state, brake, motor.time_to_zero_acceleration(state, brake))[0]
    bound = math.copysign(top, target - braked_speed)

    def finish(first: float) -> tuple[float, float]:
        """Return the final speed and braking time after a first phase."""
        switch = motor.after(state, bound, first)
        if switch[1] * bound <= 0.0:  # still decelerating from the other direction
            return switch[0], 0.0
        second = motor.time_to_zero_acceleration(switch, -bound)
        return motor.after(switch, -bound, second)[0], second

    short, long = 0.0, 0.25 * motor.tau
    for _ in range(_BISECTIONS):
        if (finish(long)[0] - target) * bound >= 0.0:
            break
        short, long = long, 2.0 * long
    for _ in range(_BISECTIONS):
        if long - short < 1e-4 * long:
            break
        middle = 0.5 * (short + long)
        if (finish(middle)[0] - target) * bound >= 0.0:
            long = middle
        else:
            short = middle
    return long, finish(long)[1]


_Legs = tuple[tuple[float, float], ...]
"""u [rad/s] and length [s] of each phase."""


def _fit_whole_samples(
    motor: _Motor,
    state: _State,
    target: float,
    top: float,
    samples: int,
    lag: float,
    sample_time: float,
) -> _Legs | None:
    """Return two phases, ``samples`` long in total, that end exactly at the target; else None."""
    most = max(top, abs(state[0])) * _ROUNDING_MARGIN
    if not motor.tp:
        left = math.exp(-samples * sample_time / motor.tau)
        u = (target - state[0] * left) / (1.0 - left)
        return ((u, samples * sample_time),) if abs(u) <= most else None
    best: _Legs | None = None
    for second_samples in sorted({min(max(int(lag) + k, 1), samples - 1) for k in (-1, 0, 1, 2)}):
        if second_samples < 1:
            continue
        lengths = (samples - second_samples) * sample_time, second_samples * sample_time
        free = motor.after(motor.after(state, 0.0, lengths[0]), 0.0, lengths[1])
        one = motor.after(motor.after((0.0, 0.0), 1.0, lengths[0]), 0.0, lengths[1])
        two = motor.after((0.0, 0.0), 1.0, lengths[1])
        determinant = one[0] * two[1] - one[1] * two[0]
        if determinant == 0.0:
            continue
        gap, rest = target - free[0], -free[1]
        u1 = (gap * two[1] - rest * two[0]) / determinant
        u2 = (rest * one[0] - gap * one[1]) / determinant
        found = max(abs(u1), abs(u2))
        if found <= most and (best is None or found < max(abs(u) for u, _ in best)):
            best = ((u1, lengths[0]), (u2, lengths[1]))
    return best
