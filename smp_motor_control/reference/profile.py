# SPDX-License-Identifier: Apache-2.0
"""Generator of a wheel's speed reference."""

import math
from collections.abc import Sequence

from smp_motor_control.errors import ParameterError, check_positive
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
