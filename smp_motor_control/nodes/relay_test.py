# SPDX-License-Identifier: Apache-2.0
"""Relay test of one wheel, bounded in voltage and time.

A constant voltage determines the speed around which the relay then switches.  The test always ends
with a zero command and the controller's previous state.
"""

import math
from dataclasses import dataclass

import numpy as np

from smp_interfaces.msg import MotorState
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.motor_writer import MotorWriter
from smp_motor_control.nodes.robot_client import TIMEOUT_S, RobotClient, RobotError

SETTLING_TIME_S = 1.5  # of the constant voltage; the speed is averaged over the last half second
MAX_VOLTAGE_ERROR = 0.1
"""Tolerated difference of applied and commanded voltage, relative to the relay's amplitude."""

MAX_SHARE_BETWEEN = 0.5
"""Maximum fraction of samples between the relay's levels; above it another node commands."""


Oscillation = dict[str, np.ndarray]
"""Recorded deviations from the operating point: ``time`` by the stamps [s]; ``voltage`` commanded
after each sample and ``applied``, the mean before it [V]; ``speed`` and ``angle`` of the wheel
[rad/s], [rad].  ``applied`` and ``angle`` are NaN if not reported."""


@dataclass(frozen=True)
class Relay:
    """Relay with hysteresis."""

    bias: float  # [V]
    amplitude: float  # [V]
    hysteresis: float  # [rad/s, wheel]


class _Test:
    """Relay test that answers every sample with a voltage."""

    def __init__(self, client: RobotClient, wheel: str, relay: Relay) -> None:
        self.client, self.wheel, self.relay = client, wheel, relay
        self.centre: float | None = None
        self.output = relay.bias
        # Stamp, commanded and applied voltage, speed, angle
        self.seen: list[tuple[float, ...]] = []
        self.writer = MotorWriter(client.node, f"{wheel}/")

    def answer(self, message: MotorState) -> None:
        speed, relay = message.velocity, self.relay
        if not math.isfinite(speed):
            return
        if self.centre is not None and speed > self.centre + relay.hysteresis:
            self.output = relay.bias - relay.amplitude
        elif self.centre is not None and speed < self.centre - relay.hysteresis:
            self.output = relay.bias + relay.amplitude
        stamp = runtime.seconds(message.header.stamp)
        self.seen.append((stamp, self.output, message.voltage, speed, message.position))
        self.writer.send(self.output)

    def run(self, duration: float) -> Oscillation:
        seen = self.seen
        with self.client.listen(MotorState, {f"{self.wheel}/motor_state": self.answer}):
            if not self.client.until(self._is_applied, TIMEOUT_S):
                raise self._explain_rejected_command()
            self.client.spin(SETTLING_TIME_S)
            first = len(seen)
            if first < 20:
                raise RobotError(
                    f"{self.wheel}: only {first} samples in {SETTLING_TIME_S} s, and 20 are needed"
                    "; raise the rate of motor_state"
                )
            late = [row[3] for row in seen if row[0] > seen[-1][0] - 0.5]
            self.centre = sum(late) / len(late)
            self.output = self.relay.bias + self.relay.amplitude
            self.client.spin(duration)
        return self._subtract_operating_point(first)

    def _is_applied(self) -> bool:
        """Return whether the hardware applies the constant voltage, if it reports this."""
        if not self.seen or not self.writer.publisher.get_subscription_count():
            return False
        off = abs(self.seen[-1][2] - self.output)
        return not off > MAX_VOLTAGE_ERROR * self.relay.amplitude  # NaN: not reported

    def _explain_rejected_command(self) -> RobotError:
        topic = self.writer.publisher.topic_name
        if not self.writer.publisher.get_subscription_count():
            return RobotError(f"{topic}: no subscriber; start motor_plant or the robot's driver")
        return RobotError(
            f"{topic}: the applied voltage differs from the command; "
            f"{self.writer.owner or 'another node'} commands the wheel, end it first"
        )

    def _subtract_operating_point(self, first: int) -> Oscillation:
        rows = np.array(self.seen[first:]).reshape(-1, 5)
        time, angle = (rows[:, k] - rows[:1, k] for k in (0, 4))
        bias, amplitude, centre = self.relay.bias, self.relay.amplitude, self.centre or 0.0
        applied = rows[:, 2] - bias
        # The applied voltage is at one of the relay's levels except where it switches.
        between = np.abs(np.abs(applied) - amplitude) > MAX_VOLTAGE_ERROR * amplitude
        if np.count_nonzero(between) > MAX_SHARE_BETWEEN * len(applied):
            raise self._explain_rejected_command()
        return {
            "time": time,
            "voltage": rows[:, 1] - bias,
            "applied": applied,
            "speed": rows[:, 3] - centre,
            "angle": angle - centre * time,
        }


def run_relay_test(client: RobotClient, wheel: str, relay: Relay, duration: float) -> Oscillation:
    """Run the test on a wheel with its controller paused."""
    client.wait_for_wheels([wheel], TIMEOUT_S)
    with client.paused([wheel]):
        test = _Test(client, wheel, relay)
        try:
            return test.run(duration)
        finally:
            test.writer.stop()
            test.writer.destroy()
