# SPDX-License-Identifier: Apache-2.0
"""Drives the motors of a board on a serial line.

The protocol is that of :mod:`smp_motor_control.serial_protocol`.  A wheel without commands gets 0 V
after ``command_timeout``; a board without commands turns its motors off, and nothing is sent to a
silent board.  A board that is reset or replugged is reconnected by its device.
"""

import array
import contextlib
import fcntl
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
from smp_motor_control import WHEELS, check_wheel_names
from smp_motor_control import serial_protocol as protocol
from smp_motor_control.encoder import Encoder, wrap
from smp_motor_control.errors import ParameterError
from smp_motor_control.fields import described, fixed
from smp_motor_control.motor.parameters import SUPPLY_RANGE_V, Gearbox
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.motor_writer import MotorDriver, report_refused_writers
from smp_motor_control.nodes.settings import Parameters

POLL_PERIOD_S = 0.002
SILENCE_S = 0.5  # of a board, after which its line is reopened
COMMAND_PERIOD_S = 0.05  # longest interval between two commands; the board stops after 0.2 s
BOARD_TIMEOUT_S = 0.2  # silence of a board after which it gets no commands: it may not read
STALE_AFTER_S = 0.1  # age at which an unsent command is dropped
EMPTY_RATIO = 0.3  # supply over nominal below which a battery is empty or off
OVERCHARGED_RATIO = 2.0  # supply over nominal above which a board's reading is wrong
RESET_JUMP_S = 1.0  # jump of the board's clock that shows a reset


@dataclass(frozen=True, kw_only=True)
class Settings:
    device: str = fixed("/dev/ttyACM0", "Serial device of the board.")
    baud: int = fixed(115200, "Baud rate of the line [1/s].")
    wheel_names: tuple[str, ...] = fixed(WHEELS, "Wheels in the board's order.")
    gear_ratio: float = fixed(1.0, "Motor revolutions per wheel revolution.")
    counts_per_revolution: float = fixed(500.0, "Encoder counts per motor revolution.", minimum=1.0)
    encoder_bits: int = fixed(
        32, "Width of the board's counter; 0: never wraps.", minimum=0, maximum=63
    )
    supply_voltage: float = fixed(
        12.0, "Nominal supply [V].", minimum=SUPPLY_RANGE_V[0], maximum=SUPPLY_RANGE_V[1]
    )
    resistance: float = described(math.nan, "Measured resistance of a motor [ohm]; NaN: unknown.")
    command_timeout: float = described(
        0.2, "Time without a command after which a wheel gets 0 V [s].", minimum=0.02,
        maximum=5.0,
    )  # fmt: skip

    def __post_init__(self) -> None:
        if self.baud <= 0 or not hasattr(termios, f"B{self.baud}"):
            raise ParameterError(f"baud is {self.baud}; use a standard rate such as 115200")
        if not self.wheel_names:
            raise ParameterError("wheel_names is empty; name a wheel for each motor of the board")
        check_wheel_names(self.wheel_names)
        Gearbox(self.gear_ratio)
        Encoder(self.counts_per_revolution, self.encoder_bits)


class Wheel:
    """One motor of the board and its topics."""

    def __init__(self, node: Node, name: str, settings: Settings) -> None:
        self.settings, self.voltage, self.commanded = settings, 0.0, -math.inf
        names = set(MotorDescription.get_fields_and_field_types()) - {"joint_name"}
        description = MotorDescription(**{name: getattr(settings, name) for name in names})
        timeout = settings.command_timeout
        self._driver = MotorDriver(node, name, timeout, self._on_command, description)
        self.lease = self._driver.lease
        self._gearbox = Gearbox(settings.gear_ratio)
        self._encoder = Encoder(settings.counts_per_revolution, settings.encoder_bits)
        self._angle = 0.0
        self._count: int | None = None
        self.applied = 0.0  # last voltage sent [V]

    def _on_command(self, now: float, voltage: float) -> None:
        if math.isfinite(voltage):
            self.voltage, self.commanded = voltage, now

    def voltage_to_send(self, now: float, supply: float) -> float:
        """Return the voltage to send [V], limited to the supply."""
        self._driver.publish_owner(now)
        if now - self.commanded > self.settings.command_timeout:
            return 0.0
        return math.copysign(min(abs(self.voltage), supply), self.voltage)

    def reset(self) -> None:
        """Take the next count as the present position."""
        self._count = None

    def publish(self, count: int, current: float, supply: float, dt: float, stamp: Any) -> None:
        """Publish a state; the first one after a reset has no speed and is skipped."""
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
        state.duty_cycle = min(max(self.applied / supply, -1.0), 1.0) if supply > 0.0 else 0.0
        self._driver.report(stamp)


