"""Decisions that keep a wheel safe: is this feedback new, does this motor behave, try again when.

Pure logic on numbers; times are seconds on a steady clock unless they are stamps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from smp_motor_control.errors import ParameterError

CLOCK_JUMP = 1.0
"""Stamps that are off by more than this [s] tell of a clock that jumped, not of a delay."""


class Verdict(Enum):
    """What a feedback sample is, by its stamp."""

    FRESH = "fresh"
    FIRST = "first after a start, a gap or a clock jump"
    DUPLICATE = "duplicate"
    REORDERED = "older than the one before"
    LATE = "late"


class FeedbackClock:
    """Tells the interval between feedback samples, and which of them to leave out.

    The stamps' clock and the computer's may differ by a constant: an offset beyond
    :data:`CLOCK_JUMP` is learnt at the start and after every jump, and lateness is counted
    from there.

    Parameters
    ----------
    max_age : float
        Largest time from stamp to arrival [s].
    max_gap : float
        Largest interval over which a loop may step [s].

    Attributes
    ----------
    dt : float
        Interval that ends with the last fresh sample [s].
    age : float
        From stamp to arrival of the last sample, less the offset of the clocks [s].
    counts : dict of Verdict to int
        How many samples were what.
    jumps : int
        How often the stamps' clock jumped.
    offset : float
        Learnt difference of the clocks [s].
    """

    def __init__(self, max_age: float, max_gap: float) -> None:
        self.max_age = max_age
        self.max_gap = max_gap
        self.counts = dict.fromkeys(Verdict, 0)
        self.jumps = 0
        self.offset = 0.0
        self.dt = 0.0
        self.age = 0.0
        self._last: int | None = None

    def reset(self) -> None:
        """Take the next sample as a first one."""
        self._last = None

    def accept(self, stamp: int, now: int) -> Verdict:
        """Judge a sample.

        Parameters
        ----------
        stamp : int
            Its stamp [ns]; 0 stands for the time of arrival.
        now : int
            Time of arrival on the same clock, as far as the clocks agree [ns].

        Returns
        -------
        Verdict
            Only ``FRESH`` samples have a ``dt``; ``FIRST`` ones start a new sequence.
        """
        verdict = self._judge(stamp or now, now)
        self.counts[verdict] += 1
        return verdict

    def _judge(self, stamp: int, now: int) -> Verdict:
        raw_age = (now - stamp) * 1e-9
        age = raw_age - self.offset
        last = self._last
        step = 0.0 if last is None else (stamp - last) * 1e-9
        if step < -CLOCK_JUMP or not -CLOCK_JUMP < age < CLOCK_JUMP:
            self.jumps += last is not None
            self.offset = raw_age if abs(raw_age) > CLOCK_JUMP else 0.0
            self.age = raw_age - self.offset
            self._last = stamp
            return Verdict.FIRST
        self.age = age
        if last is not None and step <= 0.0:
            return Verdict.DUPLICATE if step == 0.0 else Verdict.REORDERED
        self._last = stamp
        if age > self.max_age:
            return Verdict.LATE
        if last is None or step > self.max_gap:
            return Verdict.FIRST
        self.dt = step
        return Verdict.FRESH


class Fault(Enum):
    """What can be wrong with a motor that is being driven."""

    STALL = "stall (or dead encoder): no counts under voltage, current as at standstill"
    DEAD_ENCODER = "dead encoder (or stall): no counts under voltage, current as of a turning motor"
    NO_MOTION = "stall or dead encoder: no counts under voltage, and no current is measured to tell"
    RUNAWAY = "runaway: the wheel turns against its voltage (wrong sign of motor or encoder?)"
    OVER_CURRENT = "over-current"


@dataclass(frozen=True, kw_only=True)
class FaultLimits:
    """When a motor misbehaves.

    Attributes
    ----------
    current_limit : float
        [A]; 0 for none.
    current_time : float
        Time [s] above the limit before it counts.
    stall_voltage : float
        Least voltage [V] at which the wheel must turn.
    stall_velocity : float
        Least speed [rad/s, wheel] that counts as turning.
    stall_time : float
        Time [s] without turning before it counts; 0 switches the detection off.
    runaway_time : float
        Time [s] of turning the wrong way, without slowing down, before it counts; 0: off.

    Raises
    ------
    ParameterError
        When a value is negative or not finite.
    """

    current_limit: float = 0.0
    current_time: float = 0.1
    stall_voltage: float = 4.0
    stall_velocity: float = 0.02
    stall_time: float = 0.5
    runaway_time: float = 0.2

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 <= value < math.inf:
                raise ParameterError(f"{name} is {value!r}; it must be zero or positive")


class FaultDetector:
    """Watches voltage, speed and current of a driven motor.

    Parameters
    ----------
    limits : FaultLimits
        When it misbehaves.
    resistance : float
        Armature resistance [ohm], NaN where unknown; tells a stall from a dead encoder.
    """

    def __init__(self, limits: FaultLimits, resistance: float = math.nan) -> None:
        self.limits = limits
        self.resistance = resistance
        self.reset()

    def reset(self) -> None:
        """Forget what led here."""
        self._still = self._wrong = self._hot = 0.0
        self._wrong_speed = 0.0

    def step(self, dt: float, voltage: float, velocity: float, current: float) -> Fault | None:
        """Take in one sample.

        Parameters
        ----------
        dt : float
            Interval that ends with it [s].
        voltage : float
            That was asked for during the interval [V].
        velocity : float
            Of the wheel [rad/s].
        current : float
            [A]; NaN where not measured.

        Returns
        -------
        Fault or None
            The first that has lasted for its time.
        """
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
        return self._runaway(dt, voltage, velocity)

    def _runaway(self, dt: float, voltage: float, velocity: float) -> Fault | None:
        """Braking turns against the voltage too, but it slows down."""
        limits = self.limits
        against = voltage * velocity < 0.0 and abs(velocity) >= limits.stall_velocity
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


_SILENT = (Fault.STALL, Fault.DEAD_ENCODER, Fault.NO_MOTION)


class Latch:
    """Holds a fault until the wheel may be tried again.

    That is when the set-point is zero, when a wheel that gave no counts is seen to turn, or
    after a pause that doubles every time.

    Parameters
    ----------
    first_pause, longest_pause : float
        [s]; a first pause of 0 waits for a zero set-point for ever.

    Attributes
    ----------
    fault : Fault or None
        What holds the wheel.
    """

    def __init__(self, first_pause: float = 2.0, longest_pause: float = 30.0) -> None:
        self.fault: Fault | None = None
        self.first_pause = first_pause
        self._longest = longest_pause
        self._pause = 0.0
        self._since = 0.0
        self._released = -math.inf

    def set(self, fault: Fault, now: float) -> None:
        """Hold the wheel.

        Parameters
        ----------
        fault : Fault
            Why.
        now : float
            [s].
        """
        again = now - self._released < 10.0
        longer = min(2.0 * self._pause, self._longest)
        self._pause = longer if again else self.first_pause
        self.fault, self._since = fault, now

    def may_release(self, setpoint: float, now: float, turns: bool = False) -> bool:
        """Tell whether the wheel may be tried again, and let go of it if so.

        Parameters
        ----------
        setpoint : float
            Present one [rad/s].
        now : float
            [s].
        turns : bool
            Whether feedback shows the wheel turning.

        Returns
        -------
        bool
            Whether it has let go.
        """
        waited = now - self._since
        alive = turns and self.fault in _SILENT
        if (
            alive
            or (setpoint == 0.0 and waited > 0.5)
            or (self._pause > 0.0 and waited > self._pause)
        ):
            self.fault = None
            self._released = now
            return True
        return False
