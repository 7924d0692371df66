"""Makes one wheel oscillate under a relay, bounded in voltage and time.

The tool ``tune --relay`` starts it as a process of its own.  The wheel's controller is
deactivated for the time of the test and activated again.  First a constant voltage shows the
speed to oscillate around, then the relay switches around it.  One line of JSON at the end:
``time`` [s] from the stamps, ``voltage`` [V] that was asked for after each sample, ``applied``
[V, mean over the interval before the sample, None where the hardware does not tell], ``speed``
[rad/s, wheel] and ``angle`` [rad, wheel, None where it does not tell], all around their rest; or
``error``.  Whatever ends it, the last command is zero.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

import rclpy
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.node import Node

from smp_interfaces.msg import MotorCommand, MotorState
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.asking import Asker, AskError

PATIENCE = 8.0
"""Longest wait for the wheel and its controller; on a busy machine discovery takes seconds [s]."""

SETTLE = 1.5
"""How long the constant voltage acts; its last half second tells the speed [s]."""


MOST_BETWEEN = 0.5
"""Share of samples at whose voltage the relay never is, above which someone else commands."""


class RelayTest(Node):
    """The relay of one wheel.

    Parameters
    ----------
    wheel : str
        Name of the wheel.
    bias, amplitude : float
        The relay switches between ``bias - amplitude`` and ``bias + amplitude`` [V].
    hysteresis : float
        The speed must pass this on either side before it switches [rad/s, wheel].
    """

    def __init__(self, wheel: str, bias: float, amplitude: float, hysteresis: float) -> None:
        super().__init__("relay_test")
        self.wheel, self.bias, self.amplitude = wheel, bias, amplitude
        self.hysteresis = hysteresis
        self.centre: float | None = None
        self.output = 0.0
        self.begun: float | None = None
        self.stamps: list[float] = []
        self.speeds: list[float] = []
        self.voltages: list[float] = []
        self.applied: list[float] = []
        self.angles: list[float] = []
        self.heard = self.paused = False
        self.asker = Asker(self, self.spin, 0.5)
        self.command = self.create_publisher(
            MotorCommand, f"/{wheel}/motor_command", runtime.STREAM_PUBLISHER
        )
        self.create_subscription(
            MotorState, f"/{wheel}/motor_state", self._answer, runtime.STREAM_SUBSCRIBER
        )

    def _answer(self, message: MotorState) -> None:
        speed = message.velocity
        self.heard = True
        if self.begun is None or not math.isfinite(speed):
            return
        if self.centre is None:
            self.output = self.bias
        elif speed > self.centre + self.hysteresis:
            self.output = self.bias - self.amplitude
        elif speed < self.centre - self.hysteresis:
            self.output = self.bias + self.amplitude
        self.stamps.append(runtime.seconds(message.header.stamp))
        self.speeds.append(speed)
        self.voltages.append(self.output)
        self.applied.append(message.voltage)
        self.angles.append(message.position)
        self.send(self.output)

    def send(self, voltage: float) -> None:
        """Command a voltage."""
        message = MotorCommand(voltage=voltage)
        message.header.stamp = self.get_clock().now().to_msg()
        self.command.publish(message)

    def run(self, seconds: float) -> dict[str, Any]:
        """Do the test; return what is to be printed."""
        self.begun = time.monotonic()
        self.spin(lambda: False, SETTLE)
        if not self.paused and self.has_rival():  # discovered late, on a busy machine
            trouble = self.take_over()
            if trouble:
                return {"error": trouble}
            self.spin(lambda: False, SETTLE)
        if len(self.speeds) < 20:
            return {"error": f"/{self.wheel}/motor_state: {len(self.speeds)} samples in {SETTLE} s"}
        late = [v for t, v in zip(self.stamps, self.speeds, strict=True)
                if t > self.stamps[-1] - 0.5]  # fmt: skip
        self.centre = sum(late) / len(late)
        first = len(self.speeds)
        self.output = self.bias + self.amplitude
        self.spin(lambda: False, seconds)
        applied = [v - self.bias for v in self.applied[first:]]
        # A relay is at one of its levels but for the samples in which it switches.
        between = sum(abs(abs(v) - self.amplitude) > 0.1 * self.amplitude for v in applied)
        if between > MOST_BETWEEN * len(applied):
            return {
                "error": f"/{self.wheel}/motor_command: what acts on the wheel is not what the "
                "relay asks for; does someone else command it?"
            }
        times = [t - self.stamps[first] for t in self.stamps[first:]]
        angles = [
            a - self.angles[first] - self.centre * t
            for a, t in zip(self.angles[first:], times, strict=True)
        ]
        return {
            "time": times,
            "voltage": [v - self.bias for v in self.voltages[first:]],
            "applied": applied if all(map(math.isfinite, applied)) else None,
            "speed": [v - self.centre for v in self.speeds[first:]],
            "angle": angles if all(map(math.isfinite, angles)) else None,
        }

    def spin(self, done: Callable[[], bool], seconds: float) -> bool:
        """Spin until a condition holds; return whether it did in time."""
        end = time.monotonic() + seconds
        while not done():
            left = end - time.monotonic()
            if left <= 0:
                return False
            rclpy.spin_once(self, timeout_sec=min(left, 0.05))
        return True

    def take_over(self) -> str:
        """Wait for the wheel and pause its controller; return what is in the way, or nothing."""
        state = f"/{self.wheel}/motor_state"
        if not self.spin(lambda: self.heard, PATIENCE):
            return f"{state}: nothing within {PATIENCE:g} s; does the hardware's driver run?"
        # Who is discovered together with the wheel is not so at the same instant.
        self.spin(self.has_rival, 1.0)
        if not self.has_rival():
            return ""
        before = self.state()
        self.paused = before == State.PRIMARY_STATE_ACTIVE
        if before is None or (self.paused and not self.switch(Transition.TRANSITION_DEACTIVATE)):
            return (
                f"/{self.wheel}/motor_command: someone else commands the wheel, and is no "
                "wheel_pid that can be paused; end it first"
            )
        return ""

    def has_rival(self) -> bool:
        """Return whether someone else commands the wheel."""
        return self.count_publishers(self.command.topic_name) > 1

    def state(self) -> int | None:
        """Return the state of the wheel's controller; None when it does not tell."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            answer = self.ask(GetState, "get_state", GetState.Request())
            if answer is not None:
                return int(answer.current_state.id)
        return None

    def switch(self, transition: int) -> bool:
        """Ask the wheel's controller for a transition; return whether it is in its state then.

        Where an answer was lost it is there already and tells the next request as a failure, so
        the state decides.
        """
        wanted = {
            Transition.TRANSITION_DEACTIVATE: State.PRIMARY_STATE_INACTIVE,
            Transition.TRANSITION_ACTIVATE: State.PRIMARY_STATE_ACTIVE,
        }[transition]
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            request = ChangeState.Request(transition=Transition(id=transition))
            self.ask(ChangeState, "change_state", request)
            if self.state() == wanted:
                return True
        return False

    def ask(self, kind: Any, service: str, request: Any) -> Any:
        """Ask the wheel's controller once; return its answer, or None."""
        name = f"/{self.wheel}/wheel_pid/{service}"
        try:
            return self.asker.ask_all(kind, {name: request}, again=1.0)[name]
        except AskError:
            return None


def main(argv: list[str] | None = None) -> int:
    """Run the test.

    Parameters
    ----------
    argv : list of str or None
        Arguments.

    Returns
    -------
    int
        Exit code.
    """
    parser = argparse.ArgumentParser(prog="relay_test")
    parser.add_argument("wheel")
    for name in ("bias", "amplitude", "hysteresis", "seconds"):
        parser.add_argument(f"--{name}", type=float, required=True)
    arguments = parser.parse_args(argv)
    rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    node = RelayTest(arguments.wheel, arguments.bias, arguments.amplitude, arguments.hysteresis)
    try:
        trouble = node.take_over()
        answer = {"error": trouble} if trouble else node.run(arguments.seconds)
        print(json.dumps(answer), flush=True)
    except KeyboardInterrupt:
        return 130
    finally:
        if node.begun is not None:
            node.begun = None
            runtime.send_last(node.command, MotorCommand(voltage=0.0))
        if node.paused:
            node.switch(Transition.TRANSITION_ACTIVATE)
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
