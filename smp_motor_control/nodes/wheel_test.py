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

from sensor_msgs.msg import BatteryState

from smp_interfaces.msg import MotorDescription, MotorState
from smp_motor_control.body.wheel_travel import WheelSample, WheelTravel
from smp_motor_control.encoder import Unwrapper
from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.parameters import check_supply
from smp_motor_control.nodes.motor_writer import MotorWriter
from smp_motor_control.nodes.robot_client import RobotClient, RobotError
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
