# SPDX-License-Identifier: Apache-2.0
"""Keys of a terminal as speeds of the body or of single wheels, with a dead man's switch.

A terminal shows a held key by repeating it; the command ends when the repeats end.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from smp_motor_control import WHEELS
from smp_motor_control.errors import check_positive
from smp_motor_control.fields import described

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
