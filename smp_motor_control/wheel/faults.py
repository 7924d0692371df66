"""Which motor misbehaves, and how often and how gently it may be tried again.

Pure logic on numbers; times are seconds on a steady clock.
"""

import math
from dataclasses import dataclass
from enum import Enum

from smp_motor_control.errors import check_positive
from smp_motor_control.fields import described

MOST_TRIES = 3
"""How often a wheel at fault is tried again before only a person may reset it."""

PROVEN_AFTER = 2.0
"""Time of turning as driven after which a fault is over, and its tries are forgotten [s]."""

TRUSTED_AFTER = 0.6
"""Time of turning as driven after which a try may use the full voltage [s]: what does not follow
is found before."""

_ZERO_RELEASES = 0.5
"""Time for which a set-point of zero must stand before it releases a wheel [s]."""

_CAUTION = 1.05
"""Largest voltage of a try, in the voltage at which the wheel must turn."""

_SLOWEST = 0.3
"""Error that is never a fault [rad/s]: one count at 1 kHz is 0.19 at the wheel of the paper."""

_IMPROVING = 0.95
"""Of its way to the reference a wheel that accelerates has less than this left a window later."""

_SATURATED = 0.7
"""Tolerated share of a set-point that the voltage may not suffice for, where that is unknown."""

STRAIN, STRAIN_LASTS = 1.5, 1.5
"""Times the voltage that its speed takes a wheel gets that is strained, and for how long [s]."""

_GOOD = 0.1
"""Share of the speed within which a wheel follows well enough to learn its volts per speed."""


class Fault(Enum):
    """What can be wrong with a wheel that is being driven."""

    STALL = "no counts under voltage: stall (or dead encoder)"
    DEAD_ENCODER = "no counts under voltage: dead encoder (or stall)"
    NO_MOTION = "no counts under voltage: stall or dead encoder"
    RUNAWAY = "runaway: the wheel turns against its voltage (wrong sign of motor or encoder?)"
    WRONG_WAY = "runaway: the wheel turns against its set-point (wrong sign of motor or encoder?)"
    NOT_FOLLOWING = "the wheel does not follow its set-point"
    OVER_CURRENT = "over-current"
    COMPUTATION = "the controller cannot compute with these parameters"


@dataclass(frozen=True, kw_only=True)
class FaultLimits:
    """When a motor misbehaves."""

    current_limit: float = described(
        0.0, "Current above which the motor is switched off [A]; 0 for none."
    )
    current_time: float = described(0.1, "Time above the limit before that [s].")
    stall_voltage: float = described(4.0, "Least voltage at which the wheel must turn [V].")
    stall_velocity: float = described(0.02, "Least speed that counts as turning [rad/s, wheel].")
    stall_time: float = described(
        0.5, "Time without turning before the motor is switched off [s]; 0: never."
    )
    runaway_time: float = described(
        0.2, "Time of turning against the voltage before that [s]; 0: never."
    )
    tracking_tolerance: float = described(
        0.5, "Tolerated lasting error of the speed, as a share of the reference."
    )
    tracking_time: float = described(
        0.45, "Time of being off by more before the motor is switched off [s]; 0: never."
    )

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            check_positive(name, value, or_zero=True)


