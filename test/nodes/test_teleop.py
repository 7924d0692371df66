# SPDX-License-Identifier: Apache-2.0
"""teleop_wheels as a process in its own terminal."""

import contextlib
import fcntl
import os
import pty
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from geometry_msgs.msg import TwistStamped
from sensor_msgs.msg import JointState
from wheel_robot import DomainNode

LFLAG = 3


class Terminal:
    """A pseudo-terminal with a process in its foreground."""

    def __init__(self, command: list[str]) -> None:
        self.master, self.slave = pty.openpty()
        self.usual = termios.tcgetattr(self.slave)
        self.shown = ""  # all, ever

        def adopt() -> None:
            os.setsid()
            fcntl.ioctl(0, termios.TIOCSCTTY, 0)

        self.process = subprocess.Popen(
            command, stdin=self.slave, stdout=self.slave, stderr=self.slave, preexec_fn=adopt
        )
        # Unread, the terminal's buffer would fill after some hundred lines and block it.
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            while shown := os.read(self.master, 65536):
                self.shown += shown.decode(errors="replace")

    def type(self, keys: str) -> None:
        os.write(self.master, keys.encode())

    def is_usual(self) -> bool:
        return termios.tcgetattr(self.slave) == self.usual

    def echoes(self) -> bool:
        return bool(termios.tcgetattr(self.slave)[LFLAG] & termios.ECHO)

    def state(self) -> str:
        return Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()[0]

    def close(self) -> None:
        if self.process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.process.pid, signal.SIGKILL)
        self.process.wait()
        os.close(self.slave)
        self._reader.join()
        os.close(self.master)


@pytest.fixture
def terminal(ros_domain: int) -> Iterator:
    started = []

    def start(*command: str) -> Terminal:
        started.append(Terminal(list(command) or ["teleop_wheels"]))
        return started[-1]

    yield start
    for one in started:
        one.close()


class Listener(DomainNode):
    """The commands to the robot."""

    def __init__(self, domain: int) -> None:
        super().__init__(domain, "robot")
        self.twists: list[TwistStamped] = []
        self.setpoints: list[JointState] = []
        self.node.create_subscription(TwistStamped, "cmd_vel", self.twists.append, 100)
        self.node.create_subscription(JointState, "wheel_setpoints", self.setpoints.append, 100)

    def linear(self) -> float | None:
        return self.twists[-1].twist.linear.x if self.twists else None

    def heard(self) -> bool:
        publishers = self.node.count_publishers
        return bool(publishers("cmd_vel") and publishers("wheel_setpoints"))


@pytest.fixture
def robot(ros_domain: int) -> Iterator[Listener]:
    listener = Listener(ros_domain)
    yield listener
    listener.close()


@pytest.fixture
def ready(terminal, robot, eventually):
    """Start it, and wait until the robot has discovered it and it reads keys."""

    def run(*command: str) -> Terminal:
        started = terminal(*command)
        eventually(
            lambda: robot.heard() and "hold a key" in started.shown and not started.echoes(),
            deadline=20.0,
            step=robot.spin,
        )
        return started

    return run


def hold(key: str, shell: Terminal, robot: Listener, condition, eventually) -> None:
    def press() -> None:
        shell.type(key)
        robot.spin_for(0.05)

    eventually(condition, deadline=5.0, step=press)


def test_held_key_drives_and_release_stops_then_silences_commands(ready, robot, eventually):
    shell = ready()
    robot.spin_for(0.3)
    assert robot.twists == []
    assert robot.setpoints == []
    hold("w", shell, robot, lambda: robot.linear() == 0.2, eventually)
    released = time.monotonic()
    eventually(lambda: robot.linear() == 0.0, deadline=3.0, step=robot.spin)
    assert time.monotonic() - released >= 0.5  # key_timeout is 0.6 s from the last repeat
    assert robot.twists[-1].header.frame_id == "base_link"
    assert robot.twists[-1].header.stamp.sec > 0
    # Zeros for 1 s after the last key, then silence
    robot.spin_for(1.5)
    count = len(robot.twists)
    robot.spin_for(0.3)
    assert len(robot.twists) == count
    eventually(lambda: "stopped" in shell.shown)


def test_wheel_mode_turns_the_selected_wheel_and_space_stops_it(ready, robot, eventually):
    shell = ready()
    shell.type("m2++")
    hold(
        "\x1b[A",
        shell,
        robot,
        lambda: robot.setpoints and max(robot.setpoints[-1].velocity) > 0.0,
        eventually,
    )
    speeds = dict(zip(robot.setpoints[-1].name, robot.setpoints[-1].velocity, strict=True))
    assert speeds.pop("front_right_wheel_joint") == pytest.approx(1.5 * 1.1**2)
    assert set(speeds.values()) == {0.0}
    shell.type(" ")
    eventually(lambda: not any(robot.setpoints[-1].velocity), deadline=2.0, step=robot.spin)
    assert robot.twists == []


@pytest.mark.parametrize(
    "leave",
    ["x", "\x03", "\x1c", signal.SIGTERM, signal.SIGHUP],
    ids=["x", "Ctrl-C", "Ctrl-backslash", "SIGTERM", "SIGHUP"],
)
def test_leaving_stops_the_robot_and_restores_the_terminal(ready, robot, eventually, leave):
    shell = ready()
    hold("w", shell, robot, lambda: robot.linear() == 0.2, eventually)
    if isinstance(leave, str):
        shell.type(leave)
    else:
        os.kill(shell.process.pid, leave)
    eventually(lambda: robot.linear() == 0.0, deadline=2.0, step=robot.spin)
    eventually(lambda: shell.process.poll() is not None, deadline=3.0, step=robot.spin)
    assert shell.process.returncode == 0
    assert shell.is_usual()
    eventually(lambda: "\x1b[?25h" in shell.shown)  # the cursor is back
    assert "Traceback" not in shell.shown


def test_suspending_stops_the_robot_and_continuing_reads_keys_again(ready, robot, eventually):
    shell = ready()
    hold("w", shell, robot, lambda: robot.linear() == 0.2, eventually)
    shell.type("\x1a")
    eventually(lambda: shell.state() == "T", deadline=3.0, step=robot.spin)
    assert shell.is_usual()
    eventually(lambda: robot.linear() == 0.0, deadline=1.0, step=robot.spin)
    os.kill(shell.process.pid, signal.SIGCONT)
    eventually(lambda: not shell.echoes(), deadline=3.0, step=robot.spin)
    robot.twists.clear()
    hold("s", shell, robot, lambda: robot.linear() == -0.2, eventually)
    assert shell.process.poll() is None


def test_exception_in_the_node_restores_the_terminal(terminal, eventually):
    script = (
        "import smp_motor_control.nodes.teleop_wheels as t, sys\n"
        "def fail(self, *_): raise RuntimeError('broken')\n"
        "t.TeleopWheels._show = fail\n"
        "sys.exit(t.main([]))\n"
    )
    shell = terminal(sys.executable, "-c", script)
    eventually(lambda: shell.process.poll() is not None, deadline=20.0)
    assert shell.process.returncode == 1
    assert shell.is_usual()
    eventually(lambda: "broken" in shell.shown)


def test_invalid_speed_is_refused_and_terminal_left_unchanged(terminal, eventually):
    shell = terminal("teleop_wheels", "--ros-args", "-p", "linear_speed:=-1.0")
    eventually(lambda: shell.process.poll() is not None, deadline=20.0)
    assert shell.process.returncode == 2
    assert shell.is_usual()
    eventually(lambda: "linear" in shell.shown)
