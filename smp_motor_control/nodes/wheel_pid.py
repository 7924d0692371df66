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
from smp_motor_control.nodes.publishers import (
    PublisherWatch,
    describe_two_publishers,
    with_watch,
)
from smp_motor_control.nodes.settings import Parameters
from smp_motor_control.pid import PidGains
from smp_motor_control.wheel.controller import State, WheelController, WheelSettings
from smp_motor_control.wheel.freshness import Verdict


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


_LEVELS = {
    State.WAITING: runtime.OK,
    State.DRIVING: runtime.OK,
    State.INACTIVE: runtime.OK,
    State.TIMED_OUT: runtime.WARN,
    State.OWNED_ELSEWHERE: runtime.WARN,
    State.ROLLING: runtime.WARN,
}
_TERMS = ("p_term", "i_term", "d_term", "feedforward", "unsaturated")
UNTUNED_TEXT = (
    "default gains: p is 1 V s/rad, i and d are 0, which suit no particular motor; start it with "
    "--params-file gains.yaml, which tune writes"
)

UNSTAMPED_TEXT = (
    "motor_state has no stamp, so its delay is unknown; the driver must set the time of sampling"
)


def has_default_gains(gains: PidGains) -> bool:
    """Return whether the gains are the defaults."""
    return (gains.p, gains.i, gains.d) == (PidGains().p, PidGains().i, PidGains().d)


class WheelReport:
    """Assess one wheel for ``/diagnostics`` every second and on state changes."""

    def __init__(
        self,
        node: Node,
        wheel: WheelController,
        joint: str,
        watches: Mapping[str, PublisherWatch] | None = None,
    ) -> None:
        self.timekeeping: list[str] = []
        self._wheel, self._node, self._watches = wheel, node, watches or {}
        self._reported: dict[str, int] = {}
        self.shown: State | None = None
        self._log = node.get_logger()
        self._diagnostics = runtime.Diagnostics(node, self._assess, joint)
        if has_default_gains(wheel.settings.loop.gains):
            self._log.warning(UNTUNED_TEXT)

    def close(self) -> None:
        self._diagnostics.destroy()

    def update(self) -> None:
        """Publish at once after a change of state."""
        if self._wheel.state is not self.shown:
            self.shown = self._wheel.state
            if self.shown is State.FAULT:
                self._log.error(f"{self._describe_state()[1]}; 0 V")
            self._diagnostics.publish()

    def _totals(self) -> dict[str, int]:
        """Return the number of irregular events since the start, by kind."""
        clock = self._wheel.clock
        usual = (Verdict.FRESH, Verdict.FIRST)
        totals = {v.value: n for v, n in clock.counts.items() if v not in usual}
        return {**totals, "clock jumps": clock.jumps, **self._wheel.refused}

    def _describe_state(self) -> tuple[bytes, str]:
        wheel = self._wheel
        fault = wheel.recovery.fault
        if fault is not None and wheel.state is not State.INACTIVE:
            ending = "; latched: call ~/reset" if wheel.recovery.latched else ""
            return runtime.ERROR, fault.value + ending
        more = f" ({wheel.owner})" if wheel.state is State.OWNED_ELSEWHERE else ""
        if wheel.state is State.NO_FEEDBACK and wheel.clock.gap:
            more = (
                f"; motor_state came {wheel.clock.gap:.3g} s after the previous one, and "
                f"feedback_timeout is {wheel.settings.feedback_timeout:g} s: raise it for "
                "such slow feedback"
            )
        return _LEVELS.get(wheel.state, runtime.ERROR), wheel.state.value + more

    def _describe_oscillation(self) -> str:
        """Return the message about an oscillation around the set-point; else nothing."""
        wheel, found = self._wheel, self._wheel.oscillation.found
        if found is None or wheel.state is not State.DRIVING:
            return ""
        rate = 1.0 / wheel.clock.dt if wheel.clock.dt else 0.0
        return (
            f"the speed oscillates by {found.amplitude:.2g} rad/s around {wheel.target:.2g} rad/s "
            f"at {found.frequency:.2g} Hz: the gains are too high for feedback at {rate:.0f} Hz; "
            f"halve p, i and d, or design them with tune --rate {rate:.0f}"
        )

    def _describe_overload(self) -> str:
        """Return the message about a wheel under overload; else nothing."""
        overload = self._wheel.overload
        if overload is None:
            return ""
        return (
            f"the wheel gets {overload[0]:.2g} V for {abs(self._wheel.measurement):.2g} rad/s and "
            f"should need {overload[1]:.2g} V: a heavy load, or an encoder that loses counts; "
            "check both before the motor overheats"
        )

    def _assess(self) -> tuple[bytes, str, Mapping[str, object]]:
        level, message = self._describe_state()
        totals = self._totals()
        recent = {key: n - self._reported.get(key, 0) for key, n in totals.items()}
        listed = ", ".join(f"{n} x {key}" for key, n in recent.items() if n)
        if listed:
            message = f"{message}; in the last second: {listed}"
            level = max(level, runtime.WARN)
        wheel, clock = self._wheel, self._wheel.clock
        warnings = (
            wheel.advice,
            self._describe_oscillation(),
            self._describe_overload(),
            wheel.loop.wraps_at
            and f"encoder_count wraps at {wheel.loop.wraps_at} bits, unlike motor_description: "
            "correct its encoder_bits",
            *(describe_two_publishers(self._node, topic) for topic, one in self._watches.items()
              if one.has_two_publishers),
            clock.unstamped and UNSTAMPED_TEXT,
        )  # fmt: skip
        advice = [text for text in warnings if text]
        if advice:
            level = max(level, runtime.WARN)
        if has_default_gains(wheel.settings.loop.gains):
            advice.append(UNTUNED_TEXT)
        if self._diagnostics.due:
            self._reported = totals
            gc.collect()
        values: dict[str, object] = {
            "steps": wheel.steps,
            "set-point [rad/s]": "none" if wheel.setpoint is None else wheel.setpoint,
            "output [V]": wheel.output,
            "speed source": wheel.loop.source,
            "feedback dt [s]": clock.dt,
            "feedback age [s]": clock.age,
            "offset of the feedback's clock [s]": clock.offset,
            "faults since the wheel was sound": wheel.recovery.failures,
        }
        return level, "; ".join([message, *self.timekeeping, *advice]), {**values, **totals}


def pid_state(wheel: WheelController, joint: str, stamp: Any) -> PidState:
    """Return the controller's last step as a message."""
    out, reference = wheel.answer, wheel.loop.reference.velocity
    state = PidState(
        setpoint=wheel.target,
        reference=reference,
        measurement=wheel.measurement,
        error=reference - wheel.measurement,
        **{name: getattr(out, name) for name in _TERMS},
        output=wheel.output,
        saturated=wheel.output != out.unsaturated,
        dt=wheel.clock.dt,
        age=wheel.clock.age,
    )
    state.header.stamp, state.header.frame_id = stamp, joint
    return state


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
