# SPDX-License-Identifier: Apache-2.0
"""Controls the speed of one wheel.

A lifecycle node that activates itself by default.  It answers every ``motor_state`` with one step
of :class:`~smp_motor_control.wheel.controller.WheelController` and one ``motor_command``.  The
service ``~/reset`` releases a wheel that is latched by a fault.
"""

import contextlib
import gc
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from smp_interfaces.msg import MotorDescription, MotorState, PidState
from smp_motor_control import get_joint_name
from smp_motor_control.encoder import Encoder
from smp_motor_control.errors import ParameterError
from smp_motor_control.fields import fixed, nested
from smp_motor_control.motor.parameters import Gearbox
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.motor_writer import MotorWriter
from smp_motor_control.nodes.publishers import PublisherWatch, with_watch
from smp_motor_control.nodes.settings import Parameters
from smp_motor_control.nodes.wheel_report import WheelReport, pid_state
from smp_motor_control.wheel.controller import WheelController, WheelSettings


@dataclass(frozen=True, kw_only=True)
class Settings:
    joint_name: str = fixed("", "Joint to control; empty: <namespace>_wheel_joint.")
    autostart: bool = fixed(True, "Configure and activate at start.")
    wheel: WheelSettings = nested(WheelSettings())
    scheduling_priority: int = fixed(
        0, "SCHED_FIFO priority; 0: normal scheduler.", minimum=0, maximum=99
    )
    cpu_affinity: tuple[int, ...] = fixed((-1,), "Processors to run on; -1: any.")


_TIMER_PERIOD_S = 0.02
_SLOW_TICKS = 10
_SUCCESS = TransitionCallbackReturn.SUCCESS


