# SPDX-License-Identifier: Apache-2.0
"""Reference of a wheel's loop: fed forward now, compared with the measurement after its lag."""

import math
from collections import deque

from smp_motor_control.motor.parameters import MotorModel
from smp_motor_control.pid import PidGains
from smp_motor_control.reference.profile import Profile, Reference

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
