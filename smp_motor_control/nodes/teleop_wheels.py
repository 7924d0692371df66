# SPDX-License-Identifier: Apache-2.0
"""Drives the body or single wheels while keys are held in a terminal.

A terminal shows a held key by repeating it; the command ends when the repeats end (a dead man's
switch).
"""

import atexit
import contextlib
import math
import os
import re
import select
import shutil
import signal
import sys
import termios
import time
import tty
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import FrameType

from geometry_msgs.msg import Twist, TwistStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

from smp_motor_control import WHEELS, check_wheel_names, get_joint_name
from smp_motor_control.errors import ParameterError, SmpError, check_positive
from smp_motor_control.fields import described, fixed, nested
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.settings import Parameters

ARROWS: Mapping[str, str] = {"A": "w", "B": "s", "C": "d", "D": "a"}
"""Letter of an arrow key, by the end of its escape sequence."""

BODY_KEYS: Mapping[str, tuple[float, float]] = {
    "w": (1.0, 0.0),
    "s": (-1.0, 0.0),
    "a": (0.0, 1.0),
    "d": (0.0, -1.0),
    "q": (1.0, 1.0),
    "e": (1.0, -1.0),
    "z": (-1.0, -1.0),
    "c": (-1.0, 1.0),
}
"""Factors of the linear and the angular speed, by key."""

WHEEL_KEYS: Mapping[str, float] = {"w": 1.0, "s": -1.0}

_SEQUENCE = re.compile(r"\x1b(?:\[|O)[0-9;]*([A-Za-z~])|\x1b|(.)", re.DOTALL)


def parse_keys(text: str) -> list[str]:
    """Return the keys in a terminal's characters."""
    keys = []
    for match in _SEQUENCE.finditer(text):
        final, plain = match.groups()
        if plain is not None:
            keys.append(plain.lower())
        elif final in ARROWS:
            keys.append(ARROWS[final])
    return keys


@dataclass(frozen=True, kw_only=True)
class Speeds:
    """Speeds of a held key."""

    linear: float = described(0.2, "Speed of the body [m/s].", name="linear_speed")
    angular: float = described(0.6, "Yaw rate of the body [rad/s].", name="angular_speed")
    wheel: float = described(1.5, "Speed of a wheel [rad/s].", name="wheel_speed")
    step: float = described(0.1, "Relative step of the speeds at + and -.", name="speed_step")
    timeout: float = described(
        0.6, "Time without a repeat after which a key counts as released [s].", maximum=5.0,
        name="key_timeout",
    )  # fmt: skip

    def __post_init__(self) -> None:
        for name in ("linear", "angular", "wheel", "step", "timeout"):
            check_positive(f"{name} of the keyboard", getattr(self, name))


class Keyboard:
    """Commands of the keys; the keys 1, 2, ... select wheels."""

    MIN_SCALE, MAX_SCALE = 0.1, 4.0

    def __init__(self, speeds: Speeds, wheel_names: Sequence[str] = WHEELS) -> None:
        self.speeds = speeds
        self.wheel_names = tuple(wheel_names)
        self.body_mode = True  # False: the keys drive the selected wheels
        self.selected = set(self.wheel_names)
        self.scale = 1.0  # factor of the speeds, changed by + and -
        self.quitting = False
        self._held = ""
        self._seen = -math.inf

    def press(self, key: str, now: float) -> None:
        """Handle a key."""
        motions: Mapping[str, object] = BODY_KEYS if self.body_mode else WHEEL_KEYS
        if key in motions:
            self._held, self._seen = key, now
            return
        self._held = ""
        if key in ("+", "="):
            self.scale = min(self.scale * (1.0 + self.speeds.step), self.MAX_SCALE)
        elif key in ("-", "_"):
            self.scale = max(self.scale / (1.0 + self.speeds.step), self.MIN_SCALE)
        elif key == "m":
            self.body_mode = not self.body_mode
        elif key == "x":
            self.quitting = True
        elif not self.body_mode and key == "0":
            self.selected = set(self.wheel_names)
        elif not self.body_mode and key in "123456789"[: len(self.wheel_names)]:
            self.selected = {self.wheel_names[int(key) - 1]}

    def driving(self, now: float) -> bool:
        """Return whether a motion key is held."""
        return bool(self._held) and now - self._seen <= self.speeds.timeout

    def body(self, now: float) -> tuple[float, float]:
        """Return the commanded (linear, angular) velocity of the body."""
        linear, angular = BODY_KEYS.get(self._held, (0.0, 0.0)) if self.driving(now) else (0.0, 0.0)
        return (
            linear * self.scale * self.speeds.linear,
            angular * self.scale * self.speeds.angular,
        )

    def wheels(self, now: float) -> dict[str, float]:
        """Return the commanded speed of every wheel."""
        share = WHEEL_KEYS.get(self._held, 0.0) if self.driving(now) else 0.0
        speed = share * self.scale * self.speeds.wheel
        return {wheel: speed if wheel in self.selected else 0.0 for wheel in self.wheel_names}


