"""Drives the motors of a board on a serial line: ``motor_command`` out, ``motor_state`` in.

The line protocol is that of :mod:`smp_motor_control.serial_protocol`.  Silence stops both sides:
a wheel whose commands cease gets 0 V after ``command_timeout``, and a board that hears nothing
turns its motors off.  A board that is reset or unplugged is found again by its device.
"""

import contextlib
import math
import os
import termios
import time
import tty
from dataclasses import dataclass
from functools import partial
from typing import Any

from rclpy.node import Node

from smp_interfaces.msg import MotorDescription
from smp_motor_control import WHEELS
from smp_motor_control import serial_protocol as protocol
from smp_motor_control.encoder import Encoder, wrap
from smp_motor_control.errors import ParameterError
from smp_motor_control.fields import described, fixed
from smp_motor_control.motor.parameters import Gearbox
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.motor_writer import MotorDriver
from smp_motor_control.nodes.settings import Parameters

POLL = 0.002  # interval at which the line is read [s]
SILENCE = 0.5  # of a board, after which its line is opened again [s]
COMMANDS = 0.02  # longest interval between two lines to the board [s]; it stops after 0.2 s without
RESET = 1.0  # a board's clock that jumps by more than this was reset, and its counts with it [s]
DESCRIBED = ("gear_ratio", "counts_per_revolution", "encoder_bits", "supply_voltage", "resistance")


@dataclass(frozen=True, kw_only=True)
class Settings:
    device: str = fixed("/dev/ttyACM0", "Serial device of the board.")
    baud: int = fixed(115200, "Speed of the line [1/s].")
    wheel_names: tuple[str, ...] = fixed(WHEELS, "Wheels in the order of the board's motors.")
    gear_ratio: float = fixed(1.0, "Motor turns of a turn of the wheel.")
    counts_per_revolution: float = fixed(
        500.0, "Of the encoder, of a turn of the motor.", minimum=1.0
    )
    encoder_bits: int = fixed(
        32, "Width of the board's counter; 0: it never wraps.", minimum=0, maximum=63
    )
    supply_voltage: float = fixed(12.0, "Nominal supply [V].", minimum=0.1)
    resistance: float = described(math.nan, "Of a motor, by ohmmeter [ohm]; NaN: not measured.")
    command_timeout: float = described(
        0.2, "Silence of a wheel's commands after which it gets 0 V [s].", minimum=0.02
    )

    def __post_init__(self) -> None:
        if not hasattr(termios, f"B{self.baud}"):
            raise ParameterError(f"baud is {self.baud}; no serial line has that speed")
        if not any(self.wheel_names):
            raise ParameterError("wheel_names is empty")


class Wheel:
    """One motor of the board and its topics."""

    def __init__(self, node: Node, name: str, settings: Settings) -> None:
        self.settings, self.voltage, self.commanded = settings, 0.0, -math.inf
        description = MotorDescription(**{name: getattr(settings, name) for name in DESCRIBED})
        timeout = settings.command_timeout
        self._driver = MotorDriver(node, name, timeout, self._command, description)
        self.lease = self._driver.lease
        self._gearbox = Gearbox(settings.gear_ratio)
        self._encoder = Encoder(settings.counts_per_revolution, settings.encoder_bits)
        self._angle = 0.0
        self._count: int | None = None
        self.applied = 0.0  # what was last sent [V]

    def _command(self, now: float, voltage: float) -> None:
        if math.isfinite(voltage):
            self.voltage, self.commanded = voltage, now

    def wanted(self, now: float, battery: float) -> float:
        """Return the voltage to command now [V]."""
        self._driver.tell_owner(now)
        if now - self.commanded > self.settings.command_timeout:
            return 0.0
        return min(max(self.voltage, -battery), battery)

    def reset(self) -> None:
        """Take the next count for where the wheel has been all along."""
        self._count = None

    def publish(self, count: int, current: float, battery: float, dt: float, stamp: Any) -> None:
        """Publish what the board said; the first line after a reset has no speed and is kept."""
        before, self._count = self._count, count
        if before is None:
            return
        turned = wrap(count - before, self._encoder.bits) * self._encoder.angle_per_count
        step = self._gearbox.to_wheel(turned)
        self._angle += step
        state = self._driver.state
        state.voltage, state.current = self.applied, current
        state.velocity, state.position = step / dt, self._angle
        state.encoder_count = count
        state.duty_cycle = min(max(self.applied / battery, -1.0), 1.0) if battery > 0 else 0.0
        self._driver.report(stamp)


