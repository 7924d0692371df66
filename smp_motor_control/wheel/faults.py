# SPDX-License-Identifier: Apache-2.0
"""Detection of motor faults, and the retries after them.

Times are in seconds on a steady clock.
"""

import math
from dataclasses import dataclass
from enum import Enum

from smp_motor_control.errors import check_positive
from smp_motor_control.fields import described

MAX_TRIES = 3  # retries of a wheel at fault before an operator must reset it

PROVEN_AFTER_S = 2.0  # time of normal turning that ends a fault and clears its retries

TRUSTED_AFTER_S = 0.6
"""Time of normal turning after which a retry may use the full voltage; faults show earlier."""

_RELEASE_TIME_S = 0.5  # time of a zero set-point that releases a wheel

_TRIAL_VOLTAGE_RATIO = 1.05  # maximum voltage of a retry, relative to ``stall_voltage``

_MIN_ERROR = 0.3
"""Errors up to this are never a fault [rad/s]; one count at 1 kHz is 0.19 at the paper's wheel."""

_MAX_REMAINING_SHARE = 0.95
"""Maximum fraction of the error that an accelerating wheel has left a window later."""

_SATURATED_TOLERANCE = 0.7
"""Tolerated relative error at saturation when the reachable speed is unknown."""

OVERLOAD_RATIO, OVERLOAD_TIME_S = 1.5, 1.5
"""Ratio of actual to needed voltage that counts as overload, and its minimum duration."""

_GOOD_TRACKING_SHARE = 0.1  # maximum relative error at which volts per speed are learnt


class Fault(Enum):
    """Faults of a driven wheel."""

    STALL = "no counts under voltage: stalled wheel or, less likely, dead encoder; check both"
    DEAD_ENCODER = (
        "no counts under voltage: dead encoder or, less likely, stalled wheel; check both"
    )
    NO_MOTION = "no counts under voltage: stalled wheel or dead encoder; check both"
    RUNAWAY = "runaway: the wheel turns against its voltage; check the signs of motor and encoder"
    WRONG_WAY = (
        "runaway: the wheel turns against its set-point; check the signs of motor and encoder"
    )
    NOT_FOLLOWING = "the wheel does not follow its set-point; check load, supply and gains"
    OVER_CURRENT = "over-current: the current exceeds current_limit; check for a blocked wheel"
    COMPUTATION = "the controller cannot be computed with these parameters; correct them"


@dataclass(frozen=True, kw_only=True)
class FaultLimits:
    """Thresholds of the fault detector."""

    current_limit: float = described(
        0.0, "Current above which the motor is switched off [A]; 0: no limit."
    )
    current_time: float = described(0.1, "Time above the current limit before switch-off [s].")
    stall_voltage: float = described(4.0, "Voltage from which the wheel must turn [V].")
    stall_velocity: float = described(0.02, "Speed that counts as turning [rad/s, wheel].")
    stall_time: float = described(0.5, "Time without turning before switch-off [s]; 0: never.")
    runaway_time: float = described(
        0.2, "Time of turning against the voltage before switch-off [s]; 0: never."
    )
    tracking_tolerance: float = described(
        0.5, "Tolerated lasting error of the speed, as a share of the reference."
    )
    tracking_time: float = described(
        0.45, "Time of a larger tracking error before switch-off [s]; 0: never."
    )

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            check_positive(name, value, or_zero=True)


