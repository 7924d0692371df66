"""One wheel's controller: events and the time in; voltage, state and what was refused out.

It knows no clock and no ROS.  ``now`` is seconds on a clock that never jumps.
"""

import math
from collections import Counter
from dataclasses import dataclass, replace
from enum import Enum
from statistics import median
from typing import Protocol

from smp_motor_control.encoder import Encoder
from smp_motor_control.errors import ParameterError, check_range
from smp_motor_control.fields import described, nested
from smp_motor_control.motor.parameters import Gearbox, check_supply
from smp_motor_control.pid import PidOutput
from smp_motor_control.wheel.acceptance import Circumstances, check
from smp_motor_control.wheel.faults import Fault, FaultDetector, FaultLimits, Recovery
from smp_motor_control.wheel.freshness import FeedbackClock, Verdict
from smp_motor_control.wheel.loop import LoopSettings, WheelLoop
from smp_motor_control.wheel.oscillation import Oscillation
from smp_motor_control.wheel.stop import AT_REST, STANDING, StopRule

_LARGEST_SETPOINT = 1e4
_LEARNING = 20
_EVIDENCE = 0.1
"""Of a longer gap between samples no more counts against the wheel [s]: the driver may have
switched off by its own time-out meanwhile."""
_STANDS = PidOutput(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False)
_FRESH, _FIRST, _LATE = Verdict.FRESH, Verdict.FIRST, Verdict.LATE


class State(Enum):
    """What a wheel's controller is doing."""

    INACTIVE = "not active"
    WAITING = "waiting for a set-point"
    DRIVING = "driving"
    TIMED_OUT = "set-point timed out: braked, then 0 V"
    NO_FEEDBACK = "no feedback: 0 V"
    LATE_FEEDBACK = "feedback is late: 0 V"
    BAD_FEEDBACK = "feedback is not a number or implausible: left out"
    DOUBLED = "two publishers of motor_state: 0 V"
    NOT_OURS = "not yours: another node drives this wheel: 0 V"
    ROLLING = "rolls at 0 V: a wheel that was at fault is not braked until it is asked to turn"
    FAULT = "fault: 0 V"


class Sample(Protocol):
    """What the controller reads of a ``MotorState``."""

    voltage: float
    current: float
    velocity: float
    encoder_count: int


@dataclass(frozen=True, kw_only=True)
class WheelSettings:
    """Everything that shapes a wheel's controller."""

    setpoint_timeout: float = described(
        0.5, "Silence of set-points after which the wheel is braked [s].", minimum=0.01,
        maximum=60.0,
    )  # fmt: skip
    feedback_timeout: float = described(
        0.2, "Silence or age of feedback after which the voltage is zero [s].",
        minimum=0.005, maximum=10.0,
    )  # fmt: skip
    loop: LoopSettings = nested(LoopSettings())
    faults: FaultLimits = nested(FaultLimits())
    fault_retry: float = described(
        2.0, "Pause before a wheel at fault is tried again under a set-point that is not zero "
        "[s], doubled every time, three times at most; 0: only after a zero set-point.",
        minimum=0.0, maximum=3600.0,
    )  # fmt: skip
    implausible_velocity: float = described(
        1000.0, "Feedback beyond this speed is left out [rad/s, wheel].", minimum=0.0
    )


