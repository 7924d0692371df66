# SPDX-License-Identifier: Apache-2.0
"""Controller of one wheel: events and time in; voltage and state out.

``now`` is in seconds on a monotonic clock.
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
from smp_motor_control.wheel.acceptance import OperatingConditions, check
from smp_motor_control.wheel.faults import Fault, FaultDetector, FaultLimits, Recovery
from smp_motor_control.wheel.freshness import FeedbackClock, Verdict
from smp_motor_control.wheel.loop import LoopSettings, WheelLoop
from smp_motor_control.wheel.oscillation import Oscillation
from smp_motor_control.wheel.stop import REST_SPEED, STANDSTILL_SETPOINT, StopRule

_MAX_SETPOINT = 1e4
_INTERVAL_SAMPLES = 20
_MAX_EVIDENCE_S = 0.1
"""Longest interval that counts as evidence of a fault: in a longer gap the driver may have timed
out."""
_STANDSTILL_OUTPUT = PidOutput(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False)
_FRESH, _FIRST, _LATE = Verdict.FRESH, Verdict.FIRST, Verdict.LATE


class State(Enum):
    """State of a wheel's controller, with its text for ``/diagnostics``."""

    INACTIVE = "not active"
    WAITING = "waiting for a set-point"
    DRIVING = "driving"
    TIMED_OUT = "set-point timed out: braking, then 0 V"
    NO_FEEDBACK = "no feedback: 0 V"
    LATE_FEEDBACK = "late feedback: 0 V"
    BAD_FEEDBACK = "feedback is not a number or implausible: ignored"
    TWO_PUBLISHERS = "two publishers of motor_state: 0 V"
    OWNED_ELSEWHERE = "rejected: another node owns this wheel: 0 V"
    ROLLING = "rolling at 0 V: after a fault the wheel is not braked until a non-zero set-point"
    FAULT = "fault: 0 V"


class Sample(Protocol):
    """Fields of ``MotorState`` that the controller reads."""

    voltage: float
    current: float
    velocity: float
    encoder_count: int


@dataclass(frozen=True, kw_only=True)
class WheelSettings:
    """Settings of a wheel's controller."""

    setpoint_timeout: float = described(
        0.5, "Time without a set-point after which the wheel is braked [s].", minimum=0.01,
        maximum=60.0,
    )  # fmt: skip
    feedback_timeout: float = described(
        0.2, "Time without feedback, or age of feedback, after which the voltage is zero [s].",
        minimum=0.005, maximum=10.0,
    )  # fmt: skip
    loop: LoopSettings = nested(LoopSettings())
    faults: FaultLimits = nested(FaultLimits())
    fault_retry: float = described(
        2.0, "Pause before a wheel at fault is retried at a non-zero set-point [s], doubled "
        "each time, at most three times; 0: only after a zero set-point.",
        minimum=0.0, maximum=3600.0,
    )  # fmt: skip
    implausible_velocity: float = described(
        1000.0, "Feedback beyond this speed is ignored [rad/s, wheel].", minimum=0.0
    )


