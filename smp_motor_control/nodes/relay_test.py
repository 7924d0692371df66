# SPDX-License-Identifier: Apache-2.0
"""Relay test of one wheel, bounded in voltage and time.

A constant voltage determines the speed around which the relay then switches.  The test always ends
with a zero command and the controller's previous state.
"""

import math
from dataclasses import dataclass

import numpy as np

from smp_interfaces.msg import MotorState
from smp_motor_control.nodes.motor_writer import MotorWriter
from smp_motor_control.nodes.robot_client import TIMEOUT_S, RobotClient, RobotError
from smp_motor_control.nodes.wheel_test import Row, WheelTest
from smp_motor_control.wheel.protection import Bounds

SETTLING_TIME_S = 1.5  # of the constant voltage; the speed is averaged over the last half second
MAX_VOLTAGE_ERROR = 0.1
"""Tolerated difference of applied and commanded voltage, relative to the relay's amplitude."""

MAX_SHARE_BETWEEN = 0.5
"""Maximum fraction of samples between the relay's levels; above it another node commands."""


Oscillation = dict[str, np.ndarray]
"""Recorded deviations from the operating point: ``time`` by the stamps [s]; ``voltage`` commanded
and ``applied``, its mean, before each sample [V]; ``speed`` and ``angle`` of the wheel
[rad/s], [rad].  ``applied`` and ``angle`` are NaN if not reported."""


@dataclass(frozen=True)
class Relay:
    """Relay with hysteresis."""

    bias: float  # [V]
    amplitude: float  # [V]
    hysteresis: float  # [rad/s, wheel]


def run_relay_test(client: RobotClient, wheel: str, relay: Relay, duration: float) -> Oscillation:
    """Run the test on a wheel with its controller paused."""
    client.wait_for_wheels([wheel], TIMEOUT_S)
    test = WheelTest(client, {wheel: lambda message: message.position}, Bounds())
    rows = test.recordings[wheel].rows

    def hold(time: float, message: MotorState) -> float:
        return relay.bias if math.isfinite(message.velocity) else 0.0

    def switch(time: float, message: MotorState) -> float:
        off, output = message.velocity - centre, test.commands[wheel]
        if not math.isfinite(off):
            return 0.0
        if abs(off) > relay.hysteresis:
            return relay.bias - math.copysign(relay.amplitude, off)
        return relay.bias + relay.amplitude if output == relay.bias else output

    def is_applied() -> bool:
        """Return whether the hardware applies the constant voltage, if it reports this."""
        if not rows or not test.writers[wheel].publisher.get_subscription_count():
            return False
        off = abs(rows[-1].voltage - relay.bias)
        return not off > MAX_VOLTAGE_ERROR * relay.amplitude  # NaN: not reported

    with client.paused([wheel]), test.open():
        test.run({wheel: hold}, TIMEOUT_S, is_applied)
        if not is_applied():
            raise _explain_rejected_command(test.writers[wheel])
        test.run({wheel: hold}, SETTLING_TIME_S)
        first = len(rows)
        if first < 20:
            raise RobotError(
                f"{wheel}: only {first} samples in {SETTLING_TIME_S} s, and 20 are needed; raise "
                "the rate of motor_state"
            )
        late = [row.velocity for row in rows if row.stamp > rows[-1].stamp - 0.5]
        centre = float(np.nanmean(late))
        test.run({wheel: switch}, duration)
        known = [row for row in rows[first:] if math.isfinite(row.velocity)]
        # A row of arrays, one for each column
        columns = Row(*np.array(known).reshape(-1, len(Row._fields)).T)
        applied = columns.voltage - relay.bias
        # The applied voltage is at one of the relay's levels except where it switches.
        between = np.abs(np.abs(applied) - relay.amplitude) > MAX_VOLTAGE_ERROR * relay.amplitude
        if np.count_nonzero(between) > MAX_SHARE_BETWEEN * len(known):
            raise _explain_rejected_command(test.writers[wheel])
    time = columns.stamp - columns.stamp[:1]
    return {
        "time": time,
        "voltage": columns.command - relay.bias,
        "applied": applied,
        "speed": columns.velocity - centre,
        "angle": columns.position - columns.position[:1] - centre * time,
    }


def _explain_rejected_command(writer: MotorWriter) -> RobotError:
    topic = writer.publisher.topic_name
    if not writer.publisher.get_subscription_count():
        return RobotError(f"{topic}: no subscriber; start motor_plant or the robot's driver")
    return RobotError(
        f"{topic}: the applied voltage differs from the command; "
        f"{writer.owner or 'another node'} commands the wheel, end it first"
    )