_HIDE_CURSOR, _SHOW_CURSOR = "\x1b[?25l", "\x1b[?25h"


class Terminal:
    """Controlling terminal with unbuffered keys without echo.

    ``suspend`` is called before Ctrl-Z suspends the process, ``leave`` when the terminal is closed
    and ``resume`` after the process continues.
    """

    def __init__(
        self, suspend: Callable[[], None], leave: Callable[[], None], resume: Callable[[], None]
    ) -> None:
        if not sys.stdin.isatty():
            raise SmpError("standard input is not a terminal; start it in a terminal")
        if in_background(sys.stdin.fileno()):
            raise SmpError("it runs in the background of its terminal; start it in the foreground")
        self._fd = sys.stdin.fileno()
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)
        self._usual = termios.tcgetattr(self._fd)
        self._suspend, self._leave, self._resume = suspend, leave, resume
        self._ours = False
        atexit.register(self.restore)
        self.take()
        signal.signal(signal.SIGTSTP, self._on_suspend)
        signal.signal(signal.SIGCONT, self._on_continue)

    def take(self) -> None:
        """Switch the terminal to unbuffered input."""
        tty.setcbreak(self._fd)
        self._ours = True
        self.write(_HIDE_CURSOR)

    def restore(self) -> None:
        """Restore the terminal's settings; repeated calls have no effect."""
        if not self._ours:
            return
        self._ours = False
        # The terminal may be closed.
        with contextlib.suppress(termios.error, OSError, ValueError):
            termios.tcsetattr(self._fd, termios.TCSANOW, self._usual)
            self.write(_SHOW_CURSOR + "\r\n")

    def read(self) -> str:
        """Return the input since the last call; leave when the terminal is closed."""
        events = dict(self._poll.poll(0)).get(self._fd, 0)
        if events & ~select.POLLIN:  # hung up
            self._leave()
        if not events & select.POLLIN:
            return ""
        try:
            return os.read(self._fd, 1024).decode(errors="ignore")
        except OSError:
            self._leave()
            return ""

    def write(self, text: str) -> None:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.write(text)
            sys.stdout.flush()

    def _on_suspend(self, number: int, frame: FrameType | None) -> None:
        self._suspend()
        self.restore()
        os.kill(os.getpid(), signal.SIGSTOP)

    def _on_continue(self, number: int, frame: FrameType | None) -> None:
        if in_background(self._fd):
            return  # continued by `bg`
        if not self._ours:
            self.take()
        self._resume()


def in_background(fd: int) -> bool:
    """Return whether another process group has the terminal."""
    return os.tcgetpgrp(fd) != os.getpgrp()


HELP = """\
teleop_wheels: hold a key to drive; the wheels stop {timeout:g} s after it is released.

  body mode                      wheel mode
    q  w  e    arc  ahead  arc     w or up     selected wheels forward
    a     d    turn on the spot    s or down   selected wheels backward
    z  s  c    arc  back   arc     0           select all
    or the arrow keys              {wheels}

  + -  faster, slower   m  body or wheel mode   space  stop   x or Ctrl-C  quit

"""
ZERO_TIME_S = 1.0  # time of zero commands after a key; then other nodes may drive


@dataclass(frozen=True, kw_only=True)
class Settings:
    speeds: Speeds = nested(Speeds())
    rate: float = fixed(20.0, "Commands per second [Hz].", minimum=5.0, maximum=100.0)
    use_stamped_vel: bool = fixed(True, "Publish TwistStamped (true) or Twist (false).")
    frame_id: str = fixed("base_link", "Frame of a stamped command.")

    wheel_names: tuple[str, ...] = fixed(
        WHEELS, "Wheels, in the order of the keys 1 to 9 that select them."
    )

    def __post_init__(self) -> None:
        if not 1 <= len(self.wheel_names) <= 9:
            raise ParameterError(f"wheel_names has {len(self.wheel_names)} names; give 1 to 9")
        check_wheel_names(self.wheel_names)


