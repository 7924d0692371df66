# SPDX-License-Identifier: Apache-2.0
"""Simulates the motors of a robot behind its hardware topics.

Subscribes to ``<wheel>/motor_command``, of one writer at a time, and to ``<wheel>/load_torque``
(``std_msgs/Float64``, [N m] at the wheel, positive against forward motion); publishes
``<wheel>/motor_state``, ``<wheel>/motor_owner`` on changes and ``<wheel>/motor_description`` once.
A motor file may specify wiring faults, such as swapped leads (``leads: -1``; see
:class:`~smp_motor_control.motor.file.Wiring`).

The simulation runs on the steady clock and stamps with ROS time.  With ``use_sim_time`` it follows
``/clock`` at any pace.
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

_MOTOR_PARAMETER = ParameterDescriptor(description="As in a motor file.", read_only=True)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Parameters of the node, in addition to ``motors.<wheel>.<key>`` as in a motor file."""

    motors_file: str = fixed("", "Motor file; default: the paper's motors.")
    rate: float = fixed(
        200.0, "Samples per second of every motor [Hz].", minimum=1.0, maximum=2000.0
    )
    drive: DriveSettings = nested(DriveSettings(pwm_steps=1000, current_noise=0.01, latch=True))
    supply_resistance: float = described(
        0.0, "Internal resistance of the common battery [ohm].", minimum=0.0
    )
    battery_voltage: float = described(
        0.0,
        "Open-circuit voltage of the battery [V]; 0: supply_voltage of the motors.",
        minimum=0.0,
    )
    ohmmeter: bool = fixed(True, "Whether the description includes the resistance.")
    seed: int = fixed(1, "Seed of all noise.")


MIN_INTERVAL_RATIO = 0.5
"""Minimum interval of samples in periods.  A late timer catches up, a microcontroller does not;
a speed differenced over a short interval would be dominated by quantisation."""

MAX_READING_RATIO, MAX_READINGS = 1.5, 8
"""Reading both clocks is repeated, up to ``MAX_READINGS`` times, when it takes this many times as
long as for the previous sample.  An offset of 10 us at a voltage step of 20 V shifts the angle
permanently by half a count of the paper's encoder."""


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
        self._driver = motor_writer.MotorDriver(node, name, timeout, self._on_command, description)
        self.lease = self._driver.lease
        node.create_subscription(
            Float64, f"{name}/load_torque", self._on_load, runtime.STREAM_SUBSCRIBER
        )

    def _on_command(self, now: float, voltage: float) -> None:
        if not self.motor.command(self._instant(), voltage):
            self.rejected += 1

    def _on_load(self, message: Float64) -> None:
        if not self.motor.load(self._instant(), message.data):
            self.rejected += 1

    def publish(self, now: float, stamp: Any) -> None:
        """Sample at an instant of the simulation's clock and publish with a ROS stamp."""
        state = self._driver.state
        (
            state.voltage, state.current, state.velocity, state.position,
            state.encoder_count, state.duty_cycle,
        ) = self.motor.sample(now)  # fmt: skip
        self._driver.report(stamp)
        self._driver.publish_owner(time.monotonic())


class MotorPlant(Node):
    """All motors of one robot."""

    def __init__(self) -> None:
        super().__init__("motor_plant")
        self._ros_parameters = Parameters(self, Settings, self._on_change, also_known=["motors."])
        settings = self._ros_parameters.settings
        entries = self._motors(settings)
        self._supply = Supply(0.0, settings.supply_resistance)
        self._nominal = max(entry.supply_voltage for entry in entries.values())
        self._supply.open_voltage = settings.battery_voltage or self._nominal
        self._simulated = self.get_clock().ros_time_is_active
        self._origin = self._last_stamp = self.get_clock().now().nanoseconds
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
        self._timer = timer(self._period, self._on_timer)
        names = ", ".join(entries)
        self.get_logger().info(f"simulating {names} at {settings.rate:g} Hz")
        gc.collect()
        gc.freeze()

    def _motors(self, settings: Settings) -> dict[str, motor_file.MotorEntry]:
        given = given_parameters(self)
        motors = motor_file.extract_motors(given)
        if motors and settings.motors_file:
            raise ParameterError(
                "motors_file and motors.<wheel>.<key> are given; give only one of them"
            )
        if motors:
            for name in (name for name in given if name.startswith("motors.")):
                self.declare_parameter(name, given[name], _MOTOR_PARAMETER, ignore_override=True)
            return motor_file.parse_motors(motors, "parameters")
        path = settings.motors_file or motor_file.find_config(motor_file.PAPER_MOTORS)
        return motor_file.load_motors(path)

    def _on_change(self, settings: Settings) -> None:
        self._supply.resistance = settings.supply_resistance
        self._supply.open_voltage = settings.battery_voltage or self._nominal
        for wheel in self._wheels:
            wheel.motor.settings = settings.drive
            wheel.lease.set_timeout(settings.drive.command_timeout)

    def _on_timer(self) -> None:
        now, stamp = self._sampling_instant()
        if now - self._last < MIN_INTERVAL_RATIO * self._period:
            return
        self._late += now - self._last > 1.5 * self._period
        self._last = now
        self._samples += 1
        for wheel in self._wheels:
            wheel.publish(now, stamp)

    def instant(self) -> float:
        """Return the monotonic time of the simulation [s]."""
        if not self._simulated:
            return time.monotonic()
        now = self.get_clock().now().nanoseconds
        if not self._last_stamp:  # first message of /clock
            self._origin = now
        self._origin += min(now - self._last_stamp, 0)  # a clock set back counts as stopped
        self._last_stamp = now
        return (now - self._origin) * 1e-9

    def _sampling_instant(self) -> tuple[float, Any]:
        """Return one instant on both clocks."""
        if self._simulated:
            return self.instant(), self.get_clock().now().to_msg()
        best, limit = math.inf, MAX_READING_RATIO * self._reading
        for _ in range(MAX_READINGS):
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
        rejected = ", ".join(wheel.name for wheel in self._wheels if wheel.rejected)
        late = ", ".join(wheel.name for wheel in self._wheels if wheel.lease.late > wheel.late)
        for wheel in self._wheels:
            wheel.late = wheel.lease.late
        # The gravest problem last
        message = motor_writer.report_refused_writers({w.name: w.lease for w in self._wheels})
        if late:
            timeout = self._ros_parameters.settings.drive.command_timeout
            message = (
                f"refused commands older than {timeout:g} s: {late}; look at the load and the "
                "clock of their writers"
            )
        if rejected:
            message = f"refused non-finite messages: {rejected}; look at their publishers"
        return runtime.WARN if message else runtime.OK, message or "simulating", values


main = partial(runtime.run, "motor_plant", MotorPlant)