class FaultDetector:
    """Detect faults from voltage, speed and current of a driven motor."""

    def __init__(self, limits: FaultLimits, resistance: float = math.nan) -> None:
        self.limits = limits
        self.resistance = resistance
        # Of the wheel's model [V s/rad], [V]; NaN and 0 without a model
        self.volts_per_speed, self.static_voltage = math.nan, 0.0
        self._learnt_ratio = math.nan  # volts per speed [V s/rad]
        self._least_ratio = math.inf  # its minimum so far
        self.reset()

    def reset(self) -> None:
        """Discard all evidence."""
        self._motionless_time = self._opposing_time = self._over_current_time = 0.0
        self._opposing_speed = 0.0
        self._overload_time = 0.0
        self.overload: tuple[float, float] | None = None  # actual and needed voltage [V]
        self._begin_window(math.nan)

    def step(
        self, dt: float, voltage: float, velocity: float, current: float, *, stands: bool = False
    ) -> Fault | None:
        """Return the fault shown by one more sample; ``stands``: the reference is zero."""
        limits = self.limits
        if limits.current_limit > 0.0 and abs(current) > limits.current_limit:
            self._over_current_time += dt
            if self._over_current_time >= limits.current_time:
                return Fault.OVER_CURRENT
        else:
            self._over_current_time = 0.0
        driven = abs(voltage) >= limits.stall_voltage
        if driven and abs(velocity) < limits.stall_velocity:
            self._motionless_time += dt
            if self._motionless_time >= limits.stall_time > 0.0:
                return self._no_motion(voltage, current)
        else:
            self._motionless_time = 0.0
        # On a slope a wheel creeps until the voltage holds it.
        slowest = max(self.limits.stall_velocity, _MIN_ERROR if stands else 0.0)
        return self._runaway(dt, voltage, velocity, slowest)

    def _runaway(self, dt: float, voltage: float, velocity: float, slowest: float) -> Fault | None:
        """Return a fault when a wheel turns against its voltage without slowing down."""
        limits = self.limits
        against = voltage * velocity < 0.0 and abs(velocity) >= slowest
        if not against or abs(voltage) < 0.5 * limits.stall_voltage:
            self._opposing_time = 0.0
            return None
        if self._opposing_time == 0.0 or abs(velocity) < 0.8 * self._opposing_speed:
            self._opposing_time = 0.0
            self._opposing_speed = abs(velocity)
        self._opposing_time += dt
        return Fault.RUNAWAY if self._opposing_time >= limits.runaway_time > 0.0 else None

    def _no_motion(self, voltage: float, current: float) -> Fault:
        if math.isnan(current) or math.isnan(self.resistance):
            return Fault.NO_MOTION
        # At standstill R i = v.  A turning motor with high friction has a similar current, so the
        # message names both causes.
        if abs(current) * self.resistance > 0.85 * abs(voltage):
            return Fault.STALL
        return Fault.DEAD_ENCODER

    def _begin_window(self, before: float) -> None:
        self._before, self._elapsed, self._saturated = before, 0.0, True
        self._reference = self._speed = self._voltage = 0.0

    def follow(
        self, dt: float, reference: float, velocity: float, voltage: float, saturated: bool
    ) -> Fault | None:
        """Return a fault when the mean speed does not follow the mean reference.

        Two successive windows of a third of the tracking time must be off without improvement, so
        that neither noise nor acceleration counts as a fault.
        """
        self._reference += reference * dt
        self._speed += velocity * dt
        self._voltage += voltage * dt
        self._saturated = self._saturated and saturated
        self._elapsed = elapsed = self._elapsed + dt
        if 3.0 * elapsed < self.limits.tracking_time:
            return None
        asked, speed, before = self._reference / elapsed, self._speed / elapsed, self._before
        share = self.limits.tracking_tolerance
        if self._saturated:
            reachable = self._reachable(abs(self._voltage) / elapsed)
            share = max(share, _SATURATED_TOLERANCE) if reachable == math.inf else share
            asked = max(min(asked, reachable), -reachable)
        elif (
            abs(asked - speed)
            < _GOOD_TRACKING_SHARE * abs(speed)
            > _GOOD_TRACKING_SHARE * _MIN_ERROR
        ):
            self._learnt_ratio = abs(self._voltage / self._speed)
            self._least_ratio = min(self._least_ratio, self._learnt_ratio)
        self._judge_overload(abs(self._voltage) / elapsed, abs(speed), elapsed)
        error = abs(asked - speed)
        off = error > share * abs(asked) + _MIN_ERROR and self.limits.tracking_time > 0.0
        self._begin_window(speed if off else math.nan)
        stalled = self._motionless_time > 0.0 and self.limits.stall_time > 0.0
        way = abs(asked - before)  # NaN: the previous window was good
        if stalled or not (off and error > _MAX_REMAINING_SHARE * way):
            return None
        return Fault.WRONG_WAY if asked * speed < 0.0 else Fault.NOT_FOLLOWING

    def _judge_overload(self, voltage: float, speed: float, elapsed: float) -> None:
        """Compare a window's voltage with that needed by its speed, modelled or learnt."""
        per_speed = self.volts_per_speed if self.volts_per_speed > 0.0 else self._least_ratio
        needed = per_speed * speed + self.static_voltage if per_speed < math.inf else math.inf
        high = voltage > OVERLOAD_RATIO * needed + 0.75 * self.limits.stall_voltage
        self._overload_time = self._overload_time + elapsed if high else 0.0
        self.overload = (voltage, needed) if self._overload_time >= OVERLOAD_TIME_S else None

    def _reachable(self, voltage: float) -> float:
        """Return the steady speed at a voltage; infinite if unknown."""
        if self.volts_per_speed > 0.0:
            return max(voltage - self.static_voltage, 0.0) / self.volts_per_speed
        return voltage / self._learnt_ratio if self._learnt_ratio > 0.0 else math.inf


