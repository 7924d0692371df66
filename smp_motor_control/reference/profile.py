# SPDX-License-Identifier: Apache-2.0
"""Generator of a wheel's speed reference, and its history in a loop.

The reference is fed forward now and compared with the measurement after its lag.
"""

import math
from collections import deque
from collections.abc import Sequence

from smp_motor_control.errors import ParameterError, check_positive
from smp_motor_control.motor.parameters import MotorModel
from smp_motor_control.pid import PidGains
from smp_motor_control.reference.minimum_jerk import (
    MinimumJerk,
    ProfileLimits,
    RateLimited,
    Reference,
    minimum_jerk_duration,
)
from smp_motor_control.reference.time_optimal import Drive, VoltageLimited

__all__ = ["UNLIMITED", "Drive", "Profile", "ProfileLimits", "Reference"]

UNLIMITED = ProfileLimits()  # no limits: the reference jumps

_MAX_TARGET = 1e9  # maximum target [rad/s]; squares of it and its rates stay finite

_MIN_TRANSITION_S = 1e-6  # shorter transition times count as zero

_STRETCH = 1.1
_CHECK_POINTS = tuple(k / 32.0 for k in range(32))


class Profile:
    """Reference of one wheel, continuous from target to target.

    A change of the target takes ``transition_time`` [s] along a minimum-jerk polynomial, stretched
    to keep the limits; 0 gives the fastest transition within the limits.  With a ``drive``, a
    change that exceeds its voltage is made as fast as the voltage allows.  Targets are clipped to
    the velocity limit.
    """

    def __init__(
        self,
        limits: ProfileLimits = UNLIMITED,
        transition_time: float = 0.0,
        drive: Drive | None = None,
    ) -> None:
        self.configure(limits, transition_time, drive)
        self.reset()

    def configure(
        self, limits: ProfileLimits, transition_time: float, drive: Drive | None = None
    ) -> None:
        """Change the settings from the next target on."""
        check_positive("transition_time", transition_time, "s", or_zero=True)
        self.limits, self.drive = limits, drive
        self.transition_time = transition_time if transition_time >= _MIN_TRANSITION_S else 0.0

    def reset(self, velocity: float = 0.0) -> None:
        """Restart at a constant velocity."""
        self.target = velocity
        self.now = Reference(velocity, 0.0, 0.0)
        self._transition: MinimumJerk | RateLimited | VoltageLimited | None = None
        self._elapsed = 0.0

    @property
    def duration(self) -> float:
        """Duration of the current transition [s]; 0 without one."""
        return 0.0 if self._transition is None else self._transition.duration

    def set_target(self, velocity: float, sample_time: float = 0.005) -> None:
        """Start a transition from the present reference to a velocity."""
        if not math.isfinite(velocity):
            raise ParameterError(f"target velocity is {velocity}; it must be finite")
        most = min(self.limits.velocity, _MAX_TARGET)
        velocity = min(max(velocity, -most), most)
        if velocity == self.target:
            return
        self.target = velocity
        self._elapsed = 0.0
        self._transition = self._plan_transition(velocity, sample_time)

    def _plan_transition(
        self, target: float, sample_time: float
    ) -> MinimumJerk | RateLimited | VoltageLimited:
        limits = self.limits
        if self.drive is not None and math.isinf(min(limits.acceleration, limits.jerk)):
            if self.transition_time > 0.0:
                smooth = MinimumJerk(self.now, target, self.transition_time)
                if self._is_within_limits(smooth):
                    return smooth
            return VoltageLimited(self.now, target, self.drive, sample_time, self.transition_time)
        if self.transition_time > 0.0 or self.drive is not None:
            return self._plan_minimum_jerk(target, max(self.transition_time, sample_time))
        return RateLimited(self.now, target, limits)

    def _plan_minimum_jerk(self, target: float, least: float) -> MinimumJerk:
        limits, start = self.limits, self.now
        step = target - start.velocity
        transition = MinimumJerk(start, target, minimum_jerk_duration(step, limits, least))
        # The duration is exact from rest.  A moving start may need longer, without its initial
        # jerk, whose effect grows with time.
        while not self._is_within_limits(transition):
            start = start._replace(jerk=0.0)
            transition = MinimumJerk(start, target, transition.duration * _STRETCH)
        return transition

    def _is_within_limits(self, transition: MinimumJerk) -> bool:
        """Return whether acceleration, jerk and voltage are within limits (to one part in 1000).

        An initial acceleration beyond a lowered limit may only decrease.
        """
        seen = [transition.at(s * transition.duration) for s in _CHECK_POINTS]
        if self.drive is not None and not self._is_within_voltage(self.drive, transition, seen):
            return False
        largest = max(
            1.001 * self.limits.acceleration, (1 + 1e-9) * abs(transition.start.acceleration)
        )
        return (
            max(abs(x.acceleration) for x in seen) <= largest
            and max(abs(x.jerk) for x in seen) <= 1.001 * self.limits.jerk
        )

    def _is_within_voltage(
        self, drive: Drive, transition: MinimumJerk, seen: Sequence[Reference]
    ) -> bool:
        """Return whether the voltage is within the drive's limit.

        With an acceleration limit and an initial acceleration the voltage is not checked: more time
        would raise it.
        """
        if transition.start.acceleration and math.isfinite(self.limits.acceleration):
            return True
        most = max(drive.top_speed, abs(transition.start.velocity), 1.02 * abs(transition.target))
        return max(abs(drive.needed(x)) for x in seen) <= 1.001 * most

    def step(self, dt: float) -> Reference:
        """Advance by ``dt`` seconds."""
        if self._transition is None:
            return self.now
        self._elapsed += dt
        self.now = self._clip(self._transition.at(self._elapsed))
        if self._elapsed >= self._transition.duration:
            self._transition = None
        return self.now

    def ahead(self, lead: float) -> Reference:
        """Return the reference ``lead`` seconds ahead for a constant target."""
        if self._transition is None:
            return self.now
        return self._clip(self._transition.at(self._elapsed + lead))

    def _clip(self, reference: Reference) -> Reference:
        if abs(reference.velocity) <= self.limits.velocity:
            return reference
        return Reference(math.copysign(self.limits.velocity, reference.velocity), 0.0, 0.0)


