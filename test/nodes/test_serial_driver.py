"""serial_driver over a pseudo-terminal, with a firmware that loses bytes, resets and vanishes."""

from __future__ import annotations

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
from rclpy.node import Node

from smp_interfaces.msg import MotorCommand, MotorState
from smp_motor_control.errors import ParameterError
from smp_motor_control.serial_protocol import Lines, decode_state, encode, encode_voltages

GAIN = 20.0
"""Of the board's motors [rad/s/V]: they answer at once, so the truth is a product."""

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
        lines, before = Lines(), time.monotonic()
        while self.running:
            time.sleep(PERIOD)
            now = time.monotonic()
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

    def listen(self, lines: Lines, now: float) -> None:
        for line in lines.feed(os.read(self.master, 4096)):
            text, _, _ = line.rpartition("*")
            if encode(text).decode().strip() == line and text.startswith("V,"):
                self.voltages = [1e-3 * int(field) for field in text.split(",")[1:]]
                self.heard = now

    def report(self, now: float) -> bytes:
        clock = int((now - self.start_clock) * 1e6) % (1 << 32)
        counts = [math.floor(a * COUNTS / (2 * math.pi)) for a in self.angles]
        line = encode(f"S,{clock},12000,{counts[0]},250,{counts[1]},")
        return bytes(byte for byte in line if self.draw.random() >= self.loss)


@pytest.fixture
def board(tmp_path: Path) -> Iterator[Firmware]:
    firmware = Firmware(tmp_path / "board")
    firmware.start()
    yield firmware
    firmware.running = False
    firmware.join()


def test_it_drives_through_lost_bytes_resets_and_unplugging(
    board: Firmware, node: Node, process: Callable[..., Any], eventually: Callable[..., None]
) -> None:
    options = (f"device:={board.device}", "wheel_names:=[left, right]", "encoder_bits:=16")
    driver = process("serial_driver", "--ros-args", *(a for o in options for a in ("-p", o)))
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

    eventually(turning, 20.0, drive, driver.output)
    assert seen[-1].current == pytest.approx(0.25)
    assert seen[-1].header.frame_id == "left_wheel_joint"

    def settles_after(trouble: Callable[[], None]) -> None:
        trouble()
        begun = len(seen)
        eventually(lambda: len(seen) > begun + 30 and turning(), 20.0, drive, driver.output)
        # Whatever was lost, no sample says that the wheel turned otherwise than it did.
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


def test_a_line_that_was_spoilt_is_never_taken() -> None:
    line = encode("S,1000,12000,17,250,-4,").decode().strip()
    assert decode_state(line, 2).counts == (17, -4)
    assert math.isnan(decode_state(line, 2).currents[1])
    for k in range(len(line)):
        with pytest.raises(ParameterError):
            decode_state(line[:k] + line[k + 1 :], 2)
    assert encode_voltages([math.nan, 1.0]).startswith(b"V,0,1000*")