class WheelController:
    """Controller of one wheel; ``output`` is the last commanded voltage [V]."""

    def __init__(self, settings: WheelSettings) -> None:
        self.loop = WheelLoop(settings.loop)
        self.recovery = Recovery()
        self.clock = FeedbackClock(math.inf, math.inf)
        self.refused: Counter[str] = Counter()  # ignored inputs and their numbers
        self.state = State.INACTIVE
        self.active = False  # whether feedback is answered
        self.answer: PidOutput | None = None  # terms of the last output, if computed by the loop
        self.owner = ""  # another node that owns the wheel
        self.has_two_publishers = False  # of feedback
        self.steps = 0
        self._wheel = OperatingConditions()
        self._intervals: list[float] = []
        self.target = self.measurement = 0.0  # at the last step [rad/s, wheel]
        self.supply = math.inf
        self._detector = FaultDetector(settings.faults)
        self.oscillation = Oscillation()
        self.configure(settings)
        self._discard_state(-math.inf)

    # Settings ------------------------------------------------------------------------------

    def check(self, settings: WheelSettings) -> None:
        """Raise for a change of settings that is unsafe for this wheel."""
        if settings.loop != self.settings.loop:
            check(settings.loop, self._wheel)

    def configure(self, settings: WheelSettings) -> None:
        """Change the settings without a jump of the voltage."""
        self.loop.configure(settings.loop.clamp_to_supply(self.supply))
        self.settings = settings
        self.advice = ""  # why the gains do not suit the sampling interval
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
        """Set the hardware between controller and wheel."""
        check_supply("supply_voltage", supply)
        if not math.isnan(resistance):
            check_range("resistance", resistance, 1e-6, 1e6, "ohm")
        self.settings.loop.clamp_to_supply(supply)
        self.supply = supply
        self.loop.set_hardware(gearbox, encoder, 1.5 * supply)
        self._wheel = replace(self._wheel, supply=supply, gearbox=gearbox, encoder=encoder)
        self.configure(self.settings)
        self._detector.resistance = resistance
        self.oscillation.set_count(gearbox.to_wheel(encoder.angle_per_count))

    # Life ----------------------------------------------------------------------------------

    def activate(self, now: float) -> None:
        """Start answering feedback and wait for the first set-point."""
        self.reset(now)
        self.active = True
        self.state = State.WAITING

    def deactivate(self) -> None:
        """Stop answering feedback; the caller sends a final 0 V."""
        self.active = False
        self.output = 0.0
        self.answer = None
        self.state = State.INACTIVE

    def reset(self, now: float) -> None:
        """Restart without faults, as an operator requests."""
        self._discard_state(now)
        self.recovery.reset()

    def _discard_state(self, now: float) -> None:
        self.setpoint: float | None = None  # [rad/s]
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
        """Accept a set-point [rad/s]; an invalid one does not restart the time-out."""
        if not -_MAX_SETPOINT <= value <= _MAX_SETPOINT:
            self.refuse("set-point that is not a number or implausible")
        elif age > self.settings.setpoint_timeout:
            self.refuse("set-point older than its time-out")
        else:
            # The feed-forward of friction is the same however small the set-point is.
            self.setpoint = value if abs(value) > STANDSTILL_SETPOINT else 0.0
            self._setpoint_at = now
            self._stop.note_setpoint(value, now)

    def take_feedback(self, sample: Sample, stamp: int, arrival: int, now: float) -> float | None:
        """Process a sample with its stamp and arrival [ns]; return the voltage [V] or None."""
        self.answer = None
        verdict = self.clock.accept(stamp, arrival, now)
        if verdict is not _FRESH:
            return self._handle_irregular_sample(verdict, now)
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
                if self.loop.source == "measured":
                    self.refuse("feedback speed that jumps")
                else:
                    self.refuse("feedback count that jumps")
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
        except (ArithmeticError, ValueError) as error:  # by parameters that passed the checks
            self.refuse(f"computation: {type(error).__name__}")
            self.loop.rebuild_speed_source()
            return self._trip(Fault.COMPUTATION, now) if self.active else None

    def tick(self, now: float) -> float | None:
        """Check for lost feedback; return 0 V while it is lost, else None."""
        if self.clock.dt and len(self._intervals) < _INTERVAL_SAMPLES:
            self._learn_interval(self.clock.dt)
        since = now - self.settings.feedback_timeout
        if not self.active or self._feedback_at >= since:
            return None
        self._resume = True
        if self._late_at >= since:
            return self._command_zero(State.LATE_FEEDBACK)
        return self._command_zero(
            State.BAD_FEEDBACK if self._bad_at >= since else State.NO_FEEDBACK
        )

    def _learn_interval(self, dt: float) -> None:
        """Check the gains again when the sampling interval is known."""
        self._intervals.append(dt)
        if len(self._intervals) == _INTERVAL_SAMPLES:
            self._wheel = replace(self._wheel, sample_time=median(self._intervals))
            try:
                check(self.settings.loop, self._wheel)
            except ParameterError as error:
                self.advice = str(error)

    @property
    def overload(self) -> tuple[float, float] | None:
        """Actual voltage and the voltage that the speed needs [V], for a wheel under overload."""
        return self._detector.overload if self.state is State.DRIVING else None

    def refuse(self, what: str) -> None:
        """Count an ignored input."""
        self.refused[what] += 1

    # Decisions -----------------------------------------------------------------------------

    def _command_zero(self, state: State | None = None) -> float:
        if state is not None:
            self.state = state
        self.output = 0.0
        return 0.0

    def _handle_irregular_sample(self, verdict: Verdict, now: float) -> float | None:
        if verdict is _FIRST:
            self.loop.reset_speed()
        elif verdict is _LATE:
            self._late_at = now
        else:
            return None
        self._resume = True
        if not self.active:
            return None
        return self._command_zero(State.LATE_FEEDBACK if verdict is _LATE else None)

    def _drive(self, current: float, measurement: float, dt: float, now: float) -> float:
        setpoint = self._current_setpoint(measurement, now)
        recovery = self.recovery
        if recovery.fault is not None:
            turns = abs(measurement) > self.settings.faults.stall_velocity
            if not recovery.may_release(setpoint or 0.0, now, turns):
                return self._command_zero(State.FAULT)
        kept = bool(self.owner) or self.has_two_publishers
        if setpoint is None or kept or (recovery.cautious and setpoint == 0.0):
            self._resume = True
            if setpoint == 0.0 and not kept:
                self.loop.reference = self.loop.reference._replace(velocity=0.0)
                self.answer, self.target, self.measurement = _STANDSTILL_OUTPUT, 0.0, measurement
            return self._command_zero(self._idle_state(setpoint, measurement))
        loop, detector = self.loop, self._detector
        if self._resume:
            self._resume = False
            loop.start(measurement)
            detector.reset()
            self.oscillation.reset()
            self.output = 0.0
        evidence = dt if dt < _MAX_EVIDENCE_S else _MAX_EVIDENCE_S
        stands = self._stop.is_zero and loop.reference.velocity == 0.0
        fault = detector.step(evidence, self.output, measurement, current, stands=stands)
        if fault is not None:
            return self._trip(fault, now)
        if self._stop.is_zero:
            self._end_drive(evidence, measurement, now)
        out = loop.step(setpoint, measurement, dt)
        voltage = out.output
        if voltage - voltage != 0.0:
            self.refuse("output that is not a number")
            return self._command_zero()
        if recovery.cautious:
            voltage = recovery.limit_voltage(voltage, measurement, dt, self.settings.faults)
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
        """Enforce the stop rule: end reference and integral of a wheel past its stop time."""
        loop = self.loop
        is_overdue = self._stop.is_overdue(now, self.settings.loop.stop_time)
        if abs(loop.reference.velocity) > STANDSTILL_SETPOINT:
            driven = self.output * measurement > 0.0 and abs(measurement) > REST_SPEED
            if is_overdue:
                loop.halt()
        else:
            driven = self._stop.is_driven(dt, self.output, measurement)
        if is_overdue and driven:
            loop.pid.reset()
            self._stop.watch()
            self.refuse("integral that drove the wheel past stop_time")

    def _idle_state(self, setpoint: float | None, measurement: float) -> State:
        """Return the state of a wheel at 0 V without a fault."""
        if setpoint is None:
            return State.WAITING if self._setpoint_at == -math.inf else State.TIMED_OUT
        if self.has_two_publishers:
            return State.TWO_PUBLISHERS
        if self.owner:
            return State.OWNED_ELSEWHERE
        return State.ROLLING if abs(measurement) > REST_SPEED else State.DRIVING

    def _current_setpoint(self, measurement: float, now: float) -> float | None:
        """Return the set-point after time-out and stop rule; None for an uncontrolled wheel."""
        if self.setpoint is None:
            return None
        settings = self.settings
        silent = now - self._setpoint_at - settings.setpoint_timeout
        self._expired = silent > 0.0
        if not self._expired:
            return self.setpoint
        self._stop.note_setpoint(0.0, now - silent)
        stopped = self.loop.reference.velocity == 0.0 and abs(measurement) < REST_SPEED
        if stopped or self._stop.is_overdue(now, settings.loop.stop_time):
            self.setpoint = None
            return None
        return 0.0

    def _trip(self, fault: Fault, now: float) -> float:
        self.recovery.set(fault, now)
        self._resume = True
        return self._command_zero(State.FAULT)