class SerialDriver(Node):
    """Reads and writes the line on a steady timer."""

    def __init__(self) -> None:
        super().__init__("serial_driver")
        self._settings = settings = Parameters(self, Settings).settings
        self._wheels = [Wheel(self, name, settings) for name in settings.wheel_names]
        self._fd: int | None = None
        self._lines = protocol.Lines()
        self._before: protocol.BoardState | None = None
        self._heard = self._written = self._opened = -math.inf
        self._battery = settings.supply_voltage
        self._spoilt = self._resets = self._openings = 0
        self._problem = ""
        self._diagnostics = runtime.Diagnostics(self, self._assess, settings.device)
        self._timer = runtime.steady_timer(self, POLL, self._tick)

    def _tick(self) -> None:
        now = time.monotonic()
        if self._fd is None or now - max(self._heard, self._opened) > SILENCE:
            self._open(now)
        if self._fd is None:
            return
        try:
            answered = self._read(now)
            if answered or now - self._written >= COMMANDS:
                self._write(now)
        except OSError as error:
            self._close(error.strerror or str(error))

    def _open(self, now: float) -> None:
        if now - self._opened < SILENCE:
            return
        self._close("silent" if self._fd is not None else self._problem)
        self._opened = now
        try:
            fd = os.open(self._settings.device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            tty.setraw(fd)
            mode = termios.tcgetattr(fd)
            mode[4] = mode[5] = getattr(termios, f"B{self._settings.baud}")
            termios.tcsetattr(fd, termios.TCSANOW, mode)
        except (OSError, termios.error) as error:
            self._problem = str(error.args[-1] if error.args else error)
            return
        self._fd, self._lines, self._problem = fd, protocol.Lines(), ""
        self._openings += 1

    def _close(self, problem: str) -> None:
        self._problem = problem
        self._forget()
        if self._fd is not None:
            with contextlib.suppress(OSError):
                os.close(self._fd)
            self._fd = None

    def _forget(self) -> None:
        self._before = None
        for wheel in self._wheels:
            wheel.reset()

    def _read(self, now: float) -> bool:
        """Publish the lines that came; return whether there was one."""
        assert self._fd is not None
        try:
            data = os.read(self._fd, 65536)
        except BlockingIOError:
            return False
        if not data:
            raise OSError(0, "the device is gone")
        found = False
        for line in self._lines.feed(data):
            try:
                state = protocol.decode_state(line, len(self._wheels))
            except ParameterError as error:
                self._spoilt, self._problem = self._spoilt + 1, str(error)
                continue
            found, self._heard = True, now
            self._take(state)
        return found

    def _take(self, state: protocol.BoardState) -> None:
        before, self._before, self._battery = self._before, state, state.battery
        dt = math.nan if before is None else (state.clock - before.clock) % protocol.CLOCK * 1e-6
        if not 0.0 < dt < RESET:
            self._resets += before is not None
            self._forget()
            self._before = state
        stamp = self.get_clock().now().to_msg()
        for wheel, count, current in zip(self._wheels, state.counts, state.currents):
            wheel.publish(count, current, state.battery, dt, stamp)

    def _write(self, now: float) -> None:
        assert self._fd is not None
        voltages = [wheel.wanted(now, self._battery) for wheel in self._wheels]
        with contextlib.suppress(BlockingIOError):
            os.write(self._fd, protocol.encode_voltages(voltages))
            for wheel, voltage in zip(self._wheels, voltages):
                wheel.applied = voltage
        self._written = now

    def _assess(self) -> tuple[bytes, str, dict[str, object]]:
        now = time.monotonic()
        values: dict[str, object] = {
            "battery [V]": self._battery,
            "spoilt lines": self._spoilt,
            "resets of the board": self._resets,
            "openings": self._openings,
            "last problem": self._problem or "none",
            "late commands": sum(wheel.lease.late for wheel in self._wheels),
        }
        if self._fd is None:
            return runtime.ERROR, f"{self._settings.device}: {self._problem}", values
        if now - self._heard > SILENCE:
            return runtime.ERROR, "the board is silent", values
        return runtime.OK, "driving", values

    def on_stop(self) -> None:
        """Leave the motors at zero."""
        if self._fd is not None:
            with contextlib.suppress(OSError):
                os.write(self._fd, protocol.encode_voltages([0.0] * len(self._wheels)))
                termios.tcdrain(self._fd)
            self._close("")


main = partial(runtime.run, "serial_driver", SerialDriver)
