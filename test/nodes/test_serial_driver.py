# SPDX-License-Identifier: Apache-2.0
"""serial_driver over a pseudo-terminal, with a firmware that loses bytes, resets and vanishes."""

import contextlib
import math
import os
import pty
import random
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from smp_interfaces.msg import MotorCommand, MotorState
from smp_motor_control.errors import ParameterError
from smp_motor_control.serial_protocol import LineSplitter, decode_state, encode, encode_voltages

GAIN = 20.0
"""Gain of the board's motors [rad/s/V], which respond without lag."""

COUNTS = 500.0
PERIOD = 0.01


class Firmware(threading.Thread):
    """The board: turns its motors as commanded, reports each period, stops on silence."""

    def __init__(self, device: Path) -> None:
        super().__init__(daemon=True)
        self.device = device
        self.voltages = [0.0, 0.0]
        self.angles = [0.0, 0.0]
        self.loss = 0.0
        self.battery: int | str = 12000
        self.stalled = False
        self.obeyed: list[list[float]] = []
        self.running = True
        self.draw = random.Random(5)
        self.start_clock = self.heard = time.monotonic()
        self.plug()

    def plug(self) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        self.device.unlink(missing_ok=True)
        self.device.symlink_to(os.ttyname(slave))
        self.slave = slave

    def unplug(self) -> None:
        self.device.unlink()
        os.close(self.master)
        os.close(self.slave)
        self.master = -1

    def reset(self) -> None:
        self.angles = [0.0, 0.0]
        self.start_clock = time.monotonic()

    def run(self) -> None:
        lines, before = LineSplitter(), time.monotonic()
        while self.running:
            time.sleep(PERIOD)
            now = time.monotonic()
            if self.stalled:
                continue
            with contextlib.suppress(OSError):
                self.listen(lines, now)
            if now - self.heard > 0.2:
                self.voltages = [0.0, 0.0]
            self.angles = [
                a + GAIN * v * (now - before) for a, v in zip(self.angles, self.voltages)
            ]
            before = now
            with contextlib.suppress(OSError):
                os.write(self.master, self.report(now))

    def listen(self, lines: LineSplitter, now: float) -> None:
        for line in lines.feed(os.read(self.master, 4096)):
            text, _, _ = line.rpartition("*")
            if encode(text).decode().strip() == line and text.startswith("V,"):
                self.voltages = [1e-3 * int(field) for field in text.split(",")[1:]]
                self.obeyed.append(self.voltages)
                self.heard = now

    def report(self, now: float) -> bytes:
        clock = int((now - self.start_clock) * 1e6) % (1 << 32)
        counts = [math.floor(a * COUNTS / (2 * math.pi)) for a in self.angles]
        line = encode(f"S,{clock},{self.battery},{counts[0]},250,{counts[1]},")
        return bytes(byte for byte in line if self.draw.random() >= self.loss)


def options(*given: str) -> list[str]:
    return ["--ros-args", *(part for one in given for part in ("-p", one))]


@pytest.fixture
def board(tmp_path: Path) -> Iterator[Firmware]:
    firmware = Firmware(tmp_path / "board")
    firmware.start()
    yield firmware
    firmware.running = False
    firmware.join()


@pytest.fixture
def driver(board: Firmware, process: Callable[..., Any]) -> Callable[..., Any]:
    """Start a driver of the board's two wheels: ``driver("-p", "encoder_bits:=16")``."""
    given = options(f"device:={board.device}", "wheel_names:=[left, right]")
    return lambda *more: process("serial_driver", *given, *more)


