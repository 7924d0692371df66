"""A relay that makes one wheel oscillate, bounded in voltage and time.

First a constant voltage shows the speed to oscillate around, then the relay switches around it.
Whatever ends it, the last command is zero and the wheel's controller is as it was.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from smp_interfaces.msg import MotorState
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.motor_writer import MotorWriter
from smp_motor_control.nodes.robot_client import PATIENCE, RobotClient, RobotError

SETTLE = 1.5
"""How long the constant voltage acts; its last half second tells the speed [s]."""

FOLLOWED = 0.1
"""Share of the relay's amplitude by which what acts may differ from what is asked for."""

MOST_BETWEEN = 0.5
"""Share of samples at whose voltage the relay never is, above which someone else commands."""


@dataclass(frozen=True)
class Relay:
    """What switches."""

    # bias, amplitude: it switches between ``bias - amplitude`` and ``bias + amplitude`` [V]
    bias: float
    amplitude: float
    hysteresis: float  # the speed must pass this on either side before it switches [rad/s, wheel]


@dataclass
class Oscillation:
    """What was recorded, around its rest."""

    time: list[float] = field(default_factory=list)  # by the stamps [s]
    # voltage, applied: asked for after each sample, and mean over the interval before it [V]
    voltage: list[float] = field(default_factory=list)
    applied: list[float] = field(default_factory=list)
    # speed, angle: [rad/s], [rad], wheel; ``applied`` and ``angle`` are NaN where the hardware
    # tells none
    speed: list[float] = field(default_factory=list)
    angle: list[float] = field(default_factory=list)


class _Test:
    """Answers every sample with a voltage."""

    def __init__(self, client: RobotClient, wheel: str, relay: Relay) -> None:
        self.client, self.wheel, self.relay = client, wheel, relay
        self.centre: float | None = None
        self.output = relay.bias
        self.seen = Oscillation()
        self.writer = MotorWriter(client.node, f"{wheel}/")

    def answer(self, message: MotorState) -> None:
        speed, relay, seen = message.velocity, self.relay, self.seen
        if not math.isfinite(speed):
            return
        if self.centre is not None and speed > self.centre + relay.hysteresis:
            self.output = relay.bias - relay.amplitude
        elif self.centre is not None and speed < self.centre - relay.hysteresis:
            self.output = relay.bias + relay.amplitude
        seen.time.append(runtime.seconds(message.header.stamp))
        seen.speed.append(speed)
        seen.voltage.append(self.output)
        seen.applied.append(message.voltage)
        seen.angle.append(message.position)
        self.writer.send(self.output)

    def run(self, duration: float) -> Oscillation:
        seen = self.seen
        with self.client.listen(MotorState, {f"{self.wheel}/motor_state": self.answer}):
            if not self.client.until(self._acts, PATIENCE):
                raise self._not_followed()
            self.client.spin(SETTLE)
            if len(seen.speed) < 20:
                raise RobotError(f"{self.wheel}: {len(seen.speed)} samples came in {SETTLE} s")
            late = [v for t, v in zip(seen.time, seen.speed) if t > seen.time[-1] - 0.5]
            self.centre = sum(late) / len(late)
            first = len(seen.speed)
            self.output = self.relay.bias + self.relay.amplitude
            self.client.spin(duration)
        return self._around_rest(first)

    def _acts(self) -> bool:
        """Return whether the wheel has the constant voltage, as far as its hardware tells."""
        if not self.seen.applied or not self.writer.publisher.get_subscription_count():
            return False
        off = abs(self.seen.applied[-1] - self.output)
        return not off > FOLLOWED * self.relay.amplitude  # NaN: not known

    def _not_followed(self) -> RobotError:
        topic = self.writer.publisher.topic_name
        if not self.seen.applied:
            return RobotError(f"{self.wheel}/motor_state: no sample came in {PATIENCE:g} s")
        if not self.writer.publisher.get_subscription_count():
            return RobotError(f"{topic}: nobody listens; start motor_plant or the robot's driver")
        return RobotError(
            f"{topic}: what acts on the wheel is not what the relay asks for; "
            f"{self.writer.owner or 'someone else'} commands it"
        )

    def _around_rest(self, first: int) -> Oscillation:
        seen, centre, bias = self.seen, self.centre or 0.0, self.relay.bias
        applied = [v - bias for v in seen.applied[first:]]
        # A relay is at one of its levels but for the samples in which it switches.
        amplitude = self.relay.amplitude
        between = sum(abs(abs(v) - amplitude) > FOLLOWED * amplitude for v in applied)
        if between > MOST_BETWEEN * len(applied):
            raise self._not_followed()
        time = [t - seen.time[first] for t in seen.time[first:]]
        turned = [a - seen.angle[first] for a in seen.angle[first:]]
        return Oscillation(
            time,
            [v - bias for v in seen.voltage[first:]],
            applied,
            [v - centre for v in seen.speed[first:]],
            [a - centre * t for a, t in zip(turned, time)],
        )


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
