"""Drives the motors of a board on a serial line: ``motor_command`` out, ``motor_state`` in.

The line protocol is that of :mod:`smp_motor_control.serial_protocol`.  Silence stops both sides:
a wheel whose commands cease gets 0 V after ``command_timeout``, a board that hears nothing turns
its motors off, and a board that says nothing is told nothing.  A board that is reset or unplugged
is found again by its device.
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
from smp_motor_control.motor.parameters import SUPPLIES, Gearbox
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.motor_writer import MotorDriver, tell_refused
from smp_motor_control.nodes.settings import Parameters

POLL = 0.002  # interval at which the line is read [s]
SILENCE = 0.5  # of a board, after which its line is opened again [s]
COMMANDS = 0.05  # longest interval between two commands to the board [s]; it stops after 0.2 s
ANSWERS = 0.2  # a board that was not heard for so long is told nothing: it may not read either [s]
STALE = 0.1  # a command that the line has not taken for so long is dropped [s]
EMPTY = 0.3  # nominal supplies below which a battery is empty or switched off
OVERCHARGED = 2.0  # nominal supplies that no battery has: a board that reports more is wrong
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
    supply_voltage: float = fixed(
        12.0, "Nominal supply [V].", minimum=SUPPLIES[0], maximum=SUPPLIES[1]
    )
    resistance: float = described(math.nan, "Of a motor, by ohmmeter [ohm]; NaN: not measured.")
    command_timeout: float = described(
        0.2, "Silence of a wheel's commands after which it gets 0 V [s].", minimum=0.02,
        maximum=5.0,
    )  # fmt: skip

    def __post_init__(self) -> None:
        if self.baud <= 0 or not hasattr(termios, f"B{self.baud}"):
            raise ParameterError(f"baud is {self.baud}; no serial line has that speed")
        if not self.wheel_names:
            raise ParameterError("wheel_names is empty; name a wheel for each motor of the board")
        check_wheel_names(self.wheel_names)
        Gearbox(self.gear_ratio)
        Encoder(self.counts_per_revolution, self.encoder_bits)


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

    def wanted(self, now: float, supply: float) -> float:
        """Return the voltage to command now [V]: of its own sign, and no more than the supply."""
        self._driver.tell_owner(now)
        if now - self.commanded > self.settings.command_timeout:
            return 0.0
        return math.copysign(min(abs(self.voltage), supply), self.voltage)

    def reset(self) -> None:
        """Take the next count for where the wheel has been all along."""
        self._count = None

    def publish(self, count: int, current: float, supply: float, dt: float, stamp: Any) -> None:
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
        state.duty_cycle = min(max(self.applied / supply, -1.0), 1.0) if supply > 0.0 else 0.0
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
        self._battery = self._supply = settings.supply_voltage
        self._spoilt = self._resets = self._openings = self._dropped = 0
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
        except (OSError, termios.error) as error:
            self._close(_said(error))

    def _open(self, now: float) -> None:
        if now - self._opened < SILENCE:
            return
        self._close("silent" if self._fd is not None else self._problem)
        self._opened = now
        try:
            self._fd = os.open(self._settings.device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            self._take_line(self._fd)
        except (OSError, termios.error, ValueError) as error:
            self._close(_said(error))
            return
        self._lines, self._problem = protocol.Lines(), ""
        self._openings += 1

    def _take_line(self, fd: int) -> None:
        """Make a device our own line, without what an earlier program left in its queues."""
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OSError(0, "another program has it open; end that one") from None
        tty.setraw(fd)
        mode = termios.tcgetattr(fd)
        mode[4] = mode[5] = getattr(termios, f"B{self._settings.baud}")
        termios.tcsetattr(fd, termios.TCSANOW, mode)
        termios.tcflush(fd, termios.TCIOFLUSH)

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
        self._supply = self._usable_supply()
        dt = math.nan if before is None else (state.clock - before.clock) % protocol.CLOCK * 1e-6
        if not 0.0 < dt < RESET:
            self._resets += before is not None
            self._forget()
            self._before = state
        stamp = self.get_clock().now().to_msg()
        for wheel, count, current in zip(self._wheels, state.counts, state.currents):
            wheel.publish(count, current, self._supply, dt, stamp)

    def _usable_supply(self) -> float:
        """Return the supply that limits commands [V]: the nominal one where the board's is none."""
        nominal = self._settings.supply_voltage
        return self._battery if 0.0 <= self._battery <= OVERCHARGED * nominal else nominal

    def _write(self, now: float) -> None:
        """Command all motors, unless the board or its line still has the commands of before."""
        voltages = [wheel.wanted(now, self._supply) for wheel in self._wheels]
        if self._fd is None or self._before is None or now - self._heard > ANSWERS:
            return
        fresh = b""
        if _unsent(self._fd):
            if now - self._written < STALE:
                return
            termios.tcflush(self._fd, termios.TCOFLUSH)
            self._dropped += 1
            fresh = b"\n"  # ends what the line had of the dropped command
        line = protocol.encode_age(self._before.clock) + protocol.encode_voltages(voltages)
        with contextlib.suppress(BlockingIOError):
            os.write(self._fd, fresh + line)
            self._written = now
            for wheel, voltage in zip(self._wheels, voltages):
                wheel.applied = voltage

    def _assess(self) -> tuple[bytes, str, dict[str, object]]:
        now = time.monotonic()
        values: dict[str, object] = {
            "battery [V]": self._battery,
            "spoilt lines": self._spoilt,
            "resets of the board": self._resets,
            "openings": self._openings,
            "dropped commands": self._dropped,
            "last problem": self._problem or "none",
            "late commands": sum(wheel.lease.late for wheel in self._wheels),
        }
        leases = zip(self._settings.wheel_names, self._wheels)
        rivals = tell_refused({name: wheel.lease for name, wheel in leases})
        if self._fd is None:
            return runtime.ERROR, f"{self._settings.device}: {self._problem}", values
        if now - self._heard > SILENCE:
            return runtime.ERROR, "the board is silent", values
        if self._supply < EMPTY * self._settings.supply_voltage:
            found = f"the board reports a supply of {self._supply:g} V: is it switched off?"
            return runtime.WARN, found, values
        if self._supply != self._battery and not math.isnan(self._battery):
            return runtime.WARN, self._wrong_supply(), values
        if rivals:
            return runtime.WARN, rivals, values
        return runtime.OK, "driving", values

    def _wrong_supply(self) -> str:
        nominal = self._settings.supply_voltage
        return (
            f"the board reports a supply of {self._battery:g} V, which is no battery's of "
            f"{nominal:g} V: {nominal:g} V limits the motors; mend the board's divider, or set "
            "supply_voltage"
        )

    def on_stop(self) -> None:
        """Leave the motors at zero."""
        if self._fd is not None:
            with contextlib.suppress(OSError, termios.error):
                self._stop_motors(self._fd)
            self._close("")

    def _stop_motors(self, fd: int) -> None:
        """Send zero past all that waits, and give the line the time that this takes."""
        termios.tcflush(fd, termios.TCOFLUSH)
        clock = b"" if self._before is None else protocol.encode_age(self._before.clock)
        os.write(fd, b"\n" + clock + protocol.encode_voltages([0.0] * len(self._wheels)))
        end = time.monotonic() + STALE
        while _unsent(fd) and time.monotonic() < end:
            time.sleep(POLL)


def _unsent(fd: int) -> int:
    """Return how many bytes the line has not taken yet; 0 where it does not tell."""
    waiting = array.array("i", [0])
    with contextlib.suppress(OSError):
        fcntl.ioctl(fd, termios.TIOCOUTQ, waiting)
    return waiting[0]


def _said(error: BaseException) -> str:
    """Return what an error of the system says, without its number."""
    return str(error.args[-1] if error.args else error)


main = partial(runtime.run, "serial_driver", SerialDriver)