def test_driver_recovers_from_lost_bytes_resets_and_unplugging(board, node, driver, eventually):
    started = driver("-p", "encoder_bits:=16")
    seen: list[MotorState] = []
    node.create_subscription(MotorState, "left/motor_state", seen.append, 10)
    command = node.create_publisher(MotorCommand, "left/motor_command", 10)

    def drive() -> None:
        command.publish(MotorCommand(voltage=3.0))
        node.spin()

    def turning() -> bool:
        last = [m.velocity for m in seen[-20:]]
        # One count in a period is 1.3 rad/s of 60; the mean of 20 leaves less than a percent.
        return len(last) == 20 and abs(sum(last) / 20 - 3.0 * GAIN) < 0.02 * 3.0 * GAIN

    eventually(turning, 20.0, drive, started.output)
    assert seen[-1].current == pytest.approx(0.25)
    assert seen[-1].header.frame_id == "left_wheel_joint"

    def settles_after(trouble: Callable[[], None]) -> None:
        trouble()
        begun = len(seen)
        eventually(lambda: len(seen) > begun + 30 and turning(), 20.0, drive, started.output)
        # No sample reports a speed that the wheel did not have, whatever was lost.
        assert max(abs(m.velocity) for m in seen[begun:]) < 1.5 * 3.0 * GAIN

    settles_after(lambda: setattr(board, "loss", 0.01))
    board.loss = 0.0
    settles_after(board.reset)
    board.unplug()
    quiet = len(seen)
    for _ in range(30):
        drive()
    assert len(seen) <= quiet + 5
    settles_after(board.plug)
    # Commands cease: the driver sends zero, and the wheel stands.
    eventually(lambda: board.voltages[0] == 0.0, 3.0, node.spin, "still driven")


@pytest.fixture
def robot(node: Node) -> Any:
    """A client with the states and commands of a board's two wheels."""

    class Robot:
        def __init__(self) -> None:
            self.voltage = 0.0
            self.seen: list[MotorState] = []
            self.diagnoses: list[str] = []
            topics = ("left/motor_command", "right/motor_command")
            self.outputs = [node.create_publisher(MotorCommand, topic, 10) for topic in topics]

        def drive(self) -> None:
            for output in self.outputs:
                output.publish(MotorCommand(voltage=self.voltage))
            node.spin()

    robot = Robot()
    take = lambda m: robot.diagnoses.extend(s.message for s in m.status)  # noqa: E731
    node.create_subscription(DiagnosticArray, "/diagnostics", take, 10)
    node.create_subscription(MotorState, "left/motor_state", robot.seen.append, 10)
    return robot


# 36 V in 16 bits are -29536 mV; a divider may show anything.
@pytest.mark.parametrize("battery", [-12000, -29536, -1, 65535, 10**17, 0, 40, ""])
def test_zero_command_stays_zero_for_any_reported_supply(board, robot, driver, eventually, battery):
    board.battery = battery
    started = driver()
    eventually(lambda: len(board.obeyed) > 30, 20.0, robot.drive, started.output)
    assert board.obeyed == [[0.0, 0.0]] * len(board.obeyed)
    robot.voltage = -3.0
    usable = battery in (0, 40)
    asked = [-1e-3 * battery] * 2 if usable else [-3.0, -3.0]
    eventually(lambda: board.obeyed[-1] == asked, 20.0, robot.drive, started.output)
    assert all(-1.0 <= state.duty_cycle <= 0.0 for state in robot.seen)
    words = "switched off" if usable else "driving" if battery == "" else "impossible for a battery"
    eventually(lambda: any(words in m for m in robot.diagnoses), 5.0, robot.drive, robot.diagnoses)


def test_suspended_board_receives_few_outdated_commands(board, robot, driver, eventually):
    started = driver()
    robot.voltage = 3.0
    eventually(lambda: board.voltages == [3.0, 3.0], 20.0, robot.drive, started.output)
    board.stalled, begun = True, time.monotonic()
    eventually(lambda: time.monotonic() > begun + 2.0, 3.0, robot.drive)
    robot.voltage = 0.0
    eventually(lambda: time.monotonic() > begun + 2.5, 3.0, robot.drive)
    board.obeyed.clear()
    board.stalled = False
    eventually(lambda: [0.0, 0.0] in board.obeyed, 20.0, robot.drive, started.output)
    stale = board.obeyed.index([0.0, 0.0])
    # Answers to its last reports, and a fifth of a second of keep-alive commands
    assert stale <= 7
    eventually(lambda: len(board.obeyed) > stale + 50, 20.0, robot.drive)
    assert board.obeyed[stale:] == [[0.0, 0.0]] * (len(board.obeyed) - stale)