class TeleopWheels(Node):
    """Read keys on a steady timer and publish commands until shortly after release."""

    def __init__(self) -> None:
        super().__init__("teleop_wheels")
        parameters = Parameters(self, Settings, self._configure)
        self._settings = parameters.settings
        self._wheels = self._settings.wheel_names
        self._keyboard = Keyboard(self._settings.speeds, self._wheels)
        stamped = self._settings.use_stamped_vel
        self._twist = TwistStamped() if stamped else Twist()
        if stamped:
            self._twist.header.frame_id = self._settings.frame_id
        self._setpoint = JointState(name=[get_joint_name(wheel) for wheel in self._wheels])
        qos = runtime.STREAM_PUBLISHER
        self._twists = self.create_publisher(type(self._twist), "cmd_vel", qos)
        self._setpoints = self.create_publisher(JointState, "wheel_setpoints", qos)
        self._quiet_from = {True: 0.0, False: 0.0}  # end of the zero commands by mode
        self._terminal = Terminal(self._halt, runtime.finish, self._show_help)
        self._show_help()
        self._timer = runtime.steady_timer(self, 1.0 / self._settings.rate, self._on_timer)

    def _configure(self, settings: Settings) -> None:
        self._settings = settings
        self._keyboard.speeds = settings.speeds

    def _show_help(self) -> None:
        wheels = "  ".join(f"{k} {wheel}" for k, wheel in enumerate(self._wheels, start=1))
        self._terminal.write(HELP.format(timeout=self._settings.speeds.timeout, wheels=wheels))

    def _on_timer(self) -> None:
        keyboard, now = self._keyboard, time.monotonic()
        for key in parse_keys(self._terminal.read()):
            keyboard.press(key, now)
        if keyboard.quitting:
            runtime.finish()
            return
        if keyboard.driving(now):
            self._quiet_from[keyboard.body_mode] = now + ZERO_TIME_S
        # After a change of mode while driving, the other mode still sends its zeros.
        for body_mode, until in self._quiet_from.items():
            if now < until:
                self._publish(body_mode, now)
        self._show(now)

    def _publish(self, body_mode: bool, now: float) -> None:
        is_active = body_mode == self._keyboard.body_mode
        if body_mode:
            linear, angular = self._keyboard.body(now) if is_active else (0.0, 0.0)
            self._send_twist(linear, angular)
        else:
            wheels = self._keyboard.wheels(now) if is_active else dict.fromkeys(self._wheels, 0.0)
            self._send_wheels([wheels[wheel] for wheel in self._wheels])

    def _send_twist(self, linear: float, angular: float) -> None:
        twist = self._twist
        if isinstance(twist, TwistStamped):
            twist.header.stamp = self.get_clock().now().to_msg()
            twist = twist.twist
        twist.linear.x, twist.angular.z = linear, angular
        self._twists.publish(self._twist)

    def _send_wheels(self, speeds: list[float]) -> None:
        self._setpoint.header.stamp = self.get_clock().now().to_msg()
        self._setpoint.velocity = speeds
        self._setpoints.publish(self._setpoint)

    def _show(self, now: float) -> None:
        keyboard, speeds = self._keyboard, self._keyboard.speeds
        state = "driving" if keyboard.driving(now) else "stopped"
        if keyboard.body_mode:
            linear, angular = keyboard.body(now)
            subscribers = self._twists.get_subscription_count()
            line = (
                f"body mode  {keyboard.scale * speeds.linear:.2f} m/s  "
                f"{keyboard.scale * speeds.angular:.2f} rad/s  | {state} "
                f"{linear:+.2f} m/s {angular:+.2f} rad/s"
            )
        else:
            subscribers = self._setpoints.get_subscription_count()
            every = len(keyboard.selected) == len(self._wheels)
            chosen = "all" if every else min(keyboard.selected)
            line = f"wheel mode  {keyboard.scale * speeds.wheel:.2f} rad/s  {chosen}  | {state}"
        line += "" if subscribers else "  (no subscriber)"
        self._terminal.write(f"\r{line[: shutil.get_terminal_size().columns - 1]}\x1b[K")

    def _halt(self) -> None:
        """Command zero to all that this node has driven."""
        self._keyboard.press(" ", time.monotonic())
        if self._quiet_from[False]:
            self._send_wheels([0.0] * len(self._wheels))
        if self._quiet_from[True]:
            self._send_twist(0.0, 0.0)
            runtime.send_last(self._twists, self._twist)
        elif self._quiet_from[False]:
            runtime.send_last(self._setpoints, self._setpoint)

    def on_stop(self) -> None:
        """Restore the terminal and command zero."""
        self._terminal.restore()
        self._halt()


main = partial(runtime.run, "teleop_wheels", TeleopWheels)
