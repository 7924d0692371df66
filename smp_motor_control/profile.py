"""The reference of a wheel's speed: within its limits, smooth, and on time."""

from __future__ import annotations

import math

from smp_motor_control.errors import ParameterError
from smp_motor_control.feasibility import peak_voltage, shortest_common_transition
from smp_motor_control.transition import (
    PEAK_ACCELERATION,
    PEAK_JERK,
    Limited,
    MinimumJerk,
    ProfileLimits,
    Reference,
    minimum_jerk_duration,
)

__all__ = [
    "PEAK_ACCELERATION",
    "PEAK_JERK",
    "UNLIMITED",
    "Limited",
    "MinimumJerk",
    "Profile",
    "ProfileLimits",
    "Reference",
    "minimum_jerk_duration",
    "peak_voltage",
    "shortest_common_transition",
]

UNLIMITED = ProfileLimits()
"""A reference that jumps."""

_STRETCH = 1.1
_LOOKS = tuple(k / 32.0 for k in range(32))


class Profile:
    """The reference of one wheel, led from target to target without a jump.

    Parameters
    ----------
    limits : ProfileLimits
        What the reference keeps to; targets beyond the velocity limit are clipped.
    transition_time : float
        Duration [s] of every change of the target along a minimum-jerk polynomial, stretched
        where a limit asks for it; 0 takes the fastest transition within the limits.

    Raises
    ------
    ParameterError
        When ``transition_time`` is negative or not finite.

    Examples
    --------
    >>> profile = Profile(ProfileLimits(acceleration=2.0))
    >>> profile.set_target(1.0)
    >>> profile.step(0.25)
    Reference(velocity=0.5, acceleration=2.0, jerk=0.0)
    """

    def __init__(self, limits: ProfileLimits = UNLIMITED, transition_time: float = 0.0) -> None:
        self.configure(limits, transition_time)
        self.reset()

    def configure(self, limits: ProfileLimits, transition_time: float) -> None:
        """Change limits and duration from the next change of the target on.

        Parameters
        ----------
        limits : ProfileLimits
            New limits.
        transition_time : float
            [s].

        Raises
        ------
        ParameterError
            When ``transition_time`` is negative or not finite.
        """
        if not 0.0 <= transition_time < math.inf:
            raise ParameterError(
                f"transition_time is {transition_time} s: must be finite and not negative"
            )
        self.limits, self.transition_time = limits, transition_time

    def reset(self, velocity: float = 0.0) -> None:
        """Rest at a velocity, such as the measured one when a loop is closed.

        Parameters
        ----------
        velocity : float
            [rad/s].
        """
        self.target = velocity
        self.now = Reference(velocity, 0.0, 0.0)
        self._transition: MinimumJerk | Limited | None = None
        self._elapsed = 0.0

    @property
    def moving(self) -> bool:
        """Whether the reference is still under way to its target."""
        return self._transition is not None

    def set_target(self, velocity: float) -> None:
        """Head for a velocity from wherever the reference is now.

        Parameters
        ----------
        velocity : float
            [rad/s]; the target that is in force already changes nothing.

        Raises
        ------
        ParameterError
            When it is not finite; the old target stays.
        """
        if not math.isfinite(velocity):
            raise ParameterError(f"target velocity is {velocity}: must be finite")
        velocity = min(max(velocity, -self.limits.velocity), self.limits.velocity)
        if velocity == self.target:
            return
        self.target = velocity
        self._elapsed = 0.0
        if self.transition_time > 0.0:
            self._transition = self._minimum_jerk(velocity)
        else:
            self._transition = Limited(self.now, velocity, self.limits)

    def _minimum_jerk(self, target: float) -> MinimumJerk:
        limits, start = self.limits, self.now
        step = target - start.velocity
        transition = MinimumJerk(
            start, target, minimum_jerk_duration(step, limits, self.transition_time)
        )
        # A start from rest is exact.  A moving start may ask for more: more time helps, but only
        # without the jerk that it started with, which would act all the longer.
        while abs(start.acceleration) < limits.acceleration and not self._keeps(transition):
            start = start._replace(jerk=0.0)
            transition = MinimumJerk(start, target, transition.duration * _STRETCH)
        return transition

    def _keeps(self, transition: MinimumJerk) -> bool:
        """Tell whether acceleration and jerk stay within their limits (to one part in 1000)."""
        seen = [transition.at(s * transition.duration) for s in _LOOKS]
        return (
            max(abs(x.acceleration) for x in seen) <= 1.001 * self.limits.acceleration
            and max(abs(x.jerk) for x in seen) <= 1.001 * self.limits.jerk
        )

    def step(self, dt: float) -> Reference:
        """Advance by one sample.

        Parameters
        ----------
        dt : float
            [s], not negative.

        Returns
        -------
        Reference
            The reference at the new instant, within the velocity limit.
        """
        if self._transition is None:
            return self.now
        self._elapsed += dt
        self.now = self._clip(self._transition.at(self._elapsed))
        if self._elapsed >= self._transition.duration:
            self._transition = None
        return self.now

    def ahead(self, lead: float) -> Reference:
        """Return where the reference will be if the target stays.

        Parameters
        ----------
        lead : float
            [s] from now, not negative.

        Returns
        -------
        Reference
            For a feed-forward that makes up for delay and for holding the output.
        """
        if self._transition is None:
            return self.now
        return self._clip(self._transition.at(self._elapsed + lead))

    def _clip(self, reference: Reference) -> Reference:
        if abs(reference.velocity) <= self.limits.velocity:
            return reference
        return Reference(math.copysign(self.limits.velocity, reference.velocity), 0.0, 0.0)