class SerialDriver(Node):
    """Reads and writes the line on a steady timer."""

    def __init__(self) -> None:
        super().__init__("serial_driver")
        self._settings = settings = Parameters(self, Settings).settings
        self._wheels = [Wheel(self, name, settings) for name in settings.wheel_names]
        self._fd: int | None = None
        self._lines = protocol.LineSplitter()
        self._last_state: protocol.BoardState | None = None
        self._heard_at = self._written_at = self._opened_at = -math.inf
        self._battery = self._supply = settings.supply_voltage
        self._damaged = self._resets = self._openings = self._dropped = 0
        self._problem = ""
        self._diagnostics = runtime.Diagnostics(self, self._assess, settings.device)
        self._timer = runtime.steady_timer(self, POLL_PERIOD_S, self._on_timer)

    def _on_timer(self) -> None:
        now = time.monotonic()
        if self._fd is None or now - max(self._heard_at, self._opened_at) > SILENCE_S:
            self._open(now)
        if self._fd is None:
            return
        try:
            answered = self._read(now)
            if answered or now - self._written_at >= COMMAND_PERIOD_S:
                self._write(now)
        except (OSError, termios.error) as error:
            self._close(_error_text(error))

    def _open(self, now: float) -> None:
        if now - self._opened_at < SILENCE_S:
            return
        self._close("silent" if self._fd is not None else self._problem)
        self._opened_at = now
        try:
            self._fd = os.open(self._settings.device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            self._lock_and_configure(self._fd)
        except (OSError, termios.error, ValueError) as error:
            self._close(_error_text(error))
            return
        self._lines, self._problem = protocol.LineSplitter(), ""
        self._openings += 1

    def _lock_and_configure(self, fd: int) -> None:
        """Lock and configure the device and flush its queues."""
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OSError(0, "another program has it open; end it first") from None
        tty.setraw(fd)
        mode = termios.tcgetattr(fd)
        mode[4] = mode[5] = getattr(termios, f"B{self._settings.baud}")
        termios.tcsetattr(fd, termios.TCSANOW, mode)
        termios.tcflush(fd, termios.TCIOFLUSH)

    def _close(self, problem: str) -> None:
        self._problem = problem
        self._discard_counts()
        if self._fd is not None:
            with contextlib.suppress(OSError):
                os.close(self._fd)
            self._fd = None

    def _discard_counts(self) -> None:
        self._last_state = None
        for wheel in self._wheels:
            wheel.reset()

    def _read(self, now: float) -> bool:
        """Publish the received states; return whether there was one."""
        assert self._fd is not None
        try:
            data = os.read(self._fd, 65536)
        except BlockingIOError:
            return False
        if not data:
            raise OSError(0, "the device is disconnected; plug it in")
        found = False
        for line in self._lines.feed(data):
            try:
                state = protocol.decode_state(line, len(self._wheels))
            except ParameterError as error:
                self._damaged, self._problem = self._damaged + 1, str(error)
                continue
            found, self._heard_at = True, now
            self._take(state)
        return found

    def _take(self, state: protocol.BoardState) -> None:
        before, self._last_state, self._battery = self._last_state, state, state.battery
        self._supply = self._usable_supply()
        dt = (
            math.nan
            if before is None
            else (state.clock - before.clock) % protocol.CLOCK_PERIOD_US * 1e-6
        )
        if not 0.0 < dt < RESET_JUMP_S:
            self._resets += before is not None
            self._discard_counts()
            self._last_state = state
        stamp = self.get_clock().now().to_msg()
        for wheel, count, current in zip(self._wheels, state.counts, state.currents):
            wheel.publish(count, current, self._supply, dt, stamp)

    def _usable_supply(self) -> float:
        """Return the supply that limits commands [V]; the nominal one if the board's is invalid."""
        nominal = self._settings.supply_voltage
        return self._battery if 0.0 <= self._battery <= OVERCHARGED_RATIO * nominal else nominal

    def _write(self, now: float) -> None:
        """Send commands to all motors unless the board is silent or the line is still busy."""
        voltages = [wheel.voltage_to_send(now, self._supply) for wheel in self._wheels]
        if self._fd is None or self._last_state is None or now - self._heard_at > BOARD_TIMEOUT_S:
            return
        fresh = b""
        if _count_unsent_bytes(self._fd):
            if now - self._written_at < STALE_AFTER_S:
                return
            termios.tcflush(self._fd, termios.TCOFLUSH)
            self._dropped += 1
            fresh = b"\n"  # terminates the partly sent command
        line = protocol.encode_age(self._last_state.clock) + protocol.encode_voltages(voltages)
        with contextlib.suppress(BlockingIOError):
            os.write(self._fd, fresh + line)
            self._written_at = now
            for wheel, voltage in zip(self._wheels, voltages):
                wheel.applied = voltage

    def _assess(self) -> tuple[bytes, str, dict[str, object]]:
        now = time.monotonic()
        values: dict[str, object] = {
            "battery [V]": self._battery,
            "damaged lines": self._damaged,
            "resets of the board": self._resets,
            "openings": self._openings,
            "dropped commands": self._dropped,
            "last problem": self._problem or "none",
            "late commands": sum(wheel.lease.late for wheel in self._wheels),
        }
        leases = zip(self._settings.wheel_names, self._wheels)
        rivals = report_refused_writers({name: wheel.lease for name, wheel in leases})
        if self._fd is None:
            return runtime.ERROR, f"{self._settings.device}: {self._problem}", values
        if now - self._heard_at > SILENCE_S:
            silence = now - self._heard_at
            text = f"the board has been silent for {silence:.1f} s; check power, cable and baud"
            return runtime.ERROR, text, values
        if self._supply < EMPTY_RATIO * self._settings.supply_voltage:
            found = (
                f"the board reports a supply of {self._supply:g} V; is the battery switched off?"
            )
            return runtime.WARN, found, values
        if self._supply != self._battery and not math.isnan(self._battery):
            nominal = self._settings.supply_voltage
            found = (
                f"the board reports a supply of {self._battery:g} V, impossible for a battery of "
                f"{nominal:g} V, so {nominal:g} V limits the motors; correct the board's divider "
                "or supply_voltage"
            )
            return runtime.WARN, found, values
        if rivals:
            return runtime.WARN, rivals, values
        return runtime.OK, "driving", values

    def on_stop(self) -> None:
        """Command zero."""
        if self._fd is not None:
            with contextlib.suppress(OSError, termios.error):
                self._stop_motors(self._fd)
            self._close("")

    def _stop_motors(self, fd: int) -> None:
        """Flush the line, send zero and wait until it is sent."""
        termios.tcflush(fd, termios.TCOFLUSH)
        clock = b"" if self._last_state is None else protocol.encode_age(self._last_state.clock)
        os.write(fd, b"\n" + clock + protocol.encode_voltages([0.0] * len(self._wheels)))
        end = time.monotonic() + STALE_AFTER_S
        while _count_unsent_bytes(fd) and time.monotonic() < end:
            time.sleep(POLL_PERIOD_S)


def _count_unsent_bytes(fd: int) -> int:
    """Return the number of unsent bytes; 0 if unknown."""
    waiting = array.array("i", [0])
    with contextlib.suppress(OSError):
        fcntl.ioctl(fd, termios.TIOCOUTQ, waiting)
    return waiting[0]


def _error_text(error: BaseException) -> str:
    """Return the text of a system error, without its number."""
    return str(error.args[-1] if error.args else error)


main = partial(runtime.run, "serial_driver", SerialDriver)
