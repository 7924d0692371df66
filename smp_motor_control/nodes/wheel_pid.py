"""Controls the speed of one wheel: set-points and feedback in, volts out.

A lifecycle node that starts by itself.  It answers every ``motor_state`` with one step of
:class:`~smp_motor_control.wheel.controller.WheelController` and one ``motor_command``;
``~/reset`` releases a wheel that is latched by a fault.
"""

from __future__ import annotations

import time
from typing import Any

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from smp_interfaces.msg import MotorCommand, MotorDescription, MotorState, PidState
from smp_motor_control.encoder import Encoder
from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.parameters import Gearbox
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.settings import Parameters
from smp_motor_control.nodes.wheel_report import WheelReport
from smp_motor_control.nodes.wheel_settings import Settings
from smp_motor_control.wheel.controller import WheelController

_WATCH_PERIOD = 0.02
_SELDOM = 10
_DONE = TransitionCallbackReturn.SUCCESS


class WheelPid(LifecycleNode):
    """One wheel's controller."""

    def __init__(self) -> None:
        super().__init__("wheel_pid")
        runtime.refuse_impossible_transitions(self)
        self._given = Parameters(self, Settings, self._change)
        self.settings = settings = self._given.settings
        self._joint = settings.joint_name or f"{runtime.wheel_of(self)}_wheel_joint"
        if self._joint == "_wheel_joint":
            raise ParameterError(
                "wheel_pid needs joint_name, or a wheel's namespace: -r __ns:=/front_left"
            )
        self._wheel = WheelController(settings.wheel)
        self._entities: list[Any] = []
        self._index = self._watches = 0
        self._now, self._watched = time.time_ns, False

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create topics, the reset service and diagnostics."""
        self._command, self._pid_state = MotorCommand(), PidState()
        self._command.header.frame_id = self._pid_state.header.frame_id = self._joint
        sent, heard = runtime.STREAM_PUBLISHER, runtime.STREAM_SUBSCRIBER
        self._publisher = self.create_publisher(MotorCommand, "motor_command", sent)
        self._state_publisher = self.create_publisher(PidState, "pid_state", sent)
        listen = self.create_subscription
        self._entities = [
            (self.destroy_publisher, self._publisher),
            (self.destroy_publisher, self._state_publisher),
            (self.destroy_subscription, listen(MotorState, "motor_state", self._hear, heard)),
            (self.destroy_subscription,
             listen(JointState, runtime.robot_topic(self, "wheel_setpoints"), self._ask, heard)),
            (self.destroy_subscription,
             listen(MotorDescription, "motor_description", self._describe, runtime.LATCHED)),
            (self.destroy_service, self.create_service(Trigger, "~/reset", self._reset)),
            (self.destroy_timer, runtime.steady_timer(self, _WATCH_PERIOD, self._watch)),
        ]  # fmt: skip
        self._report = WheelReport(self, self._wheel, self._joint)
        return _DONE

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Answer feedback from now on; the wheel waits for its first set-point."""
        affinity = tuple(cpu for cpu in self.settings.cpu_affinity if cpu >= 0)
        priority = self.settings.scheduling_priority
        self._report.timekeeping = runtime.keep_time(self, priority, affinity)
        self._wheel.activate(time.monotonic())
        self._report.update()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Send a zero command and fall silent."""
        self.on_stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Destroy what was configured, after a zero command."""
        self.on_stop()
        if self._entities:
            self._report.close()
        for destroy, entity in self._entities:
            destroy(entity)
        self._entities = []
        return _DONE

    on_shutdown = on_error = on_cleanup

    def on_stop(self) -> None:
        """Send a zero command, as before the process ends."""
        if self._wheel.active:
            self._wheel.deactivate()
            self._command.voltage = 0.0
            self._command.header.stamp = self.get_clock().now().to_msg()
            runtime.send_last(self._publisher, self._command)
            self._report.update()

    def _change(self, settings: Settings) -> None:
        self.settings = settings
        self._wheel.configure(settings.wheel)

    def _describe(self, message: MotorDescription) -> None:
        try:
            gearbox = Gearbox(message.gear_ratio)
            encoder = Encoder(message.counts_per_revolution, message.encoder_bits)
            self._wheel.set_hardware(gearbox, encoder, message.supply_voltage, message.resistance)
        except ParameterError as error:
            self._wheel.refuse(f"motor_description: {error}")

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        fault = self._wheel.recovery.fault
        self._wheel.reset(time.monotonic())
        response.success = True
        response.message = fault.value if fault else "there was no fault"
        return response

    def _ask(self, message: JointState) -> None:
        names, index = message.name, self._index
        if index >= len(names) or names[index] != self._joint:
            if self._joint not in names:
                return
            self._index = index = names.index(self._joint)
        if index >= len(message.velocity):
            self._wheel.refuse("set-point without a velocity")
            return
        stamp = message.header.stamp
        given = stamp.sec or stamp.nanosec
        age = self._now() * 1e-9 - stamp.sec - stamp.nanosec * 1e-9 if given else 0.0
        self._wheel.take_setpoint(message.velocity[index], time.monotonic(), age)

    def _hear(self, message: MotorState) -> None:
        wheel, stamp = self._wheel, message.header.stamp
        nanoseconds = stamp.sec * 1_000_000_000 + stamp.nanosec
        voltage = wheel.take_feedback(message, nanoseconds, self._now(), time.monotonic())
        if voltage is not None:
            self._send(voltage, stamp)
            if self._watched and wheel.answer is not None:
                self._show(stamp)
        self._report.update()

    def _send(self, voltage: float, stamp: Any) -> None:
        command = self._command
        command.header.stamp = stamp
        command.voltage = voltage
        self._publisher.publish(command)

    def _show(self, stamp: Any) -> None:
        state, wheel, out = self._pid_state, self._wheel, self._wheel.answer
        state.header.stamp = stamp
        state.setpoint, state.reference = wheel.target, wheel.loop.reference.velocity
        state.measurement = wheel.measurement
        state.error = state.reference - state.measurement
        state.output, state.unsaturated = wheel.output, out.unsaturated
        state.p_term, state.i_term, state.d_term = out.p_term, out.i_term, out.d_term
        state.feedforward, state.saturated = out.feedforward, wheel.output != out.unsaturated
        state.dt, state.age = wheel.clock.dt, wheel.clock.age
        self._state_publisher.publish(state)

    def _watch(self) -> None:
        """Look for lost feedback, and now and then for what changes seldom."""
        self._watches += 1
        if self._watches % _SELDOM == 0:
            self._watched = self._state_publisher.get_subscription_count() > 0
            simulated = self.get_clock().ros_time_is_active
            self._now = self._ros_now if simulated else time.time_ns
        voltage = self._wheel.tick(time.monotonic())
        if voltage is not None:
            self._send(voltage, self.get_clock().now().to_msg())
        self._report.update()

    def _ros_now(self) -> int:
        return int(self.get_clock().now().nanoseconds)


def _make() -> WheelPid:
    node = WheelPid()
    if node.settings.autostart:
        node.trigger_configure()
        node.trigger_activate()
    return node


def main(argv: list[str] | None = None) -> int:
    """Run the node until a signal; the exit code is that of the process."""
    return runtime.run("wheel_pid", _make, argv)
