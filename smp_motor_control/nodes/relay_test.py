"""A relay that makes one wheel oscillate, bounded in voltage and time.

First a constant voltage shows the speed to oscillate around, then the relay switches around it.
Whatever ends it, the last command is zero and the wheel's controller is as it was.
"""

import math
from dataclasses import dataclass

import numpy as np

from smp_interfaces.msg import MotorState
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.motor_writer import MotorWriter
from smp_motor_control.nodes.robot_client import PATIENCE, RobotClient, RobotError

SETTLE = 1.5  # how long the constant voltage acts; its last half second tells the speed [s]
FOLLOWED = 0.1
"""Share of the relay's amplitude by which what acts may differ from what is asked for."""

MOST_BETWEEN = 0.5
"""Share of samples at whose voltage the relay never is, above which someone else commands."""


Oscillation = dict[str, np.ndarray]
"""What was recorded, around its rest: ``time`` by the stamps [s]; ``voltage`` asked for after each
sample, and ``applied``, the mean over the interval before it [V]; ``speed`` and ``angle`` of the
wheel [rad/s], [rad].  ``applied`` and ``angle`` are NaN where the hardware tells none."""


@dataclass(frozen=True)
class Relay:
    """What switches."""

    # bias, amplitude: it switches between ``bias - amplitude`` and ``bias + amplitude`` [V]
    bias: float
    amplitude: float
    hysteresis: float  # the speed must pass this on either side before it switches [rad/s, wheel]


class _Test:
    """Answers every sample with a voltage."""

    def __init__(self, client: RobotClient, wheel: str, relay: Relay) -> None:
        self.client, self.wheel, self.relay = client, wheel, relay
        self.centre: float | None = None
        self.output = relay.bias
        # Of each sample stamp, voltage asked for and applied, speed, angle
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
            if not self.client.until(self._acts, PATIENCE):
                raise self._not_followed()
            self.client.spin(SETTLE)
            first = len(seen)
            if first < 20:
                raise RobotError(f"{self.wheel}: {first} samples came in {SETTLE} s")
            late = [row[3] for row in seen if row[0] > seen[-1][0] - 0.5]
            self.centre = sum(late) / len(late)
            self.output = self.relay.bias + self.relay.amplitude
            self.client.spin(duration)
        return self._around_rest(first)

    def _acts(self) -> bool:
        """Return whether the wheel has the constant voltage, as far as its hardware tells."""
        if not self.seen or not self.writer.publisher.get_subscription_count():
            return False
        off = abs(self.seen[-1][2] - self.output)
        return not off > FOLLOWED * self.relay.amplitude  # NaN: not known

    def _not_followed(self) -> RobotError:
        topic = self.writer.publisher.topic_name
        if not self.seen:
            return RobotError(f"{self.wheel}/motor_state: no sample came in {PATIENCE:g} s")
        if not self.writer.publisher.get_subscription_count():
            return RobotError(f"{topic}: nobody listens; start motor_plant or the robot's driver")
        return RobotError(
            f"{topic}: what acts on the wheel is not what the relay asks for; "
            f"{self.writer.owner or 'someone else'} commands it"
        )

    def _around_rest(self, first: int) -> Oscillation:
        rows = np.array(self.seen[first:]).reshape(-1, 5)
        time, angle = (rows[:, k] - rows[:1, k] for k in (0, 4))
        bias, amplitude, centre = self.relay.bias, self.relay.amplitude, self.centre or 0.0
        applied = rows[:, 2] - bias
        # A relay is at one of its levels but for the samples in which it switches.
        between = np.abs(np.abs(applied) - amplitude) > FOLLOWED * amplitude
        if np.count_nonzero(between) > MOST_BETWEEN * len(applied):
            raise self._not_followed()
        return {
            "time": time,
            "voltage": rows[:, 1] - bias,
            "applied": applied,
            "speed": rows[:, 3] - centre,
            "angle": angle - centre * time,
        }


def oscillate(client: RobotClient, wheel: str, relay: Relay, duration: float) -> Oscillation:
    """Do the test on a running wheel whose controller is paused meanwhile."""
    client.wait_for_wheels([wheel], PATIENCE)
    with client.paused([wheel]):
        test = _Test(client, wheel, relay)
        try:
            return test.run(duration)
        finally:
            test.writer.stop()
            test.writer.destroy()