class WheelPid(LifecycleNode):
    def __init__(self) -> None:
        super().__init__("wheel_pid")
        runtime.refuse_impossible_transitions(self)
        self._wheel = wheel = WheelController(WheelSettings())
        check = lambda settings: wheel.check(settings.wheel)  # noqa: E731
        self._ros_parameters = Parameters(self, Settings, self._on_change, check=check)
        settings = self._ros_parameters.settings
        self._robot, _, name = self.get_namespace().rpartition("/")
        self._joint = settings.joint_name or get_joint_name(name)
        if self._joint == get_joint_name(""):
            raise ParameterError(
                "joint_name is empty; set it, or a wheel's namespace: -r __ns:=/front_left"
            )
        self._on_change(settings)
        self._entities: list[Any] = []
        self._ticks = 0
        self._now, self._has_subscribers = time.time_ns, False

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create topics, reset service and diagnostics."""
        heard = runtime.STREAM_SUBSCRIBER
        self._writer = MotorWriter(self)
        self._pid_states = self.create_publisher(PidState, "pid_state", runtime.STREAM_PUBLISHER)
        listen = self.create_subscription
        self._states, self._setpoints = PublisherWatch(), PublisherWatch()
        asked = with_watch(self._setpoints, self._on_setpoint)
        self._entities = [
            (MotorWriter.destroy, self._writer),
            (self.destroy_publisher, self._pid_states),
            (self.destroy_subscription,
             listen(MotorState, "motor_state", self._on_motor_state, heard)),
            (self.destroy_subscription,
             listen(JointState, f"{self._robot}/wheel_setpoints", asked, heard)),
            (self.destroy_subscription,
             listen(MotorDescription, "motor_description", self._on_description, runtime.LATCHED)),
            (self.destroy_service, self.create_service(Trigger, "~/reset", self._on_reset)),
            (self.destroy_timer, runtime.steady_timer(self, _TIMER_PERIOD_S, self._on_timer)),
        ]  # fmt: skip
        watches = {"motor_state": self._states, f"{self._robot}/wheel_setpoints": self._setpoints}
        self._report = WheelReport(self, self._wheel, self._joint, watches)
        return _SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start answering feedback."""
        affinity = tuple(cpu for cpu in self.settings.cpu_affinity if cpu >= 0)
        priority = self.settings.scheduling_priority
        self._report.timekeeping = request_real_time(self, priority, affinity)
        self._wheel.activate(time.monotonic())
        self._report.update()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Send a zero command and stop answering feedback."""
        self.on_stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Send a zero command and destroy all entities."""
        self.on_stop()
        if self._entities:
            self._report.close()
        for destroy, entity in self._entities:
            destroy(entity)
        self._entities = []
        return _SUCCESS

    on_shutdown = on_error = on_cleanup

    def on_stop(self) -> None:
        """Send a zero command."""
        if self._wheel.active:
            self._wheel.deactivate()
            self._writer.stop()
            self._report.update()

    def _on_change(self, settings: Settings) -> None:
        self.settings = settings
        self._wheel.configure(settings.wheel)

    def _on_description(self, message: MotorDescription) -> None:
        try:
            gearbox = Gearbox(message.gear_ratio)
            encoder = Encoder(message.counts_per_revolution, message.encoder_bits)
            self._wheel.set_hardware(gearbox, encoder, message.supply_voltage, message.resistance)
        except ParameterError as error:
            self._wheel.refuse(f"motor_description: {error}")

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        fault = self._wheel.recovery.fault
        self._wheel.reset(time.monotonic())
        response.success = True
        response.message = fault.value if fault else "the wheel has no fault"
        return response

    def _on_setpoint(self, message: JointState) -> None:
        if self._joint not in message.name:
            return
        index = message.name.index(self._joint)
        if index >= len(message.velocity):
            self._wheel.refuse("set-point without a velocity")
            return
        stamp = message.header.stamp
        given = stamp.sec or stamp.nanosec
        age = self._now() * 1e-9 - stamp.sec - stamp.nanosec * 1e-9 if given else 0.0
        self._wheel.take_setpoint(message.velocity[index], time.monotonic(), age)

    def _on_motor_state(self, message: MotorState, info: Mapping[str, Any]) -> None:
        self._states.hear(info)
        wheel, stamp = self._wheel, message.header.stamp
        nanoseconds = runtime.nanoseconds(stamp)
        voltage = wheel.take_feedback(message, nanoseconds, self._now(), time.monotonic())
        if voltage is not None:
            self._writer.send(voltage, stamp)
            if self._has_subscribers and wheel.answer is not None:
                self._pid_states.publish(pid_state(wheel, self._joint, stamp))
        if wheel.state is not self._report.shown:
            self._report.update()

    def _on_timer(self) -> None:
        """Check for lost feedback and, less often, for subscribers, clock and publishers."""
        self._ticks += 1
        if self._ticks % _SLOW_TICKS == 0:
            self._has_subscribers = self._pid_states.get_subscription_count() > 0
            simulated = self.get_clock().ros_time_is_active
            self._now = self._ros_now if simulated else time.time_ns
            self._wheel.has_two_publishers = self._states.has_two_publishers
        self._wheel.owner = self._writer.owner
        voltage = self._wheel.tick(time.monotonic())
        if voltage is not None:
            self._writer.send(voltage)
        self._report.update()

    def _ros_now(self) -> int:
        return int(self.get_clock().now().nanoseconds)


def request_real_time(node: Node, priority: int, affinity: tuple[int, ...]) -> list[str]:
    """Request priority and affinity; return the refusals.

    Disables the garbage collector; the caller collects when it is safe.
    """
    asked: dict[str, Callable[[int], None]] = {}
    if priority > 0:
        asked[f"scheduling_priority {priority}"] = lambda thread: os.sched_setscheduler(
            thread, os.SCHED_FIFO, os.sched_param(priority)
        )
    if affinity:
        asked[f"cpu_affinity {list(affinity)}"] = lambda t: os.sched_setaffinity(t, affinity)
    refused = []
    for what, ask in asked.items():
        try:
            for thread in map(int, os.listdir("/proc/self/task")):  # also those of the middleware
                with contextlib.suppress(ProcessLookupError):
                    ask(thread)
        except (OSError, ValueError, OverflowError, AttributeError) as error:
            refused.append(f"{what} is not granted: {error}")
            node.get_logger().warning(f"{refused[-1]}; running without it")
    gc.collect()
    gc.freeze()
    gc.disable()
    return refused


def make_node() -> WheelPid:
    node = WheelPid()
    if node.settings.autostart:
        node.trigger_configure()
        node.trigger_activate()
    return node


main = partial(runtime.run, "wheel_pid", make_node)