class WheelController:
    """Decides the voltage of one wheel: ``output`` [V] is what was last asked for."""

    def __init__(self, settings: WheelSettings) -> None:
        self.loop = WheelLoop(settings.loop)
        self.recovery = Recovery()
        self.clock = FeedbackClock(math.inf, math.inf)
        self.refused: Counter[str] = Counter()  # what was left out, and how often
        self.state = State.INACTIVE
        self.active = False  # whether it answers feedback
        self.answer: PidOutput | None = None  # the last one's parts, where it was the loop's
        self.owner = ""  # another node that owns the wheel by its lease
        self.doubled = False  # whether two publishers say what the wheel does
        self.steps = 0
        self._wheel = Circumstances()
        self._intervals: list[float] = []
        self.target = self.measurement = 0.0  # of that answer [rad/s, wheel]
        self.supply = math.inf
        self._detector = FaultDetector(settings.faults)
        self.oscillation = Oscillation()
        self.configure(settings)
        self._forget(-math.inf)

    # Settings ------------------------------------------------------------------------------

    def check(self, settings: WheelSettings) -> None:
        """Refuse a change of settings with which this wheel should not be driven."""
        if settings.loop != self.settings.loop:
            check(settings.loop, self._wheel)

    def configure(self, settings: WheelSettings) -> None:
        """Change the settings while running, without a jump of the voltage."""
        self.loop.configure(settings.loop.within(self.supply))
        self.settings = settings
        self.advice = ""  # why the gains do not suit the interval of the feedback
        self._detector.limits = settings.faults
        gains = settings.loop.gains
        self._detector.volts_per_speed = gains.feedforward_velocity
        self._detector.static_voltage = gains.feedforward_static
        self.recovery.first_pause = settings.fault_retry
        if self.recovery.fault is Fault.COMPUTATION:
            self.recovery.reset()
        self.clock.max_age = self.clock.max_gap = settings.feedback_timeout

    def set_hardware(
        self, gearbox: Gearbox, encoder: Encoder, supply: float, resistance: float = math.nan
    ) -> None:
        """Learn what is between motor and wheel."""
        check_supply("supply_voltage", supply)
        if not math.isnan(resistance):
            check_range("resistance", resistance, 1e-6, 1e6, "ohm")
        self.settings.loop.within(supply)
        self.supply = supply
        self.loop.set_hardware(gearbox, encoder, 1.5 * supply)
        self._wheel = replace(self._wheel, supply=supply, gearbox=gearbox, encoder=encoder)
        self.configure(self.settings)
        self._detector.resistance = resistance
        self.oscillation.set_count(gearbox.to_wheel(encoder.angle_per_count))

    # Life ----------------------------------------------------------------------------------

    def activate(self, now: float) -> None:
        """Answer feedback from now on; the wheel waits for its first set-point."""
        self.reset(now)
        self.active = True
        self.state = State.WAITING

    def deactivate(self) -> None:
        """Fall silent; the caller sends a last zero."""
        self.active = False
        self.output = 0.0
        self.answer = None
        self.state = State.INACTIVE

    def reset(self, now: float) -> None:
        """Begin as before the first set-point, without faults: a person has looked at it."""
        self._forget(now)
        self.recovery.reset()

    def _forget(self, now: float) -> None:
        self.setpoint: float | None = None  # as it holds now [rad/s]
        self._setpoint_at = -math.inf
        self._feedback_at = now
        self._late_at = self._bad_at = -math.inf
        self._stop = StopRule()
        self._expired = False
        self._resume = True
        self.output = 0.0
        self.answer = None
        self.clock.reset()

    # Events --------------------------------------------------------------------------------

    def take_setpoint(self, value: float, now: float, age: float = 0.0) -> None:
        """Take in a set-point; one that is no number does not count as a sign of life."""
        if not -_LARGEST_SETPOINT <= value <= _LARGEST_SETPOINT:
            self.refuse("set-point that is not a number or absurd")
        elif age > self.settings.setpoint_timeout:
            self.refuse("set-point that is out of date by its stamp")
        else:
            self.setpoint = value
            self._setpoint_at = now
            self._stop.ask(value, now)

    def take_feedback(self, sample: Sample, stamp: int, arrival: int, now: float) -> float | None:
        """Take in a sample, stamped and arrived at [ns]; return its answer [V] or None."""
        self.answer = None
        verdict = self.clock.accept(stamp, arrival, now)
        if verdict is not _FRESH:
            return self._not_fresh(verdict, now)
        velocity, voltage, dt = sample.velocity, sample.voltage, self.clock.dt
        limit = self.settings.implausible_velocity
        if not -limit <= velocity <= limit:
            self._bad_at = now
            self.refuse("feedback velocity that is not a number or implausible")
            return None
        if voltage - voltage != 0.0:
            voltage = self.output
        try:
            before = self.loop.jumps
            measurement = self.loop.speed(dt, velocity, sample.encoder_count, voltage)
            if self.loop.jumps > before:
                self._bad_at = now
                self.refuse("feedback speed that jumps")
                return None
            if not -limit <= measurement <= limit:
                if measurement == measurement:
                    self._bad_at = now
                    self.refuse("feedback count that jumps")
                    self.loop.reset_speed()
                return None
            self._feedback_at = now
            if not self.active:
                return None
            return self._drive(sample.current, measurement, dt, now)
        except (ArithmeticError, ValueError) as error:  # of parameters that no check foresaw
            self.refuse(f"computation: {type(error).__name__}")
            self.loop.renew_speed()
            return self._trip(Fault.COMPUTATION, now) if self.active else None

    def tick(self, now: float) -> float | None:
        """Look for feedback that has ceased; return 0 V while there is none."""
        if self.clock.dt and len(self._intervals) < _LEARNING:
            self._learn(self.clock.dt)
        since = now - self.settings.feedback_timeout
        if not self.active or self._feedback_at >= since:
            return None
        self._resume = True
        if self._late_at >= since:
            return self._zero(State.LATE_FEEDBACK)
        return self._zero(State.BAD_FEEDBACK if self._bad_at >= since else State.NO_FEEDBACK)

    def _learn(self, dt: float) -> None:
        """Judge the gains once more when the usual interval of the feedback is known."""
        self._intervals.append(dt)
        if len(self._intervals) == _LEARNING:
            self._wheel = replace(self._wheel, sample_time=median(self._intervals))
            try:
                check(self.settings.loop, self._wheel)
            except ParameterError as error:
                self.advice = str(error)

    @property
    def strain(self) -> tuple[float, float] | None:
        """Voltage of a wheel that turns too slowly for it, and what its speed takes [V]."""
        return self._detector.strain if self.state is State.DRIVING else None

    def refuse(self, what: str) -> None:
        """Count something that was left out."""
        self.refused[what] += 1

    # Decisions -----------------------------------------------------------------------------

    def _zero(self, state: State | None = None) -> float:
        if state is not None:
            self.state = state
        self.output = 0.0
        return 0.0

    def _not_fresh(self, verdict: Verdict, now: float) -> float | None:
        if verdict is _FIRST:
            self.loop.reset_speed()
        elif verdict is _LATE:
            self._late_at = now
        else:
            return None
        self._resume = True
        if not self.active:
            return None
        return self._zero(State.LATE_FEEDBACK if verdict is _LATE else None)

    def _drive(self, current: float, measurement: float, dt: float, now: float) -> float:
        setpoint = self._present_setpoint(measurement, now)
        recovery = self.recovery
        if recovery.fault is not None:
            turns = abs(measurement) > self.settings.faults.stall_velocity
            if not recovery.may_release(setpoint or 0.0, now, turns):
                return self._zero(State.FAULT)
        kept = bool(self.owner) or self.doubled
        if setpoint is None or kept or (recovery.cautious and setpoint == 0.0):
            self._resume = True
            if setpoint == 0.0 and not kept:  # obeyed, without the loop
                self.loop.reference = self.loop.reference._replace(velocity=0.0)
                self.answer, self.target, self.measurement = _STANDS, 0.0, measurement
            return self._zero(self._idle(setpoint, measurement))
        loop, detector = self.loop, self._detector
        if self._resume:
            self._resume = False
            loop.start(measurement)
            detector.reset()
            self.oscillation.reset()
            self.output = 0.0
        evidence = dt if dt < _EVIDENCE else _EVIDENCE
        stands = self._stop.asked and loop.reference.velocity == 0.0
        fault = detector.step(evidence, self.output, measurement, current, stands=stands)
        if fault is not None:
            return self._trip(fault, now)
        if self._stop.asked:
            self._end_drive(evidence, measurement, now)
        out = loop.step(setpoint, measurement, dt)
        voltage = out.output
        if voltage - voltage != 0.0:
            self.refuse("output that is not a number")
            return self._zero()
        if recovery.cautious:
            voltage = recovery.limited(voltage, measurement, dt, self.settings.faults)
        saturated = voltage != out.unsaturated
        reference = loop.reference.velocity
        fault = detector.follow(evidence, reference, measurement, voltage, saturated)
        if fault is not None:
            return self._trip(fault, now)
        self.oscillation.add(evidence, reference, measurement)
        self.output, self.answer = voltage, out
        self.target, self.measurement = setpoint, measurement
        self.steps += 1
        self.state = State.TIMED_OUT if self._expired else State.DRIVING
        return voltage

    def _end_drive(self, dt: float, measurement: float, now: float) -> None:
        """Take away what still drives a wheel that was asked to stand long enough ago."""
        loop = self.loop
        overdue = self._stop.overdue(now, self.settings.loop.stop_time)
        if abs(loop.reference.velocity) > STANDING:
            driven = self.output * measurement > 0.0 and abs(measurement) > AT_REST
            if overdue:
                loop.halt()
        else:
            driven = self._stop.is_driven(dt, self.output, measurement)
        if overdue and driven:
            loop.pid.reset()
            self._stop.watch()
            self.refuse("integral that drove the wheel past stop_time")

    def _idle(self, setpoint: float | None, measurement: float) -> State:
        """Return why a wheel without a fault is left at zero."""
        if setpoint is None:
            return State.WAITING if self._setpoint_at == -math.inf else State.TIMED_OUT
        if self.doubled:
            return State.DOUBLED
        if self.owner:
            return State.NOT_OURS
        return State.ROLLING if abs(measurement) > AT_REST else State.DRIVING

    def _present_setpoint(self, measurement: float, now: float) -> float | None:
        """Return what the wheel is to do now; None when it is to be left alone."""
        if self.setpoint is None:
            return None
        settings = self.settings
        silent = now - self._setpoint_at - settings.setpoint_timeout
        self._expired = silent > 0.0
        if not self._expired:
            return self.setpoint
        self._stop.ask(0.0, now - silent)
        stopped = self.loop.reference.velocity == 0.0 and abs(measurement) < AT_REST
        if stopped or self._stop.overdue(now, settings.loop.stop_time):
            self.setpoint = None
            return None
        return 0.0

    def _trip(self, fault: Fault, now: float) -> float:
        self.recovery.set(fault, now)
        self._resume = True
        return self._zero(State.FAULT)
