# SPDX-License-Identifier: Apache-2.0
"""Bounded test of wheels whose controllers are paused.

Every sample is answered with a voltage, so that a silent wheel is not driven.  The last command is
always zero.
"""

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from sensor_msgs.msg import BatteryState

from smp_interfaces.msg import MotorDescription, MotorState
from smp_motor_control.body.wheel_travel import WheelSample, WheelTravel
from smp_motor_control.encoder import Unwrapper
from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.parameters import check_supply
from smp_motor_control.nodes.motor_writer import MotorWriter
from smp_motor_control.nodes.robot_client import TIMEOUT_S, RobotClient, RobotError
from smp_motor_control.nodes.runtime import LATCHED, seconds
from smp_motor_control.wheel.protection import Bounds, Protection

Law = Callable[[float, MotorState], float]
"""Voltage [V] by the time since the start of a phase [s] and the sample that it answers."""

Counter = Callable[[MotorState], float]


class Row(NamedTuple):
    """One sample of a wheel."""

    stamp: float  # [s]
    age: float  # on arrival [s]
    command: float  # voltage commanded after the previous sample [V]
    voltage: float  # reported [V]
    velocity: float  # [rad/s]
    position: float  # [rad]
    count: float  # total counts, or the motor's angle [rad] without an encoder
    phase: float  # number of the phase


@dataclass
class WheelRecording:
    """Samples of one wheel."""

    rows: list[Row] = field(default_factory=list)

    def turned(self, since: int) -> float:
        """Return the counts turned since a row."""
        if len(self.rows) <= since:
            return 0.0
        return abs(self.rows[-1].count - self.rows[since].count)

    def position_problem(self) -> str:
        """Return the fault of the position and its remedy; empty without a fault."""
        samples = [WheelSample(row.stamp, row.position, row.velocity) for row in self.rows]
        if not samples:
            return ""
        travel = WheelTravel(samples[0])
        # A change of position at four times the largest reported speed is a jump.
        fastest = 4.0 * max(
            (abs(s.velocity) for s in samples if math.isfinite(s.velocity)), default=0
        )
        for sample in samples[1:]:
            travel.add(sample, fastest)
        return travel.problem


class WheelTest:
    """Test of wheels that the client has paused; ``commands`` are the last voltages [V]."""

    def __init__(
        self, client: RobotClient, counters: Mapping[str, Counter], bounds: Bounds
    ) -> None:
        self._client, self._counters = client, counters
        self._watched = {wheel: Protection(bounds) for wheel in counters}
        self.recordings = {wheel: WheelRecording() for wheel in counters}
        self.commands = dict.fromkeys(counters, 0.0)
        self._laws: Mapping[str, Law] = {}
        self._phase = 0
        self._begun = 0.0
        self.writers: dict[str, MotorWriter] = {}

    @contextlib.contextmanager
    def open(self) -> Iterator["WheelTest"]:
        """Subscribe and allow commands inside the block."""
        self.writers = {w: MotorWriter(self._client.node, f"{w}/") for w in self.recordings}
        try:
            listen = self._client.listen_to_wheels
            with listen(MotorState, "motor_state", self.recordings, self._answer):
                yield self
        finally:
            for writer in self.writers.values():
                writer.stop()
                writer.destroy()

    def run(
        self, laws: Mapping[str, Law], duration: float, until: Callable[[], bool] | None = None
    ) -> int:
        """Drive wheels for a time or until a condition; return the number of this phase."""
        self._phase += 1
        self._begun, self._laws = time.monotonic(), laws
        self._client.until(until or (lambda: False), duration)
        for wheel in laws:
            if rival := self.writers[wheel].owner:
                raise RobotError(f"{wheel}: {rival} owns this wheel; end it first")
        return self._phase

    def _answer(self, wheel: str, message: MotorState) -> None:
        stamp = seconds(message.header.stamp)
        age = self._client.node.get_clock().now().nanoseconds * 1e-9 - stamp
        self.recordings[wheel].rows.append(Row(
            stamp, age, self.commands[wheel], message.voltage, message.velocity,
            message.position, self._counters[wheel](message), float(self._phase),
        ))  # fmt: skip
        why = self._watched[wheel].add(stamp, message.current, message.velocity)
        if why:
            raise RobotError(f"{wheel}: {why}")
        law = self._laws.get(wheel)
        if law is not None:
            self.commands[wheel] = law(time.monotonic() - self._begun, message)
            self.writers[wheel].send(self.commands[wheel], message.header.stamp)
        else:
            self.commands[wheel] = 0.0


def make_counter(hardware: Any) -> Counter:
    """Return a function of total counts or, without an encoder, of the motor's angle [rad]."""
    if not hardware.counts_per_revolution:
        return lambda message: float(message.position * hardware.gear_ratio)
    unwrapped = Unwrapper(hardware.encoder_bits)
    return lambda message: float(unwrapped(message.encoder_count))


def read_descriptions(
    client: RobotClient, wheels: Sequence[str], patience: float
) -> dict[str, MotorDescription]:
    """Return the descriptions of the wheels that publish one in time."""
    found: dict[str, MotorDescription] = {}
    take = found.__setitem__
    with client.listen_to_wheels(MotorDescription, "motor_description", wheels, take, LATCHED):
        client.until(lambda: len(found) == len(wheels), patience)
    return found


def read_battery(client: RobotClient) -> float:
    """Return the voltage of ``battery_state`` [V]; NaN without a plausible one."""
    if not client.node.count_publishers("battery_state"):
        return math.nan
    heard: list[float] = []
    with client.listen(BatteryState, {"battery_state": lambda m: heard.append(m.voltage)}):
        client.until(lambda: bool(heard), 1.0)
    with contextlib.suppress(ParameterError):
        return check_supply("battery_state.voltage", heard[-1] if heard else math.nan)
    return math.nan


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