def test_commands_carry_the_clock_of_their_sample(board, robot, driver, eventually):
    told: list[tuple[int, float]] = []

    def listen(lines: LineSplitter, now: float) -> None:
        clock = int((now - board.start_clock) * 1e6)
        for line in lines.feed(os.read(board.master, 4096)):
            if line.startswith("A,"):
                told.append((int(line.split(",")[1].split("*")[0]), clock))
            elif line.startswith("V,"):
                board.obeyed.append(board.voltages)

    board.listen = listen  # type: ignore[method-assign]
    driver()
    eventually(lambda: len(told) > 50, 20.0, robot.drive)
    assert abs(len(told) - len(board.obeyed)) <= 1
    ages = sorted(1e-6 * (clock - answered) for answered, clock in told)
    assert ages[0] > 0.0 and ages[len(ages) // 2] < 0.1


def test_malformed_lines_do_not_stop_the_driver(board, robot, driver, eventually):
    started = driver()
    eventually(lambda: len(robot.seen) > 5, 20.0, robot.drive, started.output)
    long = "9" * 400
    for fields in (
        f"1,12000,{2**63},0,0,0", f"1,12000,{-(2**63) - 1},0,0,0", f"1,12000,{long},0,0,0",
        f"{long},12000,0,0,0,0", f"1,{long},0,0,0,0", f"1,12000,0,{long},0,0",
        "1_0,12000,0,0,0,0", " 1,12000,0,0,0,0", "1,,,,,", "", "1,12000", "1,nan,0,0,0,0",
        f"1,12000,{10**18 - 1},0,{1 - 10**18},0",
    ):  # fmt: skip
        os.write(board.master, encode(f"S,{fields}"))
    os.write(board.master, bytes(range(256)) * 16 + b"\n")
    count = len(robot.seen)
    eventually(lambda: len(robot.seen) > count + 20, 20.0, robot.drive, started.output)
    assert started.returncode is None


def test_non_terminal_device_is_reported_and_closed(tmp_path, robot, process, eventually):
    (tmp_path / "notes.txt").write_text("no terminal\n")
    started = process("serial_driver", *options(f"device:={tmp_path / 'notes.txt'}"))
    eventually(lambda: robot.diagnoses, 20.0, robot.drive, started.output)
    assert "notes.txt: Inappropriate ioctl" in robot.diagnoses[-1]
    open_files = lambda: len(os.listdir(f"/proc/{started.pid}/fd"))  # noqa: E731
    before, reports = open_files(), len(robot.diagnoses)
    eventually(lambda: len(robot.diagnoses) > reports + 3, 20.0, robot.drive)
    assert open_files() <= before  # six tries later


def test_device_opened_by_another_program_is_not_used(board, robot, driver, eventually):
    driver()
    eventually(lambda: len(robot.seen) > 5, 20.0, robot.drive)
    driver("-r", "__ns:=/second")
    eventually(
        lambda: any("another program has it open" in m for m in robot.diagnoses),
        20.0, robot.drive, robot.diagnoses,
    )  # fmt: skip


def test_line_with_a_missing_character_is_refused():
    line = encode("S,1000,12000,17,250,-4,").decode().strip()
    assert decode_state(line, 2).counts == (17, -4)
    assert math.isnan(decode_state(line, 2).currents[1])
    for k in range(len(line)):
        with pytest.raises(ParameterError):
            decode_state(line[:k] + line[k + 1 :], 2)
    assert encode_voltages([math.nan, 1.0]).startswith(b"V,0,1000*")
