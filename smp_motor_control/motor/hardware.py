# SPDX-License-Identifier: Apache-2.0
"""Simulated motor hardware: supply, PWM, delay, time-out, encoder and sensors.

Time is an argument, in seconds on a monotonic clock.  Commands take effect on arrival or,
latched, at the next sample.
"""

import math
import random
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

from smp_motor_control.encoder import DifferencedSpeed
from smp_motor_control.errors import ParameterError
from smp_motor_control.fields import described
from smp_motor_control.motor.file import MotorEntry
from smp_motor_control.motor.friction import Motor


class Sample(NamedTuple):
    """Reported state; fields as in ``MotorState``."""

    voltage: float  # mean armature voltage since the previous sample [V]
    current: float  # [A]; NaN if not measured
    # velocity, position: of the wheel, from counts [rad/s], [rad]
    velocity: float
    position: float
    encoder_count: int  # raw reading at the motor shaft
    duty: float  # duty cycle [-1..1]


@dataclass(frozen=True, kw_only=True)
class DriveSettings:
    """Properties of the driver and the sensors."""

    pwm_steps: int = described(0, "Steps of the duty cycle from 0 to 1; 0: continuous.")
    command_timeout: float = described(
        0.2, "Time after the last command until the voltage is set to zero [s]."
    )
    current_sensor: bool = described(
        True, "Whether the current is measured; NaN is reported otherwise."
    )
    current_noise: float = described(0.0, "Standard deviation of the measured current [A].")
    # The standard deviation of its mean over dt is ``torque_noise / sqrt(dt)``.
    torque_noise: float = described(
        0.0, "Intensity of a white load torque at the motor shaft [N m sqrt(s)]."
    )
    # A reported voltage is then constant over its interval.
    latch: bool = described(
        False, "Whether commands take effect at the next sample, as in fixed-rate firmware."
    )
    velocity_window: int = described(
        1, "Number of samples over which the reported speed is differenced; 0: the true speed."
    )

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (value >= 0 and (math.isfinite(value) or name == "command_timeout")):
                raise ParameterError(f"{name} is {value!r}; it must be zero or positive")


class Supply:
    """Battery with an internal resistance, shared by several motors."""

    def __init__(self, voltage: float, resistance: float = 0.0) -> None:
        self.open_voltage = voltage  # [V]
        self.resistance = resistance  # [ohm]
        self.motors: list[DrivenMotor] = []

    def terminal_voltage(self) -> float:
        """Return the voltage at the present currents [V], never below zero."""
        if self.resistance == 0.0:
            return self.open_voltage
        drawn = sum(m.duty * m.entry.wiring.leads * m.motor.current for m in self.motors)
        return max(0.0, self.open_voltage - self.resistance * drawn)


class DrivenMotor:
    """One motor with its driver, gearbox, encoder and sensors, from the instant ``start`` [s] on.

    Without a ``supply`` to share it has a stiff one of its own.
    """

    def __init__(
        self,
        entry: MotorEntry,
        settings: DriveSettings,
        supply: Supply | None = None,
        start: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.entry = entry
        self.settings = settings
        self.supply = supply or Supply(entry.supply_voltage)
        self.supply.motors.append(self)
        self.motor = Motor(entry.parameters)  # the true state
        self.duty = 0.0
        self.timed_out = True  # whether the last command has expired
        self._random = random.Random(seed)
        self._speed = DifferencedSpeed(entry.encoder, max(1, settings.velocity_window))
        self._pending: deque[tuple[float, float]] = deque()
        self._latched: float | None = None
        self._expiry = math.inf
        self._load = 0.0
        self._now = start
        self._sampled = start
        self._volt_seconds = 0.0
        self._last_voltage = 0.0
        self._last_velocity = 0.0

    def command(self, time: float, voltage: float) -> bool:
        """Command a voltage [V]; a non-finite one counts as 0 V and returns False."""
        finite = math.isfinite(voltage)
        if self.settings.latch:
            self._latched = voltage if finite else 0.0
        else:
            self._pending.append((time + self.entry.delay, voltage if finite else 0.0))
        return finite

    def load(self, time: float, wheel_torque: float) -> bool:
        """Set the load torque of the wheel [N m]; a non-finite one is ignored and returns False."""
        if not math.isfinite(wheel_torque):
            return False
        self.advance(time)
        self._load = self.entry.gearbox.torque_to_motor(wheel_torque)
        return True

    def advance(self, time: float) -> None:
        """Simulate up to an instant, through commands and their expiry."""
        while self._now < time:
            until = min(time, self._expiry)
            if self._pending and self._pending[0][0] < until:
                until = self._pending[0][0]
            self._integrate(until)
            if self._pending and self._pending[0][0] <= self._now:
                effective, voltage = self._pending.popleft()
                self._set_duty(voltage)
                self._expiry = effective + self.settings.command_timeout
                self.timed_out = False
            elif self._now >= self._expiry:
                self._expiry = math.inf
                self.duty = 0.0
                self.timed_out = True

    def _set_duty(self, voltage: float) -> None:
        # The driver divides by the nominal voltage; when the supply sags it delivers less.
        if abs(voltage) <= self.entry.wiring.dead_zone:
            voltage = 0.0
        duty = min(max(voltage / self.entry.supply_voltage, -1.0), 1.0)
        steps = self.settings.pwm_steps
        self.duty = round(duty * steps) / steps if steps else duty

    def _integrate(self, until: float) -> None:
        dt = until - self._now
        if dt <= 0:
            return
        voltage = self.duty * self.supply.terminal_voltage()
        load = self._load
        if self.settings.torque_noise > 0:
            load += self._random.gauss(0.0, self.settings.torque_noise / math.sqrt(dt))
        self.motor.step(self.entry.wiring.leads * voltage, dt, load)
        self._volt_seconds += voltage * dt
        self._now = until

    def sample(self, time: float) -> Sample:
        """Simulate up to an instant and return the sensors' readings."""
        self.advance(time)
        elapsed = time - self._sampled
        if elapsed > 0:
            self._last_voltage = self._volt_seconds / elapsed
            self._volt_seconds = 0.0
            self._sampled = time
        if self._latched is not None:
            self._pending.append((time + self.entry.delay, self._latched))
            self._latched = None
        entry, settings = self.entry, self.settings
        leads, turned = entry.wiring.leads, entry.wiring.encoder
        count = entry.encoder.count(turned * self.motor.angle)
        current = math.nan
        if settings.current_sensor and entry.knows_current:
            current = leads * self.motor.current + self._random.gauss(0.0, settings.current_noise)
        if settings.velocity_window == 0:
            velocity, angle = turned * self.motor.speed, turned * self.motor.angle
        else:
            velocity = self._speed.step(time, count)
            velocity = self._last_velocity if math.isnan(velocity) else velocity
            self._last_velocity = velocity
            angle = self._speed.total * entry.encoder.angle_per_count
        gearbox = entry.gearbox
        return Sample(
            self._last_voltage,
            current,
            gearbox.to_wheel(velocity),
            gearbox.to_wheel(angle),
            count,
            self.duty,
        )
