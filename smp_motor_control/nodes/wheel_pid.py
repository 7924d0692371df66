"""Controls the speed of one wheel: set-points and feedback in, volts out.

A lifecycle node that starts by itself.  It answers every ``motor_state`` with one PID step
and one ``motor_command``; without a set-point, without feedback, and under a fault the
command is zero.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import JointState

from smp_interfaces.msg import MotorCommand, MotorDescription, MotorState, PidState
from smp_motor_control.encoder import Encoder
from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.friction import Gearbox
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.settings import Parameters
from smp_motor_control.nodes.wheel_report import (
    DRIVING,
    INACTIVE,
    LATE_FEEDBACK,
    TIMED_OUT,
    WAITING,
    WheelReport,
)
from smp_motor_control.nodes.wheel_settings import Settings
from smp_motor_control.pid import PidOutput
from smp_motor_control.wheel.loop import WheelLoop
from smp_motor_control.wheel.supervision import Fault, FaultDetector, FeedbackClock, Latch, Verdict

_LARGEST_SETPOINT = 1e4
_FRESH, _FIRST, _LATE = Verdict.FRESH, Verdict.FIRST, Verdict.LATE
_AT_REST = 0.05
_WATCH_PERIOD = 0.02
_SELDOM = 10


class WheelPid(LifecycleNode):
    """One wheel's controller."""

    def __init__(self) -> None:
        super().__init__("wheel_pid")
        runtime.refuse_impossible_transitions(self)
        self._given = Parameters(self, Settings, self._change)
        self._settings = settings = self._given.settings
        self._joint = settings.joint_name or f"{runtime.wheel_of(self)}_wheel_joint"
        if self._joint == "_wheel_joint":
            raise ParameterError(
                "wheel_pid needs joint_name, or a wheel's namespace: -r __ns:=/front_left"
            )
        self._active = False
        self._configured = False
        self._supply = math.inf
        self._loop = WheelLoop(settings.loop)
        self._detector = FaultDetector(settings.faults)
        self._latch = Latch(settings.fault_retry)
        self._feedback = FeedbackClock(settings.feedback_timeout, settings.feedback_timeout)
        self._forget()
        self._report = WheelReport(self._feedback, self._latch, self._values)
        self._steps = 0
        self._now: Callable[[], int] = time.time_ns

    def _forget(self) -> None:
        """Begin as before the first set-point."""
        self._setpoint: float | None = None
        self._setpoint_at = self._feedback_at = -math.inf
        self._expired = False
        self._resume = True
        self._cautious = False
        self._output = 0.0
        self._index = 0
        self._feedback.reset()
        self._loop.reset_speed()

    # Lifecycle -----------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create topics and diagnostics."""
        self._command = MotorCommand()
        self._command.header.frame_id = self._joint
        self._pid_state = PidState()
        self._pid_state.header.frame_id = self._joint
        self._publisher = self.create_publisher(
            MotorCommand, "motor_command", runtime.STREAM_PUBLISHER
        )
        self._state_publisher = self.create_publisher(
            PidState, "pid_state", runtime.STREAM_PUBLISHER
        )
        self._watched = False
        self._watches = 0
        stream = runtime.STREAM_SUBSCRIBER
        self._topics = [
            self.create_subscription(MotorState, "motor_state", self._on_state, stream),
            self.create_subscription(JointState, "/wheel_setpoints", self._on_setpoints, stream),
            self.create_subscription(
                MotorDescription, "motor_description", self._on_description, runtime.LATCHED
            ),
        ]
        self._timer = runtime.steady_timer(self, _WATCH_PERIOD, self._watch)
        self._report.open(self, self._joint)
        self._configured = True
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Answer feedback from now on; the wheel waits for its first set-point."""
        self._forget()
        self._latch.fault = None
        self._detector.reset()
        affinity = tuple(cpu for cpu in self._settings.cpu_affinity if cpu >= 0)
        self._report.timekeeping = runtime.keep_time(
            self, self._settings.scheduling_priority, affinity
        )
        self._active = True
        self._feedback_at = time.monotonic()
        self._report.enter(WAITING)
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Send a zero command and fall silent."""
        self._silence()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Destroy what was configured."""
        self._silence()
        self._destroy()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Send a zero command for good."""
        self._silence()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Send a zero command and go back to unconfigured."""
        self._silence()
        self._destroy()
        return TransitionCallbackReturn.SUCCESS

    def on_stop(self) -> None:
        """Send a zero command before the process ends."""
        self._silence()

    def _silence(self) -> None:
        if self._active:
            self._active = False
            self._output = self._command.voltage = 0.0
            self._command.header.stamp = self.get_clock().now().to_msg()
            runtime.send_last(self._publisher, self._command)
            self._report.enter(INACTIVE)

    def _destroy(self) -> None:
        if self._configured:
            self._configured = False
            for topic in self._topics:
                self.destroy_subscription(topic)
            self._report.close()
            self.destroy_timer(self._timer)
            self.destroy_publisher(self._publisher)
            self.destroy_publisher(self._state_publisher)

    # Parameters and hardware ---------------------------------------------------------------

    def _change(self, settings: Settings) -> None:
        self._settings = settings
        self._loop.configure(settings.loop.within(self._supply))
        self._detector.limits = settings.faults
        self._latch.first_pause = settings.fault_retry
        clock = self._feedback
        clock.max_age = clock.max_gap = settings.feedback_timeout

    def _on_description(self, message: MotorDescription) -> None:
        try:
            gearbox = Gearbox(message.gear_ratio)
            encoder = Encoder(message.counts_per_revolution, message.encoder_bits)
            supply = message.supply_voltage
            if not 0.0 < supply < math.inf:
                raise ParameterError(f"supply_voltage is {supply!r} V; it must be positive")
            self._loop.configure(self._settings.loop.within(supply))
            self._supply = supply
        except ParameterError as error:
            self._report.refuse(f"motor_description: {error}")
            return
        self._loop.set_hardware(gearbox, encoder, 1.5 * supply)
        self._detector.resistance = message.resistance

    # Set-points ----------------------------------------------------------------------------

    def _on_setpoints(self, message: JointState) -> None:
        names, index = message.name, self._index
        if index >= len(names) or names[index] != self._joint:
            if self._joint not in names:
                return
            self._index = index = names.index(self._joint)
        if index >= len(message.velocity):
            self._report.refuse("set-point without a velocity")
            return
        value = message.velocity[index]
        if not -_LARGEST_SETPOINT <= value <= _LARGEST_SETPOINT:
            self._report.refuse("set-point that is not a number or absurd")
            return
        stamp = message.header.stamp
        if stamp.sec or stamp.nanosec:
            age = self._now() * 1e-9 - stamp.sec - stamp.nanosec * 1e-9
            if age > self._settings.setpoint_timeout:
                self._report.refuse("set-point that is out of date by its stamp")
                return
        self._setpoint = value
        self._setpoint_at = time.monotonic()

    # Feedback ------------------------------------------------------------------------------

    def _on_state(self, message: MotorState) -> None:
        stamp = message.header.stamp
        now = self._now()
        clock = self._feedback
        verdict = clock.accept(stamp.sec * 1_000_000_000 + stamp.nanosec, now)
        if verdict is not _FRESH:
            self._not_fresh(verdict)
            return
        velocity = message.velocity
        limit = self._settings.implausible_velocity
        dt = clock.dt
        voltage = message.voltage
        if not -limit <= velocity <= limit:
            self._report.refuse("feedback velocity that is not a number or implausible")
            return
        if voltage - voltage != 0.0:
            voltage = self._output
        measurement = self._loop.speed(dt, velocity, message.encoder_count, voltage)
        if not -limit <= measurement <= limit:
            if measurement == measurement:
                self._report.refuse("feedback count that jumps")
                self._loop.reset_speed()
            return
        steady = time.monotonic()
        self._feedback_at = steady
        if self._active:
            self._answer(message, measurement, dt, steady)

    def _not_fresh(self, verdict: Verdict) -> None:
        if verdict is _FIRST:
            self._loop.reset_speed()
            self._resume = True
            self._send_zero()
        elif verdict is _LATE:
            self._resume = True
            if self._active:
                self._send_zero()
                self._report.enter(LATE_FEEDBACK)

    def _answer(self, message: MotorState, measurement: float, dt: float, steady: float) -> None:
        setpoint = self._present_setpoint(measurement, steady)
        if self._latch.fault is not None and not self._released(setpoint, measurement, steady):
            self._send_zero()
            return
        if setpoint is None:
            self._resume = True
            self._send_zero()
            self._report.enter(WAITING if self._setpoint_at == -math.inf else TIMED_OUT)
            return
        if self._resume:
            self._resume = False
            self._loop.start(measurement)
            self._detector.reset()
        fault = self._detector.step(dt, self._output, measurement, message.current)
        if fault is not None:
            self._trip(fault, steady)
            return
        out = self._loop.step(setpoint, measurement, dt)
        if out.output - out.output != 0.0:
            self._report.refuse("output that is not a number")
            self._send_zero()
            return
        voltage = out.output
        if self._cautious:
            voltage = self._with_caution(voltage, measurement)
        self._send(voltage, message)
        self._steps += 1
        self._report.enter(TIMED_OUT if self._expired else DRIVING)
        if self._watched:
            self._tell(message, setpoint, measurement, dt, out)

    def _present_setpoint(self, measurement: float, steady: float) -> float | None:
        """Return what the wheel is to do now; None when it is to be left alone."""
        if self._setpoint is None:
            return None
        if steady - self._setpoint_at <= self._settings.setpoint_timeout:
            self._expired = False
            return self._setpoint
        self._expired = True
        loop = self._loop
        stopped = loop.reference.velocity == 0.0 and abs(measurement) < _AT_REST
        braked_for = steady - self._setpoint_at - self._settings.setpoint_timeout
        if stopped or braked_for > 1.0 + 2.0 * self._settings.transition_time:
            self._setpoint = None
            return None
        return 0.0

    def _released(self, setpoint: float | None, measurement: float, steady: float) -> bool:
        """Tell whether a wheel at fault may be tried again, and then do so with caution."""
        turns = abs(measurement) > self._settings.faults.stall_velocity
        if not self._latch.may_release(setpoint or 0.0, steady, turns):
            return False
        self._cautious = True
        return True

    def _with_caution(self, voltage: float, measurement: float) -> float:
        """Limit the voltage of a wheel after a fault until it turns the way it is driven."""
        faults = self._settings.faults
        if voltage * measurement > 0.0 and abs(measurement) > faults.stall_velocity:
            self._cautious = False
            return voltage
        limit = 1.05 * faults.stall_voltage
        return min(max(voltage, -limit), limit)

    def _trip(self, fault: Fault, steady: float) -> None:
        self._latch.set(fault, steady)
        self._resume = True
        self._send_zero()
        self._report.enter(fault.value)
        self.get_logger().error(f"{fault.value}; 0 V")

    def _send(self, voltage: float, message: MotorState) -> None:
        self._output = voltage
        command = self._command
        command.header.stamp = message.header.stamp
        command.voltage = voltage
        self._publisher.publish(command)

    def _send_zero(self) -> None:
        if not self._active:
            return
        self._output = 0.0
        self._command.header.stamp = self.get_clock().now().to_msg()
        self._command.voltage = 0.0
        self._publisher.publish(self._command)

    def _tell(
        self, message: MotorState, setpoint: float, measurement: float, dt: float, out: PidOutput
    ) -> None:
        state = self._pid_state
        reference = self._loop.reference.velocity
        state.header.stamp = message.header.stamp
        state.setpoint = setpoint
        state.reference = reference
        state.measurement = measurement
        state.error = reference - measurement
        state.output, state.unsaturated = self._output, out.unsaturated
        state.p_term, state.i_term, state.d_term = out.p_term, out.i_term, out.d_term
        state.feedforward, state.saturated = out.feedforward, self._output != out.unsaturated
        state.dt = dt
        state.age = self._feedback.age
        self._state_publisher.publish(state)

    # Watching ------------------------------------------------------------------------------

    def _watch(self) -> None:
        """Look for lost feedback, and now and then for what changes seldom."""
        self._watches += 1
        if self._watches % _SELDOM == 0:
            self._watched = self._state_publisher.get_subscription_count() > 0
            simulated = self.get_clock().ros_time_is_active
            self._now = self._simulated_now if simulated else time.time_ns
        if not self._active:
            return
        if time.monotonic() - self._feedback_at > self._settings.feedback_timeout:
            self._resume = True
            self._send_zero()
            self._report.enter_silence()

    def _simulated_now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _values(self) -> dict[str, object]:
        clock = self._feedback
        return {
            "steps": self._steps,
            "set-point [rad/s]": "none" if self._setpoint is None else self._setpoint,
            "output [V]": self._output,
            "speed source": self._loop.source,
            "feedback dt [s]": clock.dt,
            "feedback age [s]": clock.age,
            "offset of the feedback's clock [s]": clock.offset,
        }


def _make() -> WheelPid:
    node = WheelPid()
    if node._settings.autostart:
        node.trigger_configure()
        node.trigger_activate()
    return node


def main(argv: list[str] | None = None) -> int:
    """Run the node until a signal.

    Parameters
    ----------
    argv : list of str, optional
        Arguments; those of the process where None.

    Returns
    -------
    int
        Exit code.
    """
    return runtime.run("wheel_pid", _make, argv)
