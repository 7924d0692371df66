"""Makes one wheel oscillate under a relay, bounded in voltage and time.

The tool ``tune --relay`` starts it as a process of its own.  The wheel's controller is
deactivated for the time of the test and activated again.  First a constant voltage shows the
speed to oscillate around, then the relay switches around it.  One line of JSON at the end:
``sample_time`` [s], ``voltage`` [V] and ``speed`` [rad/s, wheel], both around their rest; or
``error``.  Whatever ends it, the last command is zero.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.node import Node

from smp_interfaces.msg import MotorCommand, MotorState
from smp_motor_control.nodes import runtime

SETTLE = 1.5
"""How long the constant voltage acts; its last half second tells the speed [s]."""


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
        self.command = self.create_publisher(
            MotorCommand, f"/{wheel}/motor_command", runtime.STREAM_PUBLISHER
        )
        self.create_subscription(
            MotorState, f"/{wheel}/motor_state", self._answer, runtime.STREAM_SUBSCRIBER
        )

    def _answer(self, message: MotorState) -> None:
        speed = message.velocity
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
        if len(self.speeds) < 20:
            return {"error": f"/{self.wheel}/motor_state: {len(self.speeds)} samples in {SETTLE} s"}
        late = [v for t, v in zip(self.stamps, self.speeds, strict=True)
                if t > self.stamps[-1] - 0.5]  # fmt: skip
        self.centre = sum(late) / len(late)
        first = len(self.speeds)
        self.output = self.bias + self.amplitude
        self.spin(lambda: False, seconds)
        steps = sorted(b - a for a, b in itertools.pairwise(self.stamps))
        return {
            "sample_time": steps[len(steps) // 2],
            "voltage": [v - self.bias for v in self.voltages[first:]],
            "speed": [v - self.centre for v in self.speeds[first:]],
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

    def switch(self, transition: int) -> bool:
        """Ask the wheel's controller for a transition; return whether it is there and did it."""
        client = self.create_client(ChangeState, f"/{self.wheel}/wheel_pid/change_state")
        if not self.spin(client.service_is_ready, 2.0):
            return False
        for _ in range(6):
            request = ChangeState.Request(transition=Transition(id=transition))
            future = client.call_async(request)
            if self.spin(future.done, 1.0):
                return bool(future.result().success)
        return False


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
    paused = False
    try:
        paused = node.switch(Transition.TRANSITION_DEACTIVATE)
        print(json.dumps(node.run(arguments.seconds)), flush=True)
    except KeyboardInterrupt:
        return 130
    finally:
        node.begun = None
        runtime.send_last(node.command, MotorCommand(voltage=0.0))
        if paused:
            node.switch(Transition.TRANSITION_ACTIVATE)
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
