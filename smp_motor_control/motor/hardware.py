"""A driven motor as its hardware shows it: supply, PWM, delay, time-out, encoder and sensors.

Time comes in as an argument, in seconds on a clock that only goes forward.  Commands take
effect when they arrive or, latched, at the next sample; a sample integrates over what really
happened since the one before.
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
    """What the hardware reports at one instant; fields as in ``MotorState``."""

    voltage: float  # mean armature voltage since the sample before [V]
    current: float  # [A]; NaN where it is not measured
    # velocity, position: of the wheel, from counts [rad/s], [rad]
    velocity: float
    position: float
    encoder_count: int  # of the encoder at the motor shaft, as the counter shows it
    duty: float  # duty cycle in force [-1..1]


@dataclass(frozen=True, kw_only=True)
class DriveSettings:
    """What is between a command and a motor, and between a motor and its report."""

    pwm_steps: int = described(0, "Steps of the duty cycle from 0 to 1; 0 for a continuous one.")
    command_timeout: float = described(
        0.2, "Time after the last command at which the voltage goes to zero [s]."
    )
    current_sensor: bool = described(
        True, "Whether the current is measured; reported as NaN where not."
    )
    current_noise: float = described(0.0, "Standard deviation of the measured current [A].")
    # Over an interval of dt its mean has the standard deviation ``torque_noise / sqrt(dt)``.
    torque_noise: float = described(
        0.0, "Intensity of a random load at the motor shaft [N m sqrt(s)]."
    )
    # Every reported voltage is then constant over its interval.
    latch: bool = described(
        False, "Whether commands wait for the next sample, as in firmware with a fixed rate."
    )
    velocity_window: int = described(
        1, "Samples that the reported speed is differenced over; 0 for the true one."
    )

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (value >= 0 and (math.isfinite(value) or name == "command_timeout")):
                raise ParameterError(f"{name} is {value!r}; it must be zero or positive")


class Supply:
    """A battery with an inner resistance that several motors share."""

    def __init__(self, voltage: float, resistance: float = 0.0) -> None:
        self.open_voltage = voltage  # without load [V]
        self.resistance = resistance  # inner one [ohm]; 0 for a stiff supply
        self.motors: list[DrivenMotor] = []

    def terminal_voltage(self) -> float:
        """Return the voltage under the present currents [V], never below zero."""
        if self.resistance == 0.0:
            return self.open_voltage
        drawn = sum(m.duty * m.entry.wiring.leads * m.motor.current for m in self.motors)
        return max(0.0, self.open_voltage - self.resistance * drawn)


class DrivenMotor:
    """One motor with its driver, gearbox, encoder and sensors, from an instant [s] on.

    It shares a supply with other motors, or has a stiff one of its own.
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
        self.duty = 0.0  # in force
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
        """Take a command; what is not finite counts as 0 V."""
        finite = math.isfinite(voltage)
        if self.settings.latch:
            self._latched = voltage if finite else 0.0
        else:
            self._pending.append((time + self.entry.delay, voltage if finite else 0.0))
        return finite

    def load(self, time: float, wheel_torque: float) -> bool:
        """Put a load on the wheel from now on; what is not finite is ignored."""
        if not math.isfinite(wheel_torque):
            return False
        self.advance(time)
        self._load = self.entry.gearbox.torque_to_motor(wheel_torque)
        return True

    def advance(self, time: float) -> None:
        """Integrate up to an instant, through commands and their expiry."""
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
        # The driver knows the nominal voltage; under sag it delivers less than asked.
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
        """Integrate up to an instant and report what the sensors show there."""
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
            velocity = turned * self.motor.speed
        else:
            velocity = self._speed.step(time, count)
            velocity = self._last_velocity if math.isnan(velocity) else velocity
            self._last_velocity = velocity
        angle = self._speed.total * entry.encoder.angle_per_count
        if settings.velocity_window == 0:
            angle = turned * self.motor.angle
        gearbox = entry.gearbox
        return Sample(
            self._last_voltage,
            current,
            gearbox.to_wheel(velocity),
            gearbox.to_wheel(angle),
            count,
            self.duty,
        )