_INTERVAL_WINDOW = 5  # number of intervals whose median is the usual one

_MIN_WEIGHT = 1e-12  # acceleration feed-forward below this counts as zero


class ReferencePath:
    """Advance the reference of a profile and keep its history."""

    def __init__(self, profile: Profile) -> None:
        self.profile = profile
        self._recent: deque[float] = deque(maxlen=_INTERVAL_WINDOW)
        self.start(0.0)

    def start(self, velocity: float) -> None:
        """Restart at a constant velocity."""
        self.profile.reset(velocity)
        # At this sample, and predicted for the next one
        self.now = self.following = self.profile.now
        self._from = velocity
        self._elapsed = 0.0
        self._past: deque[tuple[float, float]] = deque([(0.0, velocity)])

    def step(self, setpoint: float, dt: float) -> Reference:
        """Advance to this sample and start a transition to the set-point."""
        profile = self.profile
        self._recent.append(dt)
        self.usual = sorted(self._recent)[len(self._recent) // 2]
        profile.step(dt)
        if setpoint != profile.target:
            self._from = profile.now.velocity
            profile.set_target(setpoint, self.usual)
        self.now, self.following = profile.step(0.0), profile.ahead(self.usual)
        self._elapsed += dt
        self._past.append((self._elapsed, self.now.velocity))
        return self.now

    def delayed(self, delay: float, uncertainty: float, measurement: float) -> tuple[float, float]:
        """Return the reference ``delay`` seconds ago and the value to compare a measurement with.

        The latter is the reference closest to the measurement within ``delay`` ± ``uncertainty``.
        """
        past, time = self._past, self._elapsed - delay
        while len(past) > 2 and past[1][0] <= time - uncertainty:
            past.popleft()
        nominal = _interpolate(past, time)
        if uncertainty == 0.0:
            return nominal, nominal
        possible = [nominal, *(_interpolate(past, time + x) for x in (-uncertainty, uncertainty))]
        return nominal, min(max(measurement, min(possible)), max(possible))

    def acceleration_feedforward(
        self, compared: float, gains: PidGains, model: MotorModel | None
    ) -> float:
        """Return the acceleration to feed forward together with a compared reference.

        The controller adds ``fv r_d + fa x`` for the compared reference ``r_d``.  With the returned
        x this is the mean of ``fv r + fa (r' + r'' a2 / a1)`` over the interval of the held
        voltage, so that the model reaches the reference at its end.
        """
        now, following, dt = self.now, self.following, self.usual
        gained = following.acceleration - now.acceleration
        acceleration_feedforward = (following.velocity - now.velocity) / dt
        weight = gains.feedforward_acceleration
        if abs(weight) < _MIN_WEIGHT:
            return acceleration_feedforward
        mean = 0.5 * (now.velocity + following.velocity) - dt / 12.0 * gained
        acceleration_feedforward += gains.feedforward_velocity / weight * (mean - compared)
        electrical = 0.0 if model is None else model.time_constant_product / model.time_constant
        acceleration_feedforward += electrical * gained / dt
        friction = gains.feedforward_static / weight  # as an acceleration
        if not friction:
            return acceleration_feedforward
        acceleration_feedforward += friction * self._friction(electrical)
        # The controller adds friction by the sign of the compared reference or, at zero, of the
        # acceleration.
        if compared:
            return acceleration_feedforward - math.copysign(friction, compared)
        return math.copysign(
            max(abs(acceleration_feedforward) - friction, 0.0), acceleration_feedforward
        )

    def _friction(self, electrical: float) -> float:
        """Return the mean friction compensation over the next interval, as a fraction.

        The current follows a change of voltage with the electrical time constant.  When the
        reference passes zero, the compensation is a ramp with the lead of the current, so that
        torque errors before and after cancel.  From rest the ramp is shorter, as friction holds the
        wheel until the current has risen.
        """
        now, following = self.now, self.following
        target = self.profile.target
        if self._from * target > 0.0 or not target:
            return _sign(now.velocity or following.velocity)
        half = max((0.5 if self._from else 0.25) * electrical, 0.5 * self.usual)
        first, last = (_friction_share(each, half) for each in (now, following))
        return 0.5 * (first + last) + electrical * (last - first) / self.usual


def _friction_share(reference: Reference, half: float) -> float:
    """Return the value of the friction ramp, by the time to or since the zero crossing.

    At the end of a transition the rate is a rounding error of either sign.
    """
    velocity, rate = reference.velocity, abs(reference.acceleration)
    reach = max(rate * half, abs(velocity))
    return velocity / reach if reach else 0.0


def _sign(value: float) -> float:
    return math.copysign(1.0, value) if value else 0.0


def _interpolate(past: deque[tuple[float, float]], time: float) -> float:
    """Interpolate the history linearly, constant before its start."""
    t1, v1 = past[0]
    for t, v in past:
        t0, v0, t1, v1 = t1, v1, t, v
        if t >= time:
            break
    if t1 <= t0:
        return v1
    return v0 + (v1 - v0) * min(max((time - t0) / (t1 - t0), 0.0), 1.0)
