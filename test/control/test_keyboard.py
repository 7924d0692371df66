# SPDX-License-Identifier: Apache-2.0
"""Keys to speeds, and the dead man's switch."""

import pytest

from smp_motor_control import WHEELS
from smp_motor_control.nodes.teleop_wheels import BODY_KEYS, Keyboard, Speeds, parse_keys

SPEEDS = Speeds(linear=0.2, angular=0.6, wheel=1.5, step=0.1, timeout=0.6)


def test_nothing_moves_before_the_first_key():
    keyboard = Keyboard(SPEEDS)
    assert not keyboard.driving(100.0)
    assert keyboard.body(100.0) == (0.0, 0.0)
    assert set(keyboard.wheels(100.0).values()) == {0.0}


def test_released_key_stops_after_the_timeout():
    keyboard = Keyboard(SPEEDS)
    for now in (0.0, 0.5, 0.53, 0.56):  # a press, and its repeats after the first delay
        keyboard.press("w", now)
        assert keyboard.body(now) == (0.2, 0.0)
    assert keyboard.driving(1.16)
    assert not keyboard.driving(1.17)
    assert keyboard.body(1.17) == (0.0, 0.0)


@pytest.mark.parametrize("key", [" ", "k", "5", "m", "+", "\n"])
def test_any_other_key_stops_at_once(key):
    keyboard = Keyboard(SPEEDS)
    keyboard.press("w", 0.0)
    keyboard.press(key, 0.1)
    assert not keyboard.driving(0.1)


@pytest.mark.parametrize("key", BODY_KEYS)
def test_body_keys_scale_linear_and_angular_speed(key):
    keyboard = Keyboard(SPEEDS)
    keyboard.press(key, 0.0)
    linear, angular = BODY_KEYS[key]
    assert keyboard.body(0.0) == (linear * 0.2, angular * 0.6)


def test_wheel_mode_drives_only_selected_wheels():
    keyboard = Keyboard(SPEEDS)
    for key in ("m", "3", "s"):
        keyboard.press(key, 0.0)
    assert keyboard.wheels(0.0) == {w: -1.5 if w == WHEELS[2] else 0.0 for w in WHEELS}
    for key in ("0", "w"):
        keyboard.press(key, 0.0)
    assert set(keyboard.wheels(0.0).values()) == {1.5}


def test_turning_keys_do_nothing_in_wheel_mode():
    keyboard = Keyboard(SPEEDS)
    keyboard.press("m", 0.0)
    keyboard.press("a", 0.0)
    assert not keyboard.driving(0.0)


def test_speed_scale_is_bounded_and_steps_are_reversible():
    keyboard = Keyboard(SPEEDS)
    keyboard.press("+", 0.0)
    keyboard.press("-", 0.0)
    assert keyboard.scale == pytest.approx(1.0)
    for _ in range(100):
        keyboard.press("+", 0.0)
    assert keyboard.scale == Keyboard.MAX_SCALE
    for _ in range(100):
        keyboard.press("-", 0.0)
    assert keyboard.scale == Keyboard.MIN_SCALE


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        ("wW", ["w", "w"]),
        ("\x1b[A\x1bOB\x1b[C\x1b[D", ["w", "s", "d", "a"]),
        ("\x1b[1;5A", ["w"]),
        ("\x1b[5~x", ["x"]),
        ("\x1b", []),
        ("\x1b[", ["["]),
        ("", []),
    ],
)
def test_terminal_characters_are_parsed_to_keys(text, keys):
    assert parse_keys(text) == keys
