"""The reference of a wheel's speed: within its limits, smooth, and on time."""

import math
from collections.abc import Sequence

from smp_motor_control.errors import ParameterError, check_positive
from smp_motor_control.reference.minimum_jerk import (
    Limited,
    MinimumJerk,
    ProfileLimits,
    Reference,
    minimum_jerk_duration,
)
from smp_motor_control.reference.time_optimal import Drive, VoltageLimited

__all__ = ["UNLIMITED", "Drive", "Profile", "ProfileLimits", "Reference"]

UNLIMITED = ProfileLimits()
"""A reference that jumps."""

_FASTEST = 1e9
"""Target [rad/s] beyond which nothing turns; squares of it and its rates stay finite."""

_SHORTEST = 1e-6
"""Transition time [s] below which a change is as fast as the limits allow."""

_STRETCH = 1.1
_LOOKS = tuple(k / 32.0 for k in range(32))


class Profile:
    """The reference of one wheel, led from target to target without a jump.

    Every change of the target takes ``transition_time`` [s] along a minimum-jerk polynomial,
    stretched where a limit asks for it; 0 takes the fastest transition within the limits.  With a
    ``drive``, a change for which its voltage does not do is made as fast as the voltage allows.
    Targets beyond the limit of the velocity are clipped.

    Examples
    --------
    >>> profile = Profile(ProfileLimits(acceleration=2.0))
    >>> profile.set_target(1.0)
    >>> profile.step(0.25)
    Reference(velocity=0.5, acceleration=2.0, jerk=0.0)
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
        """Change limits and duration from the next change of the target on."""
        check_positive("transition_time", transition_time, "s", or_zero=True)
        self.limits, self.drive = limits, drive
        self.transition_time = transition_time if transition_time >= _SHORTEST else 0.0

    def reset(self, velocity: float = 0.0) -> None:
        """Rest at a velocity, such as the measured one when a loop is closed."""
        self.target = velocity
        self.now = Reference(velocity, 0.0, 0.0)
        self._transition: MinimumJerk | Limited | VoltageLimited | None = None
        self._elapsed = 0.0

    @property
    def duration(self) -> float:
        """Of the transition that is under way [s]; 0 at rest."""
        return 0.0 if self._transition is None else self._transition.duration

    def set_target(self, velocity: float, sample_time: float = 0.005) -> None:
        """Head for a velocity from wherever the reference is now."""
        if not math.isfinite(velocity):
            raise ParameterError(f"target velocity is {velocity}: must be finite")
        most = min(self.limits.velocity, _FASTEST)
        velocity = min(max(velocity, -most), most)
        if velocity == self.target:
            return
        self.target = velocity
        self._elapsed = 0.0
        self._transition = self._to(velocity, sample_time)

    def _to(self, target: float, sample_time: float) -> MinimumJerk | Limited | VoltageLimited:
        limits = self.limits
        if self.drive is not None and math.isinf(min(limits.acceleration, limits.jerk)):
            if self.transition_time > 0.0:
                smooth = MinimumJerk(self.now, target, self.transition_time)
                if self._keeps(smooth):
                    return smooth
            return VoltageLimited(self.now, target, self.drive, sample_time, self.transition_time)
        if self.transition_time > 0.0 or self.drive is not None:
            return self._minimum_jerk(target, max(self.transition_time, sample_time))
        return Limited(self.now, target, limits)

    def _minimum_jerk(self, target: float, least: float) -> MinimumJerk:
        limits, start = self.limits, self.now
        step = target - start.velocity
        transition = MinimumJerk(start, target, minimum_jerk_duration(step, limits, least))
        # A start from rest is exact but for the voltage.  A moving start may ask for more: time
        # helps, but only without the jerk that it started with, which would act all the longer.
        while not self._keeps(transition):
            start = start._replace(jerk=0.0)
            transition = MinimumJerk(start, target, transition.duration * _STRETCH)
        return transition

    def _keeps(self, transition: MinimumJerk) -> bool:
        """Tell whether acceleration, jerk and voltage keep their limits (to one part in 1000).

        An acceleration that is beyond its limit already, since that was lowered, may only fall.
        """
        seen = [transition.at(s * transition.duration) for s in _LOOKS]
        if self.drive is not None and not self._affords(self.drive, transition, seen):
            return False
        largest = max(
            1.001 * self.limits.acceleration, (1 + 1e-9) * abs(transition.start.acceleration)
        )
        return (
            max(abs(x.acceleration) for x in seen) <= largest
            and max(abs(x.jerk) for x in seen) <= 1.001 * self.limits.jerk
        )

    def _affords(self, drive: Drive, transition: MinimumJerk, seen: Sequence[Reference]) -> bool:
        """Tell whether the voltage does; where nothing but the voltage limits, or from rest.

        Of a transition that starts with an acceleration more time makes more voltage.
        """
        if transition.start.acceleration and math.isfinite(self.limits.acceleration):
            return True
        most = max(drive.top_speed, abs(transition.start.velocity), 1.02 * abs(transition.target))
        return max(abs(drive.needed(x)) for x in seen) <= 1.001 * most

    def step(self, dt: float) -> Reference:
        """Advance by one sample."""
        if self._transition is None:
            return self.now
        self._elapsed += dt
        self.now = self._clip(self._transition.at(self._elapsed))
        if self._elapsed >= self._transition.duration:
            self._transition = None
        return self.now

    def ahead(self, lead: float) -> Reference:
        """Return where the reference will be if the target stays."""
        if self._transition is None:
            return self.now
        return self._clip(self._transition.at(self._elapsed + lead))

    def _clip(self, reference: Reference) -> Reference:
        if abs(reference.velocity) <= self.limits.velocity:
            return reference
        return Reference(math.copysign(self.limits.velocity, reference.velocity), 0.0, 0.0)
