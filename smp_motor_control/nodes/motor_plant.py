"""Simulates the motors of a robot behind the topics of its hardware.

Subscribes ``<wheel>/motor_command``, of one writer at a time, and ``<wheel>/load_torque``
(``std_msgs/Float64``, [N m] at the wheel, positive against forward turning); publishes
``<wheel>/motor_state``, ``<wheel>/motor_owner`` on every change and, once,
``<wheel>/motor_description``.  A motor of the file may have faults, such as swapped leads
(``leads: -1``; see :class:`~smp_motor_control.motor.file.Wiring`).

Physics runs on the steady clock over the real intervals; only the stamps are ROS time.  With
``use_sim_time`` it runs on that of ``/clock``: at whatever pace, and not at all while that stands.
"""

import gc
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from std_msgs.msg import Float64

from smp_interfaces.msg import MotorDescription
from smp_motor_control.errors import ParameterError
from smp_motor_control.fields import described, fixed, nested
from smp_motor_control.motor import file as motor_file
from smp_motor_control.motor.hardware import DrivenMotor, DriveSettings, Supply
from smp_motor_control.nodes import motor_writer, runtime
from smp_motor_control.nodes.settings import Parameters, given_parameters

_FIXED = ParameterDescriptor(description="As in a motor file.", read_only=True)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Parameters of the node, beside ``motors.<wheel>.<key>`` as in a motor file."""

    motors_file: str = fixed("", "File of the motors; where none are given, those of the paper.")
    rate: float = fixed(
        200.0, "Samples per second of every motor [Hz].", minimum=1.0, maximum=2000.0
    )
    drive: DriveSettings = nested(DriveSettings(pwm_steps=1000, current_noise=0.01, latch=True))
    supply_resistance: float = described(
        0.0, "Inner resistance of the battery that all motors share [ohm].", minimum=0.0
    )
    battery_voltage: float = described(
        0.0, "Of the battery without load [V]; 0: the supply_voltage of the motors.", minimum=0.0
    )
    ohmmeter: bool = fixed(True, "Whether the description tells the resistance, as measured.")
    seed: int = fixed(1, "Of all noise.")


SHORTEST_INTERVAL = 0.5
"""Of two samples, in periods: a timer that was late makes up for it, a microcontroller does not.
A speed that is differenced over a sliver of a period would be all quantisation."""

SAME_INSTANT, READINGS = 1.5, 8
"""Both clocks are read at one instant if that takes at most so many times as long as at the sample
before; else they are read again, so often.  Ten microseconds between them, where the voltage jumps
by 20 V, shift a motor's angle by half a count of the paper's encoder, for good."""


class Wheel:
    """One motor and its topics."""

    def __init__(self, node: "MotorPlant", name: str, motor: DrivenMotor, ohmmeter: bool) -> None:
        self.name = name
        self.motor = motor
        self.rejected = self.late = 0
        entry = motor.entry
        description = MotorDescription(
            gear_ratio=entry.wiring.described_gear_ratio or entry.gearbox.ratio,
            counts_per_revolution=entry.encoder.counts_per_revolution,
            encoder_bits=entry.encoder.bits,
            supply_voltage=entry.supply_voltage,
            resistance=entry.resistance if ohmmeter else math.nan,
        )
        timeout = motor.settings.command_timeout
        self._instant = node.instant
        self._driver = motor_writer.MotorDriver(node, name, timeout, self._command, description)
        self.lease = self._driver.lease
        node.create_subscription(
            Float64, f"{name}/load_torque", self._load, runtime.STREAM_SUBSCRIBER
        )

    def _command(self, now: float, voltage: float) -> None:
        if not self.motor.command(self._instant(), voltage):
            self.rejected += 1

    def _load(self, message: Float64) -> None:
        if not self.motor.load(self._instant(), message.data):
            self.rejected += 1

    def publish(self, now: float, stamp: Any) -> None:
        """Sample at an instant of the physics' clock and publish it with its ROS time."""
        state = self._driver.state
        (
            state.voltage, state.current, state.velocity, state.position,
            state.encoder_count, state.duty_cycle,
        ) = self.motor.sample(now)  # fmt: skip
        self._driver.report(stamp)
        self._driver.tell_owner(time.monotonic())