class FaultDetector:
    """Watches voltage, speed and current of a driven motor."""

    def __init__(self, limits: FaultLimits, resistance: float = math.nan) -> None:
        self.limits = limits
        self.resistance = resistance
        # Of the wheel [V s/rad], [V], where a model says; NaN and 0 where it is to be learnt.
        self.volts_per_speed, self.static_voltage = math.nan, 0.0
        self._learnt = math.nan
        self._least = math.inf  # least volts per speed of a wheel that followed
        self.reset()

    def reset(self) -> None:
        """Forget what led here."""
        self._still = self._wrong = self._hot = 0.0
        self._wrong_speed = 0.0
        self._strained = 0.0
        self.strain: tuple[float, float] | None = None  # voltage in force, and that would do [V]
        self._begin_window(math.nan)

    def step(
        self, dt: float, voltage: float, velocity: float, current: float, *, stands: bool = False
    ) -> Fault | None:
        """Take in one sample, of a wheel whose reference is zero where it ``stands``."""
        limits = self.limits
        if limits.current_limit > 0.0 and abs(current) > limits.current_limit:
            self._hot += dt
            if self._hot >= limits.current_time:
                return Fault.OVER_CURRENT
        else:
            self._hot = 0.0
        driven = abs(voltage) >= limits.stall_voltage
        if driven and abs(velocity) < limits.stall_velocity:
            self._still += dt
            if self._still >= limits.stall_time > 0.0:
                return self._no_motion(voltage, current)
        else:
            self._still = 0.0
        # A slope makes a wheel creep until the voltage holds it.
        slowest = max(self.limits.stall_velocity, _SLOWEST if stands else 0.0)
        return self._runaway(dt, voltage, velocity, slowest)

    def _runaway(self, dt: float, voltage: float, velocity: float, slowest: float) -> Fault | None:
        """Return a fault where a wheel turns against its voltage and, unlike a braked one, on."""
        limits = self.limits
        against = voltage * velocity < 0.0 and abs(velocity) >= slowest
        if not against or abs(voltage) < 0.5 * limits.stall_voltage:
            self._wrong = 0.0
            return None
        if self._wrong == 0.0 or abs(velocity) < 0.8 * self._wrong_speed:
            self._wrong = 0.0
            self._wrong_speed = abs(velocity)
        self._wrong += dt
        return Fault.RUNAWAY if self._wrong >= limits.runaway_time > 0.0 else None

    def _no_motion(self, voltage: float, current: float) -> Fault:
        if math.isnan(current) or math.isnan(self.resistance):
            return Fault.NO_MOTION
        # At standstill all voltage drives current, R i = v.  A turning motor takes less, but one
        # whose friction eats all of its torque not much less: the name tells the other cause too.
        if abs(current) * self.resistance > 0.85 * abs(voltage):
            return Fault.STALL
        return Fault.DEAD_ENCODER

    def _begin_window(self, before: float) -> None:
        self._before, self._elapsed, self._saturated = before, 0.0, True
        self._reference = self._speed = self._voltage = 0.0

    def follow(
        self, dt: float, reference: float, velocity: float, voltage: float, saturated: bool
    ) -> Fault | None:
        """Compare speed and reference, each by its mean over a third of the tracking time.

        Two windows in succession must be off, and the speed of the second no nearer to its
        reference than that of the first, so that neither noise nor a wheel that still accelerates
        is taken for a fault.
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
            share = max(share, _SATURATED) if reachable == math.inf else share
            asked = max(min(asked, reachable), -reachable)
        elif abs(asked - speed) < _GOOD * abs(speed) > _GOOD * _SLOWEST:
            self._learnt = abs(self._voltage / self._speed)
            self._least = min(self._least, self._learnt)
        self._judge_strain(abs(self._voltage) / elapsed, abs(speed), elapsed)
        error = abs(asked - speed)
        off = error > share * abs(asked) + _SLOWEST and self.limits.tracking_time > 0.0
        self._begin_window(speed if off else math.nan)
        stalled = self._still > 0.0 and self.limits.stall_time > 0.0
        way = abs(asked - before)  # NaN: the window before was good
        if stalled or not (off and error > _IMPROVING * way):
            return None
        return Fault.WRONG_WAY if asked * speed < 0.0 else Fault.NOT_FOLLOWING

    def _judge_strain(self, voltage: float, speed: float, elapsed: float) -> None:
        """Compare a window's voltage with what its speed takes, by a model or as it once did."""
        per_speed = self.volts_per_speed if self.volts_per_speed > 0.0 else self._least
        needed = per_speed * speed + self.static_voltage if per_speed < math.inf else math.inf
        high = voltage > STRAIN * needed + 0.75 * self.limits.stall_voltage
        self._strained = self._strained + elapsed if high else 0.0
        self.strain = (voltage, needed) if self._strained >= STRAIN_LASTS else None

    def _reachable(self, voltage: float) -> float:
        """Return the speed for which a voltage suffices; infinite where that is not known."""
        if self.volts_per_speed > 0.0:
            return max(voltage - self.static_voltage, 0.0) / self.volts_per_speed
        return voltage / self._learnt if self._learnt > 0.0 else math.inf


_SILENT = (Fault.STALL, Fault.DEAD_ENCODER, Fault.NO_MOTION)


class Recovery:
    """Holds a wheel at fault, lets it be tried a few times, and then waits for a person.

    A try begins when the set-point has been zero for half a second, when a wheel that gave
    no counts is seen to turn, or after a pause that doubles every time.  It is limited to a
    small voltage until the wheel has turned as driven for :data:`TRUSTED_AFTER`, and drives
    nothing at a set-point of zero.  After :data:`MOST_TRIES` the wheel is latched.
    """

    def __init__(self, first_pause: float = 2.0) -> None:
        self.first_pause = first_pause
        self.reset()

    def reset(self) -> None:
        """Begin anew, as after a person has looked at the wheel."""
        self.fault: Fault | None = None  # what holds the wheel
        self.cautious = False  # whether the voltage is limited, as the fault may still be there
        self.failures = 0  # since the wheel was last proven sound
        self._since = self._good = 0.0

    @property
    def latched(self) -> bool:
        """Whether only :meth:`reset` lets the wheel go."""
        return self.fault is not None and self.failures > MOST_TRIES

    def set(self, fault: Fault, now: float) -> None:
        """Hold the wheel."""
        self.fault, self._since = fault, now
        self.cautious = True
        self.failures += 1
        self._good = 0.0

    def may_release(self, setpoint: float, now: float, turns: bool = False) -> bool:
        """Tell whether the wheel may be tried again, and let go of it if so."""
        if self.failures > MOST_TRIES:
            return False
        waited = now - self._since
        pause = self.first_pause * 2.0 ** (self.failures - 1)
        alive = turns and self.fault in _SILENT
        rested = setpoint == 0.0 and waited > _ZERO_RELEASES
        if alive or rested or (pause > 0.0 and waited > pause):
            self.fault = None
            return True
        return False

    def limited(self, voltage: float, velocity: float, dt: float, limits: FaultLimits) -> float:
        """Return the voltage of a try, and learn from how the wheel turns."""
        if voltage * velocity > 0.0 and abs(velocity) > limits.stall_velocity:
            self._good += dt
        elif self._good < TRUSTED_AFTER:
            self._good = 0.0
        trusted = self._good >= TRUSTED_AFTER
        if self._good >= PROVEN_AFTER:
            self.reset()
        if trusted:
            return voltage
        most = _CAUTION * limits.stall_voltage
        return min(max(voltage, -most), most)