_FAULTS_WITHOUT_COUNTS = (Fault.STALL, Fault.DEAD_ENCODER, Fault.NO_MOTION)


class Recovery:
    """Hold a wheel at fault, retry it a few times, then latch it until a reset.

    A retry starts when the set-point has been zero for half a second, when a wheel without counts
    turns, or after a pause that doubles each time.  Its voltage is limited until the wheel has
    turned normally for :data:`TRUSTED_AFTER_S`.  After :data:`MAX_TRIES` the wheel is latched.
    """

    def __init__(self, first_pause: float = 2.0) -> None:
        self.first_pause = first_pause
        self.reset()

    def reset(self) -> None:
        """Clear all faults."""
        self.fault: Fault | None = None
        self.cautious = False  # whether a fault may still exist, so that the voltage is limited
        self.failures = 0  # since the wheel last turned normally
        self._since = self._good = 0.0

    @property
    def latched(self) -> bool:
        """Whether only :meth:`reset` releases the wheel."""
        return self.fault is not None and self.failures > MAX_TRIES

    def set(self, fault: Fault, now: float) -> None:
        """Hold the wheel because of a fault."""
        self.fault, self._since = fault, now
        self.cautious = True
        self.failures += 1
        self._good = 0.0

    def may_release(self, setpoint: float, now: float, turns: bool = False) -> bool:
        """Return whether a retry may start, and start it."""
        if self.failures > MAX_TRIES:
            return False
        waited = now - self._since
        pause = self.first_pause * 2.0 ** (self.failures - 1)
        alive = turns and self.fault in _FAULTS_WITHOUT_COUNTS
        rested = setpoint == 0.0 and waited > _RELEASE_TIME_S
        if alive or rested or (pause > 0.0 and waited > pause):
            self.fault = None
            return True
        return False

    def limit_voltage(
        self, voltage: float, velocity: float, dt: float, limits: FaultLimits
    ) -> float:
        """Return the limited voltage of a retry, and assess the wheel's motion."""
        if voltage * velocity > 0.0 and abs(velocity) > limits.stall_velocity:
            self._good += dt
        elif self._good < TRUSTED_AFTER_S:
            self._good = 0.0
        trusted = self._good >= TRUSTED_AFTER_S
        if self._good >= PROVEN_AFTER_S:
            self.reset()
        if trusted:
            return voltage
        most = _TRIAL_VOLTAGE_RATIO * limits.stall_voltage
        return min(max(voltage, -most), most)