class MotorPlant(Node):
    """All motors of one robot."""

    def __init__(self) -> None:
        super().__init__("motor_plant")
        self._given = Parameters(self, Settings, self._change, also_known=["motors."])
        settings = self._given.settings
        entries = self._motors(settings)
        self._supply = Supply(0.0, settings.supply_resistance)
        self._nominal = max(entry.supply_voltage for entry in entries.values())
        self._supply.open_voltage = settings.battery_voltage or self._nominal
        self._simulated = self.get_clock().ros_time_is_active
        self._origin = self._shown = self.get_clock().now().nanoseconds
        start, self._wheels = self.instant(), []
        for seed, (name, entry) in enumerate(entries.items(), 97 * settings.seed):
            motor = DrivenMotor(entry, settings.drive, self._supply, start, seed)
            self._wheels.append(Wheel(self, name, motor, settings.ohmmeter))
        self._samples = self._late = 0
        self._period = 1.0 / settings.rate
        self._last = start
        self._reading = math.inf
        self._diagnostics = runtime.Diagnostics(self, self._assess, "simulation")
        timer = self.create_timer if self._simulated else partial(runtime.steady_timer, self)
        self._timer = timer(self._period, self._tick)
        names = ", ".join(entries)
        self.get_logger().info(f"simulating {names} at {settings.rate:g} Hz")
        gc.collect()
        gc.freeze()

    def _motors(self, settings: Settings) -> dict[str, motor_file.MotorEntry]:
        given = given_parameters(self)
        motors = motor_file.motors_among(given)
        if motors and settings.motors_file:
            raise ParameterError("give either motors_file or motors.<wheel>.<key>, not both")
        if motors:
            for name in (name for name in given if name.startswith("motors.")):
                self.declare_parameter(name, given[name], _FIXED, ignore_override=True)
            return motor_file.parse_motors(motors, "parameters")
        return motor_file.load_motors(settings.motors_file or motor_file.paper_motors())

    def _change(self, settings: Settings) -> None:
        self._supply.resistance = settings.supply_resistance
        self._supply.open_voltage = settings.battery_voltage or self._nominal
        for wheel in self._wheels:
            wheel.motor.settings = settings.drive
            wheel.lease.set_timeout(settings.drive.command_timeout)

    def _tick(self) -> None:
        now, stamp = self._sampling_instant()
        if now - self._last < SHORTEST_INTERVAL * self._period:
            return
        self._late += now - self._last > 1.5 * self._period
        self._last = now
        self._samples += 1
        for wheel in self._wheels:
            wheel.publish(now, stamp)

    def instant(self) -> float:
        """Return the time of the physics, which never goes back [s]."""
        if not self._simulated:
            return time.monotonic()
        now = self.get_clock().now().nanoseconds
        if not self._shown:  # the first time that is heard
            self._origin = now
        self._origin += min(now - self._shown, 0)  # a clock that was set back stood still meanwhile
        self._shown = now
        return (now - self._origin) * 1e-9

    def _sampling_instant(self) -> tuple[float, Any]:
        """Return one instant on both clocks: hardware stamps when it samples, however busy."""
        if self._simulated:
            return self.instant(), self.get_clock().now().to_msg()
        best, limit = math.inf, SAME_INSTANT * self._reading
        for _ in range(READINGS):
            before = time.monotonic()
            stamp = self.get_clock().now()
            after = time.monotonic()
            if after - before < best:
                best, instant = after - before, (0.5 * (before + after), stamp)
            if best < limit:
                break
        self._reading = best
        return instant[0], instant[1].to_msg()

    def _assess(self) -> tuple[bytes, str, Mapping[str, object]]:
        values: dict[str, object] = {"samples": self._samples, "late samples": self._late}
        for wheel in self._wheels:
            of_wheel = {
                "duty cycle": wheel.motor.duty,
                "commands": "none or timed out" if wheel.motor.timed_out else "fresh",
                "refused messages": wheel.rejected,
                "owner": wheel.lease.owner(time.monotonic()) or "none",
                "refused writers": wheel.lease.refused or "none",
                "late commands": wheel.lease.late,
            }
            values |= {f"{wheel.name} {key}": value for key, value in of_wheel.items()}
        rejected = [wheel.name for wheel in self._wheels if wheel.rejected]
        late = [wheel.name for wheel in self._wheels if wheel.lease.late > wheel.late]
        rivals = motor_writer.tell_refused({w.name: w.lease for w in self._wheels})
        for wheel in self._wheels:
            wheel.late = wheel.lease.late
        message = "simulating"
        if rejected:
            message = f"refused messages that are no numbers: {rejected}"
        elif late:
            message = f"refused commands that come late by their stamps: {late}"
        elif rivals:
            message = rivals
        return runtime.WARN if rejected or late or rivals else runtime.OK, message, values


main = partial(runtime.run, "motor_plant", MotorPlant)
