"""The reference of a wheel as its loop uses it: fed forward now, compared with some time later."""

import math
from collections import deque

from smp_motor_control.motor.model import MotorModel
from smp_motor_control.pid import PidGains
from smp_motor_control.reference.profile import Profile, Reference

_RECENT = 5
"""Intervals of which the median is the usual one."""

_NO_WEIGHT = 1e-12
"""Feed-forward of the acceleration that is none; the others are taken in units of it."""


class ReferencePath:
    """Leads the reference of a profile, and remembers where it was."""

    def __init__(self, profile: Profile) -> None:
        self.profile = profile
        self._recent: deque[float] = deque(maxlen=_RECENT)
        self.start(0.0)

    def start(self, velocity: float) -> None:
        """Rest at a velocity."""
        self.profile.reset(velocity)
        # At this sample, and at the next one if the interval is as usual
        self.now = self.following = self.profile.now
        self._from = velocity
        self._elapsed = 0.0
        self._past: deque[tuple[float, float]] = deque([(0.0, velocity)])

    def step(self, setpoint: float, dt: float) -> Reference:
        """Advance to this sample, and head for the set-point from here."""
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

    def ago(self, delay: float, doubt: float, measurement: float) -> tuple[float, float]:
        """Return what a measurement is to be compared with."""
        past, then = self._past, self._elapsed - delay
        while len(past) > 2 and past[1][0] <= then - doubt:
            past.popleft()
        nominal = _interpolated(past, then)
        if doubt == 0.0:
            return nominal, nominal
        around = [nominal, *(_interpolated(past, then + x) for x in (-doubt, doubt))]
        return nominal, min(max(measurement, min(around)), max(around))

    def forward(self, compared: float, gains: PidGains, model: MotorModel | None) -> float:
        """Return the acceleration to feed forward beside a compared reference.

        The controller adds ``fv r_d + fa x`` for the reference ``r_d`` that it compares with;
        with the x below that is the mean of ``fv r + fa (r' + r'' a2 / a1)`` over the interval for
        which the voltage is held, so that a model that gets it is with the reference at its end.
        """
        now, following, dt = self.now, self.following, self.usual
        gained = following.acceleration - now.acceleration
        forward = (following.velocity - now.velocity) / dt
        weight = gains.feedforward_acceleration
        if abs(weight) < _NO_WEIGHT:
            return forward
        mean = 0.5 * (now.velocity + following.velocity) - dt / 12.0 * gained
        forward += gains.feedforward_velocity / weight * (mean - compared)
        electrical = 0.0 if model is None else model.time_constant_product / model.time_constant
        forward += electrical * gained / dt
        least = gains.feedforward_static / weight
        if not least:
            return forward
        forward += least * self._friction(electrical)
        # The controller adds friction for the reference that it compares with, or, if that is
        # at rest, for the acceleration that it is given.
        if compared:
            return forward - math.copysign(least, compared)
        return math.copysign(max(abs(forward) - least, 0.0), forward)

    def _friction(self, electrical: float) -> float:
        """Return the mean voltage against dry friction over the next interval, as a share.

        The current follows a turn of the voltage with the electrical time constant.  On the way
        through zero, and from rest, the share therefore goes along a ramp with what the rate of
        its current takes, so that as much torque is too early as is too late; from rest a
        shorter one, for until the current is there friction holds the wheel.
        """
        now, following = self.now, self.following
        target = self.profile.target
        if self._from * target > 0.0 or not target:
            return _sign(now.velocity or following.velocity)
        half = max((0.5 if self._from else 0.25) * electrical, 0.5 * self.usual)
        first, last = (_share(each, half) for each in (now, following))
        return 0.5 * (first + last) + electrical * (last - first) / self.usual


def _share(reference: Reference, half: float) -> float:
    """Return where the friction's ramp is, from the time to or since the passage of zero.

    At its end a change's rate is nothing but rounding, of either sign.
    """
    velocity, rate = reference.velocity, abs(reference.acceleration)
    reach = max(rate * half, abs(velocity))
    return velocity / reach if reach else 0.0


def _sign(value: float) -> float:
    return math.copysign(1.0, value) if value else 0.0


def _interpolated(past: deque[tuple[float, float]], then: float) -> float:
    """Return a value between remembered ones, linearly; the first before them."""
    t1, v1 = past[0]
    for t, v in past:
        t0, v0, t1, v1 = t1, v1, t, v
        if t >= then:
            break
    if t1 <= t0:
        return v1
    return v0 + (v1 - v0) * min(max((then - t0) / (t1 - t0), 0.0), 1.0)
